"""What solving instants together brings: the newest pose, one settled for a while, and a take.

Not one of the paper's: its first future work. Positions are from the root where what is constant
(where the rig stands) would hide the rest.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import pairwise

import numpy as np
from matplotlib.figure import Figure

from fusecap.body.skeleton import PAPER21
from fusecap.evaluate.cells import LATE_S, TwinCell
from fusecap.evaluate.experiments.experiment import (
    Claim,
    Experiment,
    Report,
    Results,
    Settings,
    below,
    both,
)
from fusecap.evaluate.tables import Table, Value
from fusecap.solve.options import BETWEEN

INPUTS = ((8, 13), (2, 6), (3, 0), (1, 13), (1, 0), (0, 13))
QUICK = ((8, 13), (1, 13))
KINDS = ("newest", "settled", "score")
"""Of a result: live as it comes, live late, the take."""
COLUMNS = ("alone", "newest pose", f"{1e3 * LATE_S:.0f} ms late", "take")
ERRORS = {
    "global position mm": ("position_error_mm", "mean"),
    "position from the root mm": ("root_relative_error_mm", "mean"),
    "orientation deg": ("orientation_error_deg", "mean"),
    "acceleration error m/s2": ("acceleration_error_m_s2",),
    "jitter km/s3": ("jitter_km_s3",),
    "foot skate m/s": ("foot_skate_m_s",),
}
SHOWN = 240
"""Frames of the plots."""
TRUTHS = {"jitter km/s3": "true_jitter_km_s3", "foot skate m/s": "true_foot_skate_m_s"}


def _inputs(settings: Settings) -> tuple[tuple[int, int], ...]:
    return QUICK if settings.quick else INPUTS


def _row(settings: Settings, cameras: int, imus: int, *, alone: bool) -> list[TwinCell]:
    between = dict.fromkeys(BETWEEN, 0.0) if alone else {}
    return [
        settings.cell(
            scene, cameras=cameras, imus=imus, live=not alone, weights=between, trace=True
        )
        for scene in settings.sequences
    ]


def cells(settings: Settings) -> list[TwinCell]:
    return [
        cell
        for given in _inputs(settings)
        for alone in (True, False)
        for cell in _row(settings, *given, alone=alone)
    ]


def report(settings: Settings, results: Results) -> Report:
    tables = []
    for title, path in ERRORS.items():
        rows: list[tuple[Value, ...]] = []
        for cameras, imus in _inputs(settings):
            before = _row(settings, cameras, imus, alone=True)
            after = _row(settings, cameras, imus, alone=False)
            values = [results.mean(before, "score", *path)]
            values += [results.mean(after, kind, *path) for kind in KINDS]
            if title in TRUTHS:
                values.append(results.mean(after, "score", TRUTHS[title]))
            rows.append((_named(cameras, imus), *values))
        truth = ("truth",) if title in TRUTHS else ()
        digits = 2 if title in TRUTHS or title.startswith("acc") else 1
        tables.append(
            Table(title=title, columns=("input", *COLUMNS, *truth), rows=tuple(rows), digits=digits)
        )
    tables.append(_ahead(settings, results))
    tables.append(_error_bars(settings, results))
    return Report(
        tables=tuple(tables),
        findings=tuple(_findings(settings, results)),
        plots={"": _plot(settings, results)},
    )


def _ahead(settings: Settings, results: Results) -> Table:
    """What is known of this very moment while its pictures are still on their way."""
    rows: list[tuple[Value, ...]] = []
    for cameras, imus in _inputs(settings):
        cells = _row(settings, cameras, imus, alone=False)
        errors = (ERRORS["global position mm"], ERRORS["orientation deg"])
        values = [results.mean(cells, kind, *e) for e in errors for kind in ("seen", "ahead")]
        rows.append((_named(cameras, imus), *values))
    return Table(
        title=f"Pictures {1e3 * LATE_S:.0f} ms late: global position mm, orientation deg",
        columns=("input", "seen: mm", "ahead: mm", "seen: deg", "ahead: deg"),
        rows=tuple(rows),
        note="Seen: the last pose that pictures reached; ahead: by sensors and motion since.",
    )


def _error_bars(settings: Settings, results: Results) -> Table:
    """Squared errors over variances: what they come to per bone, over all sequences."""
    rows: list[tuple[Value, ...]] = []
    for cameras, imus in _inputs(settings):
        cells = _row(settings, cameras, imus, alone=False)
        values: list[Value] = []
        for kind in ("newest", "score"):
            for what in ("bone_orientation_variance_ratio", "bone_position_variance_ratio"):
                bones = sorted(results.mean(cells, kind, what, bone) for bone in PAPER21.bone_names)
                middle = bones[len(bones) // 2]
                values.append(f"{middle:.2f} ({bones[0]:.2f}-{bones[-1]:.2f})")
        rows.append((_named(cameras, imus), *values))
    return Table(
        title="Squared error over variance: the median bone (least - most)",
        columns=(
            "input",
            "newest pose: rotation",
            "newest pose: place",
            "take: rotation",
            "take: place",
        ),
        rows=tuple(rows),
        note="1: the error bars are true; below they are too wide, above too narrow.",
    )


def _plot(settings: Settings, results: Results) -> Figure:
    """Heights of the root and of a wrist over two seconds, before and after."""
    inputs = _inputs(settings)
    figure = Figure(figsize=(12, 3 * len(inputs)), layout="constrained")
    grid = figure.subplots(len(inputs), 2, squeeze=False)
    for row, (cameras, imus) in zip(grid, inputs, strict=True):
        before, after = (
            results.of(_row(settings, cameras, imus, alone=alone)[0]) for alone in (True, False)
        )
        for ax, joint in zip(row, ("root", "wrist"), strict=True):
            for what, result, key, colour in (
                ("alone", before, f"{joint}_m", "0.7"),
                ("together", after, f"{joint}_m", "C0"),
                ("truth", after, f"true_{joint}_m", "k"),
            ):
                if result is not None and key in result:
                    height_m = [np.nan if at[1] is None else at[1] for at in result[key][:SHOWN]]
                    ax.plot(np.arange(len(height_m)) / 60.0, height_m, colour, label=what, lw=1)
            ax.set_title(f"{settings.sequences[0]}, {_named(cameras, imus)}: {joint}", fontsize=9)
            ax.set_ylabel("height m")
    grid[0, 0].legend(fontsize=8)
    grid[-1, 0].set_xlabel("s")
    return figure


def _findings(settings: Settings, results: Results) -> Iterator[Claim]:
    """Whether every pose is nearer than an instant alone, and the nearer the later."""
    for cameras, imus in _inputs(settings):
        before = _row(settings, cameras, imus, alone=True)
        after = _row(settings, cameras, imus, alone=False)
        error = ERRORS["position from the root mm"]
        steps = [results.mean(before, "score", *error)]
        steps += [results.mean(after, kind, *error) for kind in KINDS]
        yield Claim(
            statement=f"{_named(cameras, imus)}: alone, newest, late, take: each nearer than the "
            "one before",
            evidence=" > ".join(f"{step:.1f}" for step in steps) + " mm from the root",
            holds=both(*(below(b, a) for a, b in pairwise(steps))),
        )


def _named(cameras: int, imus: int) -> str:
    return f"{cameras} camera{'s' * (cameras != 1)}, {imus} IMUs"


MOTION = Experiment(name="motion", title="Instants alone and together", cells=cells, report=report)
