"""Where the records of an MCAP chunk lie: an opcode, a length, so many bytes, and the next."""

from __future__ import annotations

from numba import types

from fusecap.kernels.jit import kernel

COLUMNS = 7
"""Opcode, first byte, byte after the last; of a message channel, sequence, log and publish time."""
_BYTES = types.Array(types.uint8, 1, "C", readonly=True)


@kernel(types.int64(_BYTES, types.int64, types.int64))
def _number(data, at, count):
    """Of `count` bytes, the lowest first."""
    value = types.int64(0)
    for byte in range(count):
        value |= types.int64(data[at + byte]) << types.int64(8 * byte)
    return value


@kernel(types.int64(_BYTES, types.int64, types.int64, types.int64[:, ::1]))
def find_records(data, message, least, rows_out):
    """How many lie there whole, from the first on; as many rows as there are get `COLUMNS`.

    It ends before a record that is longer than what is left, and before a `message` of fewer than
    `least` bytes, which then hold what is the same in all: 2, 4, 8 and 8 bytes.
    """
    at = types.int64(0)
    count = types.int64(0)
    while at + 9 <= data.size:
        opcode = types.int64(data[at])
        length = _number(data, at + 1, 8)
        at += 9
        if length < 0 or length > data.size - at or (opcode == message and length < least):
            break
        if count < rows_out.shape[0]:
            rows_out[count, 0] = opcode
            rows_out[count, 1] = at
            rows_out[count, 2] = at + length
            if opcode == message:
                rows_out[count, 3] = _number(data, at, 2)
                rows_out[count, 4] = _number(data, at + 2, 4)
                rows_out[count, 5] = _number(data, at + 6, 8)
                rows_out[count, 6] = _number(data, at + 14, 8)
        count += 1
        at += length
    return count
