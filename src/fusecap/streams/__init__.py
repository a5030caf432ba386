"""Solved people, sent live as other programs' packets.

`person_pose.py` is what goes in. `protocols/` has one module per protocol and their table,
`transports.py` what carries packets; `stream.py` joins them, `target.py` says where to. A take is
played by `play_take.py`, a live run sends through `process.py`. docs/streams.md is the manual.
"""
