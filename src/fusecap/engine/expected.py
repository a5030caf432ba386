"""Where people are expected in each view before its next picture is looked at.

Everyone the pipeline follows is predicted to the instant in the world and projected into every
view, also into those that had lost them. Detections that belong to nobody it follows (newcomers,
bystanders, false ones) are expected where they were, unless there is no place for anybody else.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from fusecap.geometry.camera import Camera, Rig
from fusecap.pipeline import Pipeline, Step

People = Float[np.ndarray, "n k 3"]


def expected_people(
    rig: Rig, pipeline: Pipeline, step: Step, people: Sequence[People], now_ns: int
) -> list[People]:
    """Per camera the people expected at `now_ns`: x, y [px], confidence; NaN, NaN, 0 unknown.

    `step` is the pipeline's last, `people` what it was given. Projections may lie outside the
    image.
    """
    names = {update.track_id: update.name for update in step.updates}
    followed = {estimate.track_id for estimate in step.estimates}
    points = pipeline.predicted([names[track_id] for track_id in sorted(followed)], now_ns)
    expected = []
    for index, camera in enumerate(rig.cameras):
        taken = {u.person[index].item() for u in step.updates if u.track_id in followed}
        others = range(0 if pipeline.is_full else len(people[index]))
        free = [n for n in others if n not in taken]
        projected = [_projected(camera, point) for point in points]
        visible = [p[None] for p in projected if _is_in_view(camera, p)]
        expected.append(np.concatenate([*visible, people[index][free]]))
    return expected


def _projected(camera: Camera, points_m: Float[np.ndarray, "k 3"]) -> Float[np.ndarray, "k 3"]:
    pixels = camera.project(points_m)
    return np.concatenate([pixels, np.isfinite(pixels).all(axis=1, keepdims=True)], axis=1)


def _is_in_view(camera: Camera, person: Float[np.ndarray, "k 3"]) -> bool:
    xy = person[np.isfinite(person[:, 0]), :2]
    inside = np.all((xy >= -0.5) & (xy <= np.array(camera.size_px) - 0.5), axis=1)
    return bool(inside.any())
