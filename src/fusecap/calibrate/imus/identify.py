"""Which sensor is on which bone, from motion alone.

For every sensor and bone the best mounting and heading are fitted, and the pair scored by how
likely the remaining errors are. A wrong pair leaves large ones however it is mounted, left and
right included, unless both bones moved alike. The score is the logarithm of Student's density with
`FREEDOM` degrees of freedom, per instant: heavy tails, as jumping keypoints need, and with the
determinant of the covariance, so a bone of which the cameras see little is not everyone's best fit.
The assignment with the best sum is found exactly (Hungarian method); how sure it is of a sensor is
the sum it would lose, per instant, if that sensor and any other changed places.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.optimize import linear_sum_assignment

from fusecap.calibrate.imus.fit import Fit, Pairs, fit, make_pairs
from fusecap.calibrate.imus.reference import ReferenceMotion
from fusecap.calibrate.imus.speeds import angular_speed, correlation

FREEDOM = 3.0
SURE = 0.4
"""A margin above this is never reached by chance (docs/imu_calibration.md has how often)."""
MAX_INSTANTS = 150
WEARABLE = ("hips", "spine3", "head") + tuple(
    f"{side}_{part}"
    for part in ("upper_arm", "forearm", "thigh", "shank", "foot")
    for side in ("left", "right")
)
"""Bones that sensors are worn on and cameras tell apart."""


@dataclass(frozen=True, kw_only=True)
class Identity:
    """What motion says about one sensor."""

    stated: str
    found: str
    margin: float
    """Of the found bone over the runner-up; `SURE` is sure."""
    runner_up: str
    speed_correlation: float
    """Of its angular speed with that of the found bone."""

    @property
    def contradicts(self) -> bool:
        """The sensor is surely on another bone than stated."""
        return self.found != self.stated and self.margin > SURE


def identify(
    reference: ReferenceMotion,
    stated: Sequence[str],
    sensors: Float[np.ndarray, "i t 3 3"],
    *,
    among: Sequence[str] = WEARABLE,
) -> tuple[Identity, ...]:
    """The best assignment of sensors (orientations at the reference's instants) to bones.

    Candidates are the stated bones, each for as many sensors as are stated on it, and those of
    `among`.
    """
    bones = [*stated, *(bone for bone in among if bone not in stated)]
    step = max(1, len(reference.times_s) // MAX_INSTANTS)
    times_s = reference.times_s[::step]
    score = np.full((len(stated), len(bones)), -np.inf)
    for row, sensor in enumerate(sensors):
        for column, bone in enumerate(bones):
            index = reference.skeleton.bone(bone)
            pairs = make_pairs(
                times_s,
                reference.rotation_in_world[::step, index],
                reference.covariance_rad2[::step, index],
                sensor[::step],
            )
            if len(pairs) >= 10:
                score[row, column] = log_likelihood(pairs, fit(pairs, max_iterations=6))
    score[~np.isfinite(score)] = -1e3
    rows, columns = linear_sum_assignment(-score)
    found = []
    for row, column in zip(rows.tolist(), columns.tolist(), strict=True):
        loss = np.array(
            [
                score[row, column]
                - score[row, other]
                + _displaced(score, rows, columns, row, other)
                for other in range(len(bones))
            ]
        )
        loss[[bone == bones[column] for bone in bones]] = np.inf
        other = int(np.argmin(loss))
        index = reference.skeleton.bone(bones[column])
        speeds = [
            angular_speed(reference.times_s, rotation, reference.times_s)
            for rotation in (sensors[row], reference.rotation_in_world[:, index])
        ]
        found.append(
            Identity(
                stated=stated[int(row)],
                found=bones[column],
                margin=float(loss[other]),
                runner_up=bones[other],
                speed_correlation=correlation(speeds[0], speeds[1]),
            )
        )
    return tuple(found)


def log_likelihood(pairs: Pairs, fitted: Fit) -> float:
    """Mean over instants of Student's log density of e, up to a constant."""
    error = fitted.errors(pairs)
    information = pairs.information * len(pairs) / max(len(np.unique(pairs.block)), 1)
    squared = np.einsum("ni,nij,nj->n", error, information, error)
    _, log_determinant = np.linalg.slogdet(information)
    tails = (FREEDOM + 3) / 2 * np.log1p(squared / FREEDOM)
    return float(np.mean(0.5 * log_determinant - tails))


def _displaced(
    score: Float[np.ndarray, "i b"],
    rows: np.ndarray,
    columns: np.ndarray,
    row: int,
    other: int,
) -> float:
    """What the sensor on bone `other` loses if it takes the bone of sensor `row`."""
    holder = rows[columns == other]
    if not len(holder):
        return 0.0
    own = columns[rows == row][0]
    return float(score[holder[0], other] - score[holder[0], own])
