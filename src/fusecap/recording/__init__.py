"""A live run as one MCAP log: every sample, command and tick in order, and what became of them.

docs/recording.md has the layout.
"""
