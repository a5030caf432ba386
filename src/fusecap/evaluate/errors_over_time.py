"""How far each person of a take is from the truth, frame by frame: to be plotted."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from fusecap.errors import TakeError
from fusecap.evaluate.metrics import match_people, orientation_error_rad, position_error_m
from fusecap.evaluate.score import same_instants
from fusecap.take import Take


@dataclass(frozen=True, kw_only=True)
class ErrorsOverTime:
    """Per person of the take; NaN in frames that match no true person."""

    position_mm: dict[str, Float[np.ndarray, "t b"]]
    orientation_deg: dict[str, Float[np.ndarray, "t b"]]


def errors_over_time(take: Take, truth: Take, *, gate_m: float = 0.5) -> ErrorsOverTime:
    """People are matched frame by frame, by distance; raises `TakeError` as `score_take` does."""
    if take.bone_names != truth.bone_names:
        raise TakeError("the take and its truth have different skeletons")
    rows, true_rows = same_instants(take.timestamps_ns, truth.timestamps_ns)
    if len(rows) == 0:
        raise TakeError("the take and its truth share no timestamp")
    position_m = take.bone_position_in_world_m[:, rows]
    true_position_m = truth.bone_position_in_world_m[:, true_rows]
    match = match_people(position_m, true_position_m, gate_m=gate_m)
    true_rotations = [truth.bone_rotation_in_world(row)[true_rows] for row in range(len(match))]
    position_mm, orientation_deg = {}, {}
    for person, name in enumerate(take.subject_names):
        rotation = take.bone_rotation_in_world(person)[rows]
        millimetres = np.full(take.bone_sigma_deg.shape[1:], np.nan)
        degrees = np.full(take.bone_sigma_deg.shape[1:], np.nan)
        for true_person, matched in enumerate(match == person):
            at = rows[matched]
            millimetres[at] = 1e3 * position_error_m(
                position_m[person, matched], true_position_m[true_person, matched]
            )
            degrees[at] = np.degrees(
                orientation_error_rad(rotation[matched], true_rotations[true_person][matched])
            )
        position_mm[name], orientation_deg[name] = millimetres, degrees
    return ErrorsOverTime(position_mm=position_mm, orientation_deg=orientation_deg)
