"""Motion files of any kind as the people of a scene."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from fusecap.body.shape import REFERENCE_HEIGHT_M, BodyShape
from fusecap.body.skeleton import PAPER21
from fusecap.errors import InputError
from fusecap.evaluate.simulator import at_times, placed
from fusecap.inputs import MOTION, read_text
from fusecap.motion.files import motion_formats
from fusecap.motion.retarget import retarget
from fusecap.stored_take import load_take


@dataclass(frozen=True, kw_only=True)
class MotionClip:
    """One person's motion in its own time and place."""

    name: str
    theta: Float[np.ndarray, "t p"]
    shape: BodyShape
    rate_hz: float
    own_place: bool
    """Whether its place is that of others of the same file, so that it must be kept."""

    @property
    def duration_s(self) -> float:
        """From the first frame to the last."""
        return (len(self.theta) - 1) / self.rate_hz

    def at_rate(self, rate_hz: float, duration_s: float) -> Float[np.ndarray, "t p"]:
        """The first seconds of it at another rate."""
        times_s = np.arange(int(np.floor(duration_s * rate_hz + 1e-6)) + 1) / rate_hz
        return at_times(self.theta, self.rate_hz, times_s)

    def of_height(self, height_m: float) -> MotionClip:
        """The same motion by a person of that stature, with its proportions."""
        shape = BodyShape.from_height(self.shape.skeleton, height_m)
        theta = placed(self.theta, scale=height_m / self.shape.height_m)
        return MotionClip(
            name=self.name,
            theta=theta,
            shape=shape,
            rate_hz=self.rate_hz,
            own_place=self.own_place,
        )


def load_motion(path: Path) -> list[MotionClip]:
    """A motion file holds one person, a take any number.

    Raises `InputError` where the file is missing, broken or of another kind.
    """
    suffix = path.suffix.lower()
    if suffix == ".npz":
        return _of_take(path)
    formats = motion_formats()
    if suffix not in formats:
        known = ", ".join(format.what for format in formats.values())
        raise InputError(f"{path}: no motion that is known; expected {known} or a take (.npz)")
    format = formats[suffix]
    others = sorted(path.parent.glob(f"*{format.beside}")) if format.beside else []
    motion = format.parse(_text(path), str(path), {str(other): _text(other) for other in others})
    return [
        MotionClip(
            name=path.stem,
            theta=retarget(motion, PAPER21),
            shape=BodyShape.from_height(PAPER21, REFERENCE_HEIGHT_M),
            rate_hz=motion.rate_hz,
            own_place=False,
        )
    ]


def _text(path: Path) -> str:
    return read_text(path, MOTION, strict=False)


def _of_take(path: Path) -> list[MotionClip]:
    take = load_take(path)
    clips = []
    for index, name in enumerate(take.subject_names):
        if not take.tracked[index].all():
            missing = int(np.argmin(take.tracked[index]))
            raise InputError(
                f"{path}: '{name}' is not tracked in frame {missing}; a simulation needs motion "
                "without gaps"
            )
        clips.append(
            MotionClip(
                name=name,
                theta=take.theta[index],
                shape=take.shape(index),
                rate_hz=take.rate_hz,
                own_place=len(take.subject_names) > 1,
            )
        )
    return clips


def spread_out(
    clips: Sequence[MotionClip], *, spacing_m: float, circle_m: float
) -> list[tuple[float, float] | None]:
    """Per clip where the middle of its path goes (x, z), None to leave it where it is.

    On a circle of at least `circle_m` round the origin, neighbours at least `spacing_m` apart.
    """
    free = [clip for clip in clips if not clip.own_place]
    radius = circle_m
    if len(free) > 1:
        radius = max(radius, spacing_m / 2 / np.sin(np.pi / len(free)))
    places: list[tuple[float, float] | None] = []
    for clip in clips:
        if clip.own_place:
            places.append(None)
            continue
        angle = 2 * np.pi * sum(place is not None for place in places) / len(free) + np.pi / 2
        places.append((float(radius * np.sin(angle)), float(radius * np.cos(angle))))
    return places
