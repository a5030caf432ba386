"""A folder that OpenPose is writing into, read as it grows.

`poll(now_ns)` returns the frames that have become readable since the last call. Usually one look
for the next frame's name is enough; the whole folder is listed only when that name is not there,
and then at most every quarter of a second.

A file that cannot be read yet is tried again at the next poll, and given up after `PATIENCE_NS`. A
number that is missing while later ones are there is waited for as long, then dropped. Where the
first number was written again after the last frame, the writer has started again: files that are
older than that are leftovers and not read.
"""

from __future__ import annotations

import os
import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from fusecap.body.landmarks import LandmarkSet
from fusecap.sources.keypoint_files import frame_number, read_people

PATIENCE_NS = 200_000_000
"""How long an unreadable or missing frame holds up later ones: 12 frames at 60 Hz."""
LISTING_NS = 250_000_000
"""Time between listings of the folder, which grow slow with many files."""

_LAST_NUMBER = re.compile(r"^(.*?)(\d+)((?:_keypoints)?\.json)$")


@dataclass(frozen=True, slots=True, kw_only=True)
class LiveFrame:
    """One frame as it came in."""

    number: int
    people: Float[np.ndarray, "n k 3"]
    """x [px], y [px], confidence 0-1; NaN, NaN, 0 where missing."""
    run: int
    """How often the writer had started again before it."""
    read_ns: int
    """The `now_ns` of the poll that read it."""


@dataclass(slots=True)
class LiveCounts:
    """What came in and what did not."""

    frames: int = 0
    broken: int = 0
    """Files that stayed unreadable."""
    dropped: int = 0
    """Numbers that never came, or were deleted before they could be read."""
    restarts: int = 0


class OpenPoseFolder:
    """Follows one camera's folder, which need not exist yet; holds no clock."""

    def __init__(
        self, folder: Path, landmarks: LandmarkSet, *, skip_existing: bool = False
    ) -> None:
        """With `skip_existing` frames that are there at the first poll are taken as past."""
        self.counts = LiveCounts()
        self._folder = folder
        self._landmarks = landmarks
        self._skip = skip_existing
        self._first = 0
        self._next: int | None = None
        self._last_written_ns = -1
        self._run_started_ns = -1
        self._waiting: dict[int, Path] = {}
        self._stalled_ns: int | None = None
        self._listed_ns: int | None = None
        self._name: re.Match[str] | None = None

    def poll(self, now_ns: int) -> list[LiveFrame]:
        """New frames in order; raises `InputError` for keypoints of another format."""
        found = self._in_order(now_ns)
        due = self._listed_ns is None or now_ns - self._listed_ns >= LISTING_NS
        if not found and due:
            self._list(now_ns)
            found = self._in_order(now_ns)
        return found

    def _in_order(self, now_ns: int) -> list[LiveFrame]:
        frames = []
        while self._next is not None:
            path = self._waiting.get(self._next) or self._path_of(self._next)
            written_ns = _written_ns(path)
            there = written_ns >= max(self._run_started_ns, 0)
            people = read_people(path, self._landmarks) if there else None
            if people is None:
                if not self._give_up(there, now_ns):
                    break
                continue
            frames.append(
                LiveFrame(
                    number=self._next, people=people, run=self.counts.restarts, read_ns=now_ns
                )
            )
            self.counts.frames += 1
            self._last_written_ns = max(self._last_written_ns, written_ns)
            self._step_past(self._next)
        return frames

    def _give_up(self, there: bool, now_ns: int) -> bool:
        """Whether the next frame was waited for long enough; then it is counted and passed."""
        assert self._next is not None
        if not there and not any(number > self._next for number in self._waiting):
            self._stalled_ns = None
            return False
        if self._stalled_ns is None:
            self._stalled_ns = now_ns
        if now_ns - self._stalled_ns < PATIENCE_NS:
            return False
        if there:
            self.counts.broken += 1
            self._step_past(self._next)
            return True
        following = min(number for number in self._waiting if number > self._next)
        self.counts.dropped += following - self._next
        self._step_past(following - 1)
        return True

    def _step_past(self, number: int) -> None:
        self._next = number + 1
        self._stalled_ns = None
        for passed in [n for n in self._waiting if n <= number]:
            del self._waiting[passed]

    def _list(self, now_ns: int) -> None:
        """Looks at all files: later frames, gaps, another run."""
        self._listed_ns = now_ns
        files = self._files()
        if self._next is None and self._skip and files:
            self._last_written_ns = max(written for _, _, written in files)
            self._run_started_ns = self._last_written_ns + 1
            self._first = self._next = max(number for number, _, _ in files) + 1
            self._name = _LAST_NUMBER.match(files[-1][1].name)
        self._skip = False
        if not files:
            return
        known = self._next
        again = [
            (number, written)
            for number, _, written in files
            if known is not None and number < known and written > self._last_written_ns
        ]
        if again and min(again)[0] <= self._first:
            self.counts.restarts += 1
            self._run_started_ns = min(written for _, written in again)
            self._first = self._next = min(again)[0]
            self._waiting, self._stalled_ns = {}, None
        if self._next is None:
            self._first = self._next = min(number for number, _, _ in files)
        first = self._next
        self._waiting = {
            number: path
            for number, path, written in files
            if number >= first and written >= self._run_started_ns
        }
        if self._waiting:
            self._name = _LAST_NUMBER.match(self._waiting[min(self._waiting)].name)

    def _files(self) -> list[tuple[int, Path, int]]:
        """Frame number, path and time of the last write [ns]; none where the folder is gone."""
        files = []
        try:
            with os.scandir(self._folder) as entries:
                for entry in entries:
                    number = frame_number(entry.name)
                    if number is None:
                        continue
                    try:
                        written = entry.stat().st_mtime_ns
                    except FileNotFoundError:
                        continue
                    files.append((number, Path(entry.path), written))
        except (FileNotFoundError, NotADirectoryError):
            return []
        return files

    def _path_of(self, number: int) -> Path:
        """The name that frame `number` will have, going by the names so far."""
        if self._name is None:
            return self._folder / f"{number}.json"
        start, digits, end = self._name.groups()
        return self._folder / f"{start}{number:0{len(digits)}d}{end}"


def _written_ns(path: Path) -> int:
    try:
        return path.stat().st_mtime_ns
    except FileNotFoundError:
        return -1
