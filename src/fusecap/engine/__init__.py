"""A live run without its clock: samples and ticks in, poses out, the same bits in every replay."""
