"""A take against a data set's truth, and the table of several."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from fusecap.errors import InputError
from fusecap.evaluate.datasets.recording import Truth
from fusecap.evaluate.metrics import (
    Summary,
    aligned_error_m,
    identity_switches,
    match_people,
    orientation_error_rad,
    position_error_m,
    root_relative_error_m,
    summarize,
)
from fusecap.evaluate.tables import Table, Value
from fusecap.files import written_whole
from fusecap.take import Take


@dataclass(frozen=True, kw_only=True)
class TruthScore:
    """Errors over the places, frames and people that have truth and were found."""

    position_error_mm: Summary
    root_relative_error_mm: Summary
    """Relative to the hips or mid-hip; else to the first place."""
    aligned_error_mm: Summary
    """After Procrustes; of frames in which every place is known."""
    orientation_error_deg: Summary
    """Empty where the truth has no orientations."""
    point_error_mm: dict[str, float]
    """Mean per place."""
    found_share: float
    """Of the true person-frames."""
    identity_switches: int


def score_truth(take: Take, truth: Truth, rate_hz: float, *, gate_m: float = 0.5) -> TruthScore:
    """Score every frame that has truth; people are matched frame by frame, by distance.

    A truth without positions (orientations of one person) is matched to the take's only person.
    """
    people, frames = truth.points_in_world_m.shape[:2]
    numbers = np.round(take.timestamps_ns * 1e-9 * rate_hz).astype(np.int64)
    known = (numbers >= 0) & (numbers < frames)
    points = np.full((len(take.subject_names), *truth.points_in_world_m.shape[1:]), np.nan)
    points[:, numbers[known]] = truth.points_of(take)[:, known]
    true = truth.points_in_world_m
    somewhere = np.isfinite(true).all(axis=-1).any(axis=-1)
    if somewhere.any():
        match = match_people(points, true, gate_m=gate_m)
    elif people == 1 and len(points) == 1:
        match = np.where(np.isfinite(points[:, :, 0, 0]), 0, -1)
        somewhere = np.ones_like(somewhere)
    else:
        raise InputError("a truth without positions needs one person, and a take of one person")
    person, frame = np.nonzero(match >= 0)
    found = match[person, frame]
    x, y = points[found, frame], true[person, frame]
    error_mm = position_error_m(x, y) * 1e3
    root = next((truth.names.index(r) for r in _ROOTS if r in truth.names), 0)
    from_root = [root, *(row for row in range(len(truth.names)) if row != root)]
    orientation_deg = np.zeros(0)
    rotations = truth.rotations_of(take)
    if rotations is not None and truth.rotation_in_world is not None:
        estimate = np.full((len(points), *truth.rotation_in_world.shape[1:]), np.nan)
        estimate[:, numbers[known]] = rotations[:, known]
        orientation_deg = np.degrees(
            orientation_error_rad(estimate[found, frame], truth.rotation_in_world[person, frame])
        )
    return TruthScore(
        position_error_mm=summarize(error_mm),
        root_relative_error_mm=summarize(
            root_relative_error_m(x[:, from_root], y[:, from_root]) * 1e3
        ),
        aligned_error_mm=summarize(aligned_error_m(x, y) * 1e3),
        orientation_error_deg=summarize(orientation_deg),
        point_error_mm={
            name: summarize(error_mm[:, row]).mean for row, name in enumerate(truth.names)
        },
        found_share=len(found) / int(somewhere.sum()) if somewhere.any() else np.nan,
        identity_switches=identity_switches(match),
    )


_ROOTS = ("hips", "mid_hip")

COLUMNS = (
    "sequence",
    "position mm",
    "std",
    "median",
    "MAD",
    "to root mm",
    "Procrustes mm",
    "orientation deg",
    "std deg",
    "found %",
    "switches",
)


def score_table(title: str, scores: Sequence[tuple[str, TruthScore]], *, note: str = "") -> Table:
    """A row per sequence, and their mean."""
    rows = tuple((name, *_row(score)) for name, score in scores)
    return _with_mean(Table(title=title, columns=COLUMNS, rows=rows, note=note))


def mean_by_name(table: Table) -> Table:
    """The means of the rows that share a name, and the mean of those."""
    rows: dict[str, list[tuple[Value, ...]]] = {}
    for row in table.rows[: -1 if len(table.rows) > 1 else None]:
        rows.setdefault(str(row[0]), []).append(row[1:])
    means = tuple((name, *_mean(some)) for name, some in rows.items())
    return _with_mean(replace(table, rows=means))


def _with_mean(table: Table) -> Table:
    if len(table.rows) < 2:
        return table
    mean = ("mean", *_mean([row[1:] for row in table.rows]))
    return replace(table, rows=(*table.rows, mean))


def _mean(rows: Sequence[tuple[Value, ...]]) -> tuple[float, ...]:
    """Per column, over the rows that have a value."""
    values = np.array(rows, dtype=np.float64)
    known = np.isfinite(values)
    total = np.where(known, values, 0.0).sum(axis=0)
    count = known.sum(axis=0)
    return tuple(np.where(count > 0, total / np.maximum(count, 1), np.nan).tolist())


def _row(score: TruthScore) -> tuple[float | int, ...]:
    position, orientation = score.position_error_mm, score.orientation_error_deg
    return (
        position.mean,
        position.std,
        position.median,
        position.mad,
        score.root_relative_error_mm.mean,
        score.aligned_error_mm.mean,
        orientation.mean,
        orientation.std,
        100.0 * score.found_share,
        score.identity_switches,
    )


def write_table(table: Table, out: Path, name: str) -> list[Path]:
    """Markdown, CSV and JSON; returns their paths."""
    texts = {
        ".md": table.markdown(),
        ".csv": table.csv(),
        ".json": json.dumps(table.as_json(), indent=1) + "\n",
    }
    files = []
    for suffix, text in texts.items():
        files.append(out / f"{name}{suffix}")
        with written_whole(files[-1]) as file:
            file.write(text.encode())
    return files
