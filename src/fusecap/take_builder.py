"""A take while it is made: frame by frame, of people who come and go."""

from __future__ import annotations

from array import array
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from fusecap.body.shape import REFERENCE_HEIGHT_M, BodyShape
from fusecap.body.skeleton import Skeleton
from fusecap.errors import TakeError
from fusecap.files import Spool
from fusecap.take import BLOCK, Take, save_blocks, take_from_theta
from fusecap.types import Estimate, Status


class TakeBuilder:
    """Collects estimates; gives a valid take at any moment. Long ones lie on disk.

    A subject is known by its name, so one that leaves and returns on a new track goes on in the
    same row. Subjects stand in the order of `subject_names`, then of first appearance. A body has
    one shape: the last one a subject was solved with poses all its frames. A solve that diverged
    counts as untracked.
    """

    def __init__(
        self,
        *,
        skeleton: Skeleton,
        rate_hz: float,
        subject_names: Sequence[str] = (),
        provenance: Mapping[str, Any] | None = None,
    ) -> None:
        self._skeleton = skeleton
        self._rate_hz = rate_hz
        self.provenance = dict(provenance or {})
        self._timestamps_ns = array("q")
        self._people = {name: _Person(skeleton) for name in subject_names}

    def __len__(self) -> int:
        """Frames."""
        return len(self._timestamps_ns)

    def add(self, timestamp_ns: int, estimates: Iterable[Estimate]) -> None:
        """The next frame: everyone solved at `timestamp_ns`; nobody is fine."""
        frame = len(self)
        self._timestamps_ns.append(timestamp_ns)
        for estimate in estimates:
            person = self._people.setdefault(estimate.name, _Person(self._skeleton))
            if person.frames and person.frames[-1] == frame:
                raise TakeError(f"two estimates of '{estimate.name}' at {timestamp_ns} ns")
            person.shape = estimate.shape
            if estimate.status is not Status.DIVERGED:
                person.add(frame, estimate)

    def build(self, provenance: Mapping[str, Any] | None = None) -> Take:
        """What was added so far; subjects never seen have the reference shape and no frame.

        With the builder's `provenance` unless told, as `save`.
        """
        return self._block(0, len(self), self.provenance if provenance is None else provenance)

    def save(self, path: Path | str, provenance: Mapping[str, Any] | None = None) -> None:
        """`build` as a file, with a few frames in memory at a time; raises `TakeError`."""
        nothing = self._block(0, 0, self.provenance if provenance is None else provenance)
        save_blocks(nothing, self._blocks(), path)

    def _blocks(self) -> Iterator[Take]:
        for first in range(0, len(self), BLOCK):
            yield self._block(first, min(first + BLOCK, len(self)), {})

    def _block(self, first: int, end: int, provenance: Mapping[str, Any]) -> Take:
        b, p = self._skeleton.bone_count, self._skeleton.pose_size
        numbers = np.full((len(self._people), end - first, p + 2 * b), np.nan)
        tracked, measured = np.zeros((2, *numbers.shape[:2]), dtype=bool)
        for row, person in enumerate(self._people.values()):
            frames, values, told = person.between(first, end)
            numbers[row, frames - first] = values
            tracked[row, frames - first] = True
            measured[row, frames - first] = told
        return take_from_theta(
            np.ascontiguousarray(numbers[:, :, :p]),
            [person.shape for person in self._people.values()],
            timestamps_ns=np.array(self._timestamps_ns[first:end], dtype=np.int64),
            rate_hz=self._rate_hz,
            subject_names=tuple(self._people),
            skeleton=self._skeleton,
            tracked=tracked,
            measured=measured,
            bone_sigma_deg=np.ascontiguousarray(numbers[:, :, p : p + b]),
            position_sigma_m=np.ascontiguousarray(numbers[:, :, p + b :]),
            provenance=provenance,
        )


class _Person:
    """Poses and error bars of one subject, only where there are any."""

    def __init__(self, skeleton: Skeleton) -> None:
        self.shape = BodyShape.from_height(skeleton, REFERENCE_HEIGHT_M)
        self.frames = array("q")
        self._measured = array("b")
        self._columns = skeleton.pose_size + 2 * skeleton.bone_count
        self._spool = Spool()

    def add(self, frame: int, estimate: Estimate) -> None:
        numbers = (estimate.theta, estimate.bone_sigma_deg, estimate.position_sigma_m)
        # Whatever an interrupt left half done is written over.
        at = 8 * self._columns * len(self.frames)
        self._spool.append(np.concatenate(numbers).tobytes(), at)
        del self._measured[len(self.frames) :]
        self._measured.append(estimate.measured)
        self.frames.append(frame)

    def between(self, first: int, end: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Frames from `first` up to, and without, `end`: which, numbers (n, P + 2 B), measured."""
        frames = np.frombuffer(self.frames, dtype=np.int64) if self.frames else np.empty(0, int)
        low, high = np.searchsorted(frames, [first, end]).tolist()
        size = 8 * self._columns
        raw = self._spool.read(low * size, (high - low) * size)
        values = np.frombuffer(raw).reshape(-1, self._columns)
        return frames[low:high].copy(), values, np.array(self._measured[low:high], dtype=bool)
