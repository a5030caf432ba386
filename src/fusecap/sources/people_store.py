"""The people of every frame of a camera: in memory while they are few, else on disk."""

from __future__ import annotations

import math
from array import array
from collections import OrderedDict
from collections.abc import Callable, Iterator, Sequence
from typing import overload

import numpy as np
from jaxtyping import Int

from fusecap.files import Spool

People = np.ndarray
"""(n, K, 3): x [px], y [px], confidence."""
_BLOCK = 256
_BLOCKS = 64
"""Frames changed at a time, and how often that many are at hand."""


class _Frames(Sequence[np.ndarray]):
    """What sequences of frames share; a slice is a list."""

    def at(self, frame: int) -> People:
        """People of one frame, 0 or more."""
        raise NotImplementedError

    @overload
    def __getitem__(self, index: int) -> People: ...

    @overload
    def __getitem__(self, index: slice) -> list[People]: ...

    def __getitem__(self, index: int | slice) -> People | list[People]:
        if isinstance(index, slice):
            return [self.at(frame) for frame in range(*index.indices(len(self)))]
        if not -len(self) <= index < len(self):
            raise IndexError(f"frame {index} of {len(self)}")
        return self.at(index % len(self))

    def __iter__(self) -> Iterator[People]:
        return map(self.at, range(len(self)))


class PeopleStore(_Frames):
    """Written once, read in any order."""

    def __init__(self, *numbers: int, dtype: type[np.generic] = np.float64) -> None:
        """`numbers` is the shape of what is kept of one person."""
        self._numbers = numbers
        self._dtype = np.dtype(dtype)
        self._bytes = math.prod(numbers) * self._dtype.itemsize
        self._spool = Spool()
        self._first = array("q", [0])

    def append(self, people: People) -> None:
        """The next frame's."""
        self._spool.append(np.ascontiguousarray(people, dtype=self._dtype).tobytes())
        self._first.append(self._first[-1] + len(people))

    def __len__(self) -> int:
        return len(self._first) - 1

    def at(self, frame: int) -> People:
        """As it was appended."""
        first, end = self._first[frame], self._first[frame + 1]
        raw = self._spool.read(first * self._bytes, (end - first) * self._bytes)
        return np.frombuffer(raw, dtype=self._dtype).reshape(end - first, *self._numbers)


class _Chosen(_Frames):
    def __init__(self, frames: Sequence[People], rows: Int[np.ndarray, " n"]) -> None:
        self._frames, self._rows = frames, rows

    def __len__(self) -> int:
        return len(self._rows)

    def at(self, frame: int) -> People:
        return self._frames[int(self._rows[frame])]


class _Changed(_Frames):
    def __init__(self, frames: Sequence[People], change: Callable[[People], People]) -> None:
        self._frames, self._change = frames, change
        self._blocks: OrderedDict[int, list[People]] = OrderedDict()

    def __len__(self) -> int:
        return len(self._frames)

    def at(self, frame: int) -> People:
        number, row = divmod(frame, _BLOCK)
        if number not in self._blocks:
            frames = self._frames[number * _BLOCK : (number + 1) * _BLOCK]
            ends = np.cumsum([len(people) for people in frames])
            self._blocks[number] = np.split(self._change(np.concatenate(frames)), ends[:-1])
            if len(self._blocks) > _BLOCKS:
                self._blocks.popitem(last=False)
        self._blocks.move_to_end(number)
        return self._blocks[number][row]


def chosen(frames: Sequence[People], rows: Int[np.ndarray, " n"]) -> Sequence[People]:
    """These frames, in this order."""
    return _Chosen(frames, rows)


def changed(frames: Sequence[People], change: Callable[[People], People]) -> Sequence[People]:
    """Every frame's people as `change` makes them of any (n, K, 3), once somebody asks."""
    return _Changed(frames, change)
