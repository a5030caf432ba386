"""Frames of several cameras that belong together.

A plan (N, C) says which frame of each camera belongs to each of N instants, -1 where a camera has
none. It is made from timestamps alone; `frame_sets` then decodes along it, one instant at a time.
Two plans:

    nearest_frames     at given instants, each camera's nearest frame; a frame may serve twice
    every_frame        each frame of each camera exactly once

Both hold frames together that are at most half a frame period apart. Worked number: of two cameras
at 60 and 120 Hz that start together, `nearest_frames` at the first one's times pairs each of its
frames with every second one of the other; `every_frame` adds instants for the rest.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Int

from fusecap.sources.video import Video, VideoFrame


@dataclass(frozen=True, slots=True, kw_only=True)
class FrameSet:
    """What the cameras saw at one instant."""

    timestamp_ns: int
    """On the session's clock."""
    frames: tuple[VideoFrame | None, ...]
    """Per camera; None where it has no frame that can be decoded."""


@dataclass(frozen=True, kw_only=True)
class FramePlan:
    """Which frames belong together."""

    timestamps_ns: Int[np.ndarray, " n"]
    """On the session's clock, ascending."""
    frame: Int[np.ndarray, "n c"]
    """Frame numbers; -1: none."""

    def __len__(self) -> int:
        return len(self.timestamps_ns)


def clock_times_ns(video: Video, offset_s: float = 0.0) -> Int[np.ndarray, " f"]:
    """When each frame was exposed, on the session's clock."""
    return video.times_ns + round(offset_s * 1e9)


def nearest_frames(
    times_ns: Sequence[Int[np.ndarray, " f"]], instants_ns: Int[np.ndarray, " n"]
) -> FramePlan:
    """At each instant every camera's nearest frame, at most half its own frame period away."""
    frame = np.full((len(instants_ns), len(times_ns)), -1, dtype=np.int64)
    for camera, own in enumerate(times_ns):
        after = np.clip(np.searchsorted(own, instants_ns), 1, max(len(own) - 1, 1))
        before = after - 1
        after = np.minimum(after, len(own) - 1)
        nearer = np.where(
            np.abs(own[before] - instants_ns) <= np.abs(own[after] - instants_ns), before, after
        )
        near = np.abs(own[nearer] - instants_ns) <= _period_ns(own) / 2
        frame[near, camera] = nearer[near]
    return FramePlan(timestamps_ns=np.asarray(instants_ns, dtype=np.int64), frame=frame)


def every_frame(times_ns: Sequence[Int[np.ndarray, " f"]]) -> FramePlan:
    """Instants that hold each frame once; an instant has the time of its earliest frame.

    An instant takes the next frame of every camera that comes within half the shortest frame
    period of the earliest one.
    """
    reach_ns = min((_period_ns(own) for own in times_ns), default=0.0) / 2
    following = [0] * len(times_ns)
    stamps, rows = [], []
    while True:
        waiting = [
            int(own[n]) if n < len(own) else None
            for own, n in zip(times_ns, following, strict=True)
        ]
        earliest = min((t for t in waiting if t is not None), default=None)
        if earliest is None:
            break
        taken = [t is not None and t <= earliest + reach_ns for t in waiting]
        rows.append([n if take else -1 for n, take in zip(following, taken, strict=True)])
        stamps.append(earliest)
        following = [n + take for n, take in zip(following, taken, strict=True)]
    return FramePlan(
        timestamps_ns=np.array(stamps, dtype=np.int64),
        frame=np.array(rows, dtype=np.int64).reshape(len(rows), len(times_ns)),
    )


def frame_sets(videos: Sequence[Video], plan: FramePlan) -> Iterator[FrameSet]:
    """Decodes along a plan whose frame numbers do not go back; holds one picture per camera."""
    cursors = [_Cursor(video, plan.frame[:, camera]) for camera, video in enumerate(videos)]
    for instant in range(len(plan)):
        yield FrameSet(
            timestamp_ns=int(plan.timestamps_ns[instant]),
            frames=tuple(
                cursor.at(int(number))
                for cursor, number in zip(cursors, plan.frame[instant], strict=True)
            ),
        )


class _Cursor:
    """Reads one video forwards; opens it at the first frame that is asked for."""

    def __init__(self, video: Video, wanted: Int[np.ndarray, " n"]) -> None:
        wanted = wanted[wanted >= 0]
        self._frames = video.frames(first=int(wanted[0])) if len(wanted) else iter(())
        self._held: VideoFrame | None = None

    def at(self, number: int) -> VideoFrame | None:
        """Frame `number`; None for -1 and for one that cannot be decoded."""
        if number < 0:
            return None
        while self._held is None or self._held.number < number:
            following = next(self._frames, None)
            if following is None:
                return None
            self._held = following
        return self._held if self._held.number == number else None


def _period_ns(times_ns: np.ndarray) -> float:
    """The usual distance between frames; a single frame holds for 1/30 s."""
    return float(np.median(np.diff(times_ns))) if len(times_ns) > 1 else 1e9 / 30
