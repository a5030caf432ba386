"""What the sorter thinks, seen from above: subjects, candidates, bystanders, cameras.

Subjects stand where they were solved, candidates where their keypoints were triangulated. A
bystander is a detection that belongs to neither: one camera alone says where, by the ray through
the ankles to the floor. Drawn as SVG, x to the right and z down, as one who stands at +z sees it.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from fusecap.body.landmarks import LandmarkSet
from fusecap.engine.engine import LiveStep
from fusecap.geometry.camera import Camera, Rig
from fusecap.types import TrackState
from fusecap.viewer.palette import Rgb, css, escaped

_WIDTH = 320
"""Of the drawing, in its own units."""
_LEAST_HALF_M = 2.5
_MARGIN_M = 0.6
_ANKLE_HEIGHT_M = 0.07
_FARTHEST_M = 15.0
"""From the camera; beyond, the ray says nothing."""
BYSTANDER = "bystander, as one camera sees them"
_SEEN = 0.1
"""Confidence from which a keypoint counts."""


@dataclass(frozen=True, slots=True, kw_only=True)
class FloorPlan:
    """Places on the floor: x, z [m]."""

    subjects: Mapping[str, Float[np.ndarray, "2"]]
    candidates: tuple[Float[np.ndarray, "2"], ...]
    bystanders: tuple[Float[np.ndarray, "2"], ...]


def floor_plan(step: LiveStep, rig: Rig, landmarks: LandmarkSet) -> FloorPlan:
    """Who is where at one instant."""
    candidates = []
    for update in step.step.updates:
        points = update.landmarks_in_world_m[:, [0, 2]]
        points = points[np.isfinite(points).all(axis=1)]
        if update.state is TrackState.TENTATIVE and len(points):
            candidates.append(np.median(points, axis=0))
    return FloorPlan(
        subjects={
            name: estimate.bone_position_in_world_m[0, [0, 2]]
            for name, estimate in step.people.items()
            if estimate is not None
        },
        candidates=tuple(candidates),
        bystanders=tuple(_bystanders(step, rig, landmarks)),
    )


def _bystanders(
    step: LiveStep, rig: Rig, landmarks: LandmarkSet
) -> Iterator[Float[np.ndarray, "2"]]:
    for row, camera in enumerate(rig.cameras):
        taken = [int(update.person[row]) for update in step.step.updates]
        people = step.detections.people[row]
        free = [index for index in range(len(people)) if index not in taken]
        yield from standing_places(camera, landmarks, people[free])


def standing_places(
    camera: Camera, landmarks: LandmarkSet, people: Float[np.ndarray, "n k 3"]
) -> Iterator[Float[np.ndarray, "2"]]:
    """Where on the floor (x, z) people stand whose ankles one camera sees."""
    ankles = [i for n in ("left_ankle", "right_ankle") if (i := landmarks.index(n)) is not None]
    for feet in people[:, ankles]:
        feet = feet[feet[:, 2] >= _SEEN, :2]
        place = _on_floor(camera, feet.mean(axis=0)) if len(feet) else None
        if place is not None:
            yield place


def _on_floor(camera: Camera, pixel: Float[np.ndarray, "2"]) -> Float[np.ndarray, "2"] | None:
    x, y = camera.undistort(pixel[None])[0]
    ray = camera.rotation.T @ [x, y, 1.0]
    eye = camera.position_in_world
    if ray[1] >= -1e-6:
        return None
    along = (_ANKLE_HEIGHT_M - eye[1]) / ray[1]
    place = (eye + along * ray)[[0, 2]]
    return place if 0 < np.linalg.norm(place - eye[[0, 2]]) < _FARTHEST_M else None


class FloorDrawing:
    """Draws plans of one room."""

    def __init__(self, rig: Rig) -> None:
        places = [camera.position_in_world[[0, 2]] for camera in rig.cameras]
        corners = np.array([*places, [-_LEAST_HALF_M] * 2, [_LEAST_HALF_M] * 2])
        self._low_m = corners.min(axis=0) - _MARGIN_M
        self._size_m = corners.max(axis=0) + _MARGIN_M - self._low_m
        self._scale = _WIDTH / self._size_m[0]
        self._height = float(self._size_m[1] * self._scale)
        self._still = self._grid() + "".join(self._camera(camera) for camera in rig.cameras)

    def svg(self, plan: FloorPlan, colours: Mapping[str, Rgb], *, cross: str = BYSTANDER) -> str:
        """For a page; names are escaped; `cross` says what a cross is."""
        marks = [self._mark(place, "×", cross, "#888") for place in plan.bystanders]
        marks += [self._mark(place, "?", "candidate", "#333") for place in plan.candidates]
        for name, place in plan.subjects.items():
            x, y = self._at(place)
            marks.append(
                f'<circle cx="{x:.1f}" cy="{y:.1f}" r="7" fill="{css(colours[name])}"/>'
                f'<text x="{x:.1f}" y="{y - 10:.1f}" text-anchor="middle" font-size="12" '
                f'font-weight="bold" fill="#222">{escaped(name)}</text>'
            )
        return (
            f'<div style="margin:4px 12px"><svg viewBox="0 0 {_WIDTH} {self._height:.0f}" '
            'style="width:100%;max-height:300px;display:block;background:#fafafa" '
            f'font-family="sans-serif">{self._still}{"".join(marks)}</svg>'
            '<div style="font-size:0.8em;opacity:0.8;margin:2px 0">&#9679; subject &nbsp; '
            f"? candidate &nbsp; × {cross} &nbsp; &#9651; camera; a square is 1 m</div></div>"
        )

    def _at(self, place_m: Float[np.ndarray, "2"]) -> tuple[float, float]:
        """In the drawing; who is outside stands at its edge."""
        x, y = np.clip(place_m - self._low_m, 0.1, self._size_m - 0.1) * self._scale
        return float(x), float(y)

    def _mark(self, place_m: Float[np.ndarray, "2"], symbol: str, title: str, colour: str) -> str:
        x, y = self._at(place_m)
        return (
            f'<text x="{x:.1f}" y="{y:.1f}" text-anchor="middle" dominant-baseline="central" '
            f'font-size="17" font-weight="bold" fill="{colour}">{symbol}<title>{title}</title>'
            "</text>"
        )

    def _grid(self) -> str:
        lines = []
        for metre in range(int(np.ceil(self._low_m[0])), int(self._low_m[0] + self._size_m[0]) + 1):
            x = (metre - self._low_m[0]) * self._scale
            lines.append(f"M{x:.1f} 0V{self._height:.1f}")
        for metre in range(int(np.ceil(self._low_m[1])), int(self._low_m[1] + self._size_m[1]) + 1):
            y = (metre - self._low_m[1]) * self._scale
            lines.append(f"M0 {y:.1f}H{_WIDTH}")
        return f'<path d="{"".join(lines)}" stroke="#e4e4e4" fill="none"/>'

    def _camera(self, camera: Camera) -> str:
        x, y = self._at(camera.position_in_world[[0, 2]])
        ahead = camera.rotation[2, [0, 2]]
        turn_deg = float(np.degrees(np.arctan2(ahead[1], ahead[0])))
        side = "start" if x < _WIDTH / 2 else "end"
        return (
            f'<path d="M0 0L13 -6V6Z" fill="none" stroke="#46464f" stroke-width="1.5" '
            f'transform="translate({x:.1f} {y:.1f}) rotate({turn_deg:.0f})"/>'
            f'<text x="{x:.1f}" y="{y + (18 if ahead[1] < 0 else -10):.1f}" text-anchor="{side}" '
            f'font-size="10" fill="#555">{escaped(camera.name)}</text>'
        )
