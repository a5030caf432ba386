"""Datagrams and channels of live sensors: one module per layout, all give `SensorSample`s."""
