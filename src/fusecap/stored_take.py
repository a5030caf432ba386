"""A take in its file, read as far as somebody asks: half an hour is 200 MB, a frame is 2 KB.

`load_take` reads all of it, `StoredTake` some frames at a time. Numbers become float64.
"""

from __future__ import annotations

import copy
import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from fusecap.body.shape import BodyShape
from fusecap.body.skeleton import Skeleton
from fusecap.errors import TakeError
from fusecap.inputs import TAKE, NpzFile, read_npz
from fusecap.take import BLOCK, FORMAT, FORMAT_NAME, MARKS, MOTION, Take, array_shapes

_ENTRIES = (
    *("format", "timestamps_ns", "rate_hz", "subject_names", "skeleton", "bone_names", "parents"),
    *("heights_m", "offsets_m", *MARKS, *MOTION, "provenance"),
)


class StoredTake:
    """A take whose motion stays in its file; raises `TakeError` for anything else.

    What is read is checked as a `Take` is; `check` does so for all of it. One thread at a time.
    """

    def __init__(self, path: Path | str) -> None:
        self._path = Path(path)
        self._file = NpzFile(path, TAKE, _ENTRIES)
        try:
            self._open()
        except KeyError as error:
            self._file.close()
            raise TakeError(f"{path}: the take has no {error}") from None
        except (ValueError, TypeError, RecursionError) as error:
            self._file.close()
            raise TakeError(f"{path}: {error}") from error
        except BaseException:
            self._file.close()
            raise

    def _open(self) -> None:
        array = self._file.array
        _check_format(str(array("format")) if "format" in self._file.names else "")
        self.timestamps_ns: Int[np.ndarray, " t"] = array("timestamps_ns").astype(np.int64)
        self.tracked: Bool[np.ndarray, "s t"] = array("tracked").astype(bool)
        told = "measured" in self._file.names
        self.measured: Bool[np.ndarray, "s t"] = (
            array("measured").astype(bool) if told else self.tracked
        )
        """Takes from before there was this mark count as measured wherever they are tracked."""
        names = tuple(array("subject_names").tolist())
        provenance = json.loads(str(array("provenance")))
        if not isinstance(provenance, dict):
            raise ValueError("provenance is no table")
        bone_names = tuple(array("bone_names").tolist())
        s, t, b = len(names), len(self.timestamps_ns), len(bone_names)
        self._rows: Sequence[int] = range(s)
        """Of the file."""
        self._motion = {name: self._file.rows(name) for name in MOTION}
        for name, shape in array_shapes(s, t, b).items():
            if name == "measured" and not told:
                continue
            found = self._motion[name].shape if name in MOTION else array(name).shape
            if name in MOTION and self._motion[name].dtype.kind not in "fiu":
                raise ValueError(f"{name} holds {self._motion[name].dtype}, expected numbers")
            if found != shape:
                raise ValueError(
                    f"{name} is {found}, expected {shape} for {s} subjects, {t} frames, {b} bones"
                )
        if (np.diff(self.timestamps_ns) <= 0).any():
            raise ValueError("timestamps_ns do not increase")
        try:
            self._nothing = Take(
                timestamps_ns=self.timestamps_ns[:0],
                rate_hz=float(array("rate_hz")),
                subject_names=names,
                skeleton_name=str(array("skeleton")),
                bone_names=bone_names,
                parents=tuple(array("parents").tolist()),
                heights_m=array("heights_m").astype(np.float64),
                offsets_m=array("offsets_m").astype(np.float64),
                tracked=self.tracked[:, :0],
                measured=self.measured[:, :0],
                provenance=provenance,
                **{name: np.empty(array_shapes(s, 0, b)[name]) for name in MOTION},
            )
        except TakeError as error:
            raise ValueError(error) from None

    @property
    def subject_names(self) -> tuple[str, ...]:
        """In the order of every array's rows."""
        return self._nothing.subject_names

    @property
    def bone_names(self) -> tuple[str, ...]:
        """Of the skeleton."""
        return self._nothing.bone_names

    @property
    def parents(self) -> tuple[int, ...]:
        """Of the bones."""
        return self._nothing.parents

    @property
    def rate_hz(self) -> float:
        """Frames in a second."""
        return self._nothing.rate_hz

    @property
    def skeleton(self) -> Skeleton:
        """The tree of bones."""
        return self._nothing.skeleton

    @property
    def heights_m(self) -> Float[np.ndarray, " s"]:
        """Statures."""
        return self._nothing.heights_m

    @property
    def provenance(self) -> Any:
        """What made it."""
        return self._nothing.provenance

    @property
    def time_s(self) -> Float[np.ndarray, " t"]:
        """Seconds since the first frame."""
        return (self.timestamps_ns - self.timestamps_ns[:1]) * 1e-9

    def shape(self, subject: int) -> BodyShape:
        """The body of one subject."""
        return self._nothing.shape(subject)

    def subject(self, name: str) -> int:
        """Index of the subject called `name`; raises `TakeError` naming the nearest one."""
        return self._nothing.subject(name)

    def of_subjects(self, rows: Sequence[int]) -> StoredTake:
        """The same take with these subjects alone, in this order; open as long as this one is."""
        kept = list(rows)
        part = copy.copy(self)
        part.tracked, part.measured = self.tracked[kept], self.measured[kept]
        part._nothing = self._nothing.of_subjects(kept)
        part._rows = [self._rows[row] for row in kept]
        return part

    def of_frames(self, first: int, end: int) -> Take:
        """From frame `first` up to, and without, frame `end`."""
        end = min(end, len(self.timestamps_ns))
        return self._read([(at, min(at + BLOCK, end)) for at in range(first, end, BLOCK)])

    def at_frames(self, frames: Sequence[int] | Int[np.ndarray, " n"]) -> Take:
        """These frames alone, which rise."""
        frames = np.asarray(frames, dtype=np.int64)
        runs = np.split(frames, np.flatnonzero(np.diff(frames) != 1) + 1)
        return self._read([(int(run[0]), int(run[-1]) + 1) for run in runs if len(run)])

    def check(self) -> None:
        """Reads all of it, and keeps nothing; raises `TakeError`."""
        for first in range(0, len(self.timestamps_ns), BLOCK):
            self.of_frames(first, first + BLOCK)

    def close(self) -> None:
        """Nothing more is read."""
        self._file.close()

    def __enter__(self) -> StoredTake:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _read(self, spans: Sequence[tuple[int, int]]) -> Take:
        """Of the frames of these spans, one after the other."""
        count = sum(end - first for first, end in spans)
        people, bones = len(self.subject_names), len(self.bone_names)
        motion = {
            name: np.empty(shape)
            for name, shape in array_shapes(people, count, bones).items()
            if name in MOTION
        }
        for name, values in motion.items():
            for row, stored in enumerate(self._rows):
                at = 0
                for first, end in spans:
                    values[row, at : at + end - first] = self._motion[name].read(stored, first, end)
                    at += end - first
        frames = np.concatenate([np.arange(*span) for span in spans] or [np.empty(0, int)])
        try:
            return replace(
                self._nothing,
                timestamps_ns=self.timestamps_ns[frames],
                tracked=self.tracked[:, frames],
                measured=self.measured[:, frames],
                **motion,
            )
        except TakeError as error:
            raise TakeError(f"{self._path}: {error}") from None


def load_take(path: Path | str) -> Take:
    """Read a take; raises `TakeError` for a file that is missing, damaged or something else."""
    with StoredTake(path) as stored:
        return stored.of_frames(0, len(stored.timestamps_ns))


def is_take(path: Path | str) -> bool:
    """Whether a take of any version stands there."""
    try:
        found = read_npz(path, TAKE, ("format",))
    except TakeError:
        return False
    return str(found.get("format", "")).startswith(FORMAT_NAME)


def _check_format(found: str) -> None:
    if not found.startswith(FORMAT_NAME):
        raise ValueError("is not a take: it has no 'format' entry of fusecap")
    if found != FORMAT:
        raise ValueError(
            f"is a '{found}', this version reads '{FORMAT}'; solve it again, or use the version of "
            "fusecap that wrote it"
        )
