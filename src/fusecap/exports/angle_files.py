"""Joint angles as tables: CSV for everybody together, MOT per person, CSV of gait cycles.

    frame,time_s,person,left_hip_flexion_deg,...,left_hip_flexion_sd_deg,...

An empty cell stands where the person is not tracked.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np

from fusecap.angles.gait import PERCENT, GaitCycles
from fusecap.angles.joint_angles import JointAngles
from fusecap.exports.opensim import write_motion
from fusecap.files import written_whole


def write_angles_csv(angles: JointAngles, path: Path) -> None:
    """One row per frame and person, whole or not at all."""
    head = [f"{name}_deg" for name in angles.names] + [f"{name}_sd_deg" for name in angles.names]
    deg, sd_deg = angles.deg, angles.sd_deg
    _write_csv(
        path,
        ["frame", "time_s", "person", *head],
        (
            [frame, f"{time_s:.6f}", person, *_cells(deg[row, frame]), *_cells(sd_deg[row, frame])]
            for frame, time_s in enumerate(angles.time_s.tolist())
            for row, person in enumerate(angles.subject_names)
        ),
    )


def write_angles_mot(angles: JointAngles, subject: int, path: Path) -> None:
    """One person's table for OpenSim's tools; a frame without the person has no row."""
    names = [*angles.names, *(f"{name}_sd" for name in angles.names)]
    values = np.concatenate([angles.deg[subject], angles.sd_deg[subject]], axis=1)
    tracked = np.isfinite(values).all(axis=1)
    write_motion(path, "Angles", names, angles.time_s[tracked], values[tracked])


def write_gait_csv(people: Sequence[tuple[str, GaitCycles]], path: Path) -> None:
    """A tidy table of mean and band over each person's and side's cycles."""
    _write_csv(
        path,
        ["person", "side", "cycles", "angle", "percent", "mean_deg", "band_deg"],
        (
            [person, gait.side, len(gait.deg), name, int(percent), *_cells(pair)]
            for person, gait in people
            for column, name in enumerate(gait.names)
            for percent, pair in zip(
                PERCENT,
                np.stack([gait.mean_deg[:, column], gait.band_deg[:, column]], axis=1),
                strict=True,
            )
            if len(gait.deg)
        ),
    )


def _write_csv(path: Path, head: list[str], rows: Iterable[list[object]]) -> None:
    with written_whole(path) as file:
        text = io.TextIOWrapper(file, encoding="utf-8", newline="")
        table = csv.writer(text, lineterminator="\n")
        table.writerow(head)
        table.writerows(rows)
        text.flush()
        text.detach()


def _cells(values: np.ndarray) -> list[str]:
    return [f"{value:.4f}" if np.isfinite(value) else "" for value in values.tolist()]
