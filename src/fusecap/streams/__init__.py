"""Solved people as packets of other programs' protocols: no sockets, no clocks.

One protocol per file. Each takes a `StreamFrame` and gives the bytes or numbers that the receiver
expects, in the receiver's axes and under its bone names; docs/streams.md lists them all.
"""
