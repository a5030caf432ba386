"""Compiled numerics on float64 arrays: the only room with numba, importing nothing else of ours."""
