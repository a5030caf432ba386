"""Table 3: cost terms off, fewer keypoints, offsets on and off [1, sec. 4.1.2].

The paper takes S1 FS1 and S2 FS1 with 8 cameras and 13 IMUs; here all sequences. The rows of the
prior are also taken with sparse input, where it has most to do.
"""

from __future__ import annotations

import math
from functools import cache
from typing import Any

from matplotlib.figure import Figure

from fusecap.evaluate.cells import TwinCell, mean_offsets
from fusecap.evaluate.experiments.experiment import (
    Claim,
    Experiment,
    Report,
    Results,
    Settings,
    Spread,
    below,
    both,
)
from fusecap.evaluate.tables import Table, Value
from fusecap.evaluate.twin import twin_simulation, twin_training_sequences

METRICS = {
    "position_error_mm": "position, global mm",
    "aligned_error_mm": "position, Procrustes mm",
    "orientation_error_deg": "orientation, global deg",
    "aligned_orientation_error_deg": "orientation, Procrustes deg",
}
SPARSE = ((8, 0), (3, 0), (1, 13), (1, 0), (0, 13), (0, 6))
"""Cameras and IMUs."""

SPARSE_FINDINGS = {
    "1 camera alone": (2.0, ""),
    "6 IMUs alone": (
        2.0,
        "Bones without a sensor stay where the first pose put them when nothing pulls at them, and "
        "the first pose is the prior's own mean.",
    ),
    "13 IMUs alone": (
        1.0,
        "The prior outweighs the sensors: E_R at weight 1 is 0.25 per rad² about a measured "
        "orientation, E_PP 0.7 per rad² off the subspace and E_PD 0.06 per squared deviation in "
        "it. Beside cameras the keypoints decide; alone, sensors good to a few degrees deserve "
        "more (docs/accuracy.md, gait, where real sensors say the same).",
    ),
}
"""Input to how many times larger the error must be without the prior, and what is known about why
it is not."""


@cache
def offsets() -> dict[str, tuple[float, float, float]]:
    """Landmark offsets from the training subjects, who are not in any test sequence."""
    return mean_offsets(
        [twin_simulation(sequence, cameras=0, imus=0) for sequence in twin_training_sequences()]
    )


def variants() -> dict[str, dict[str, Any]]:
    """What each row changes."""
    return {
        "full": {},
        "E_R off (orientation)": {"weights": {"orientation": 0.0}},
        "E_A on, 1e-3 (acceleration)": {"weights": {"acceleration": 1e-3}},
        "E_P off (position)": {"weights": {"position": 0.0}},
        "E_PP off (prior projection)": {"weights": {"projection": 0.0}},
        "E_PD off (prior deviation)": {"weights": {"deviation": 0.0}},
        "E_PP and E_PD off": {"weights": {"projection": 0.0, "deviation": 0.0}},
        "E_FP off (floor)": {"weights": {"floor": 0.0}},
        "25 keypoints, calibrated offsets": {"offsets": offsets()},
        "12 keypoints": {"keypoints": "limbs12"},
        "12 keypoints, calibrated offsets": {"keypoints": "limbs12", "offsets": offsets()},
        "stature known, bone lengths not": {"body": "height"},
    }


def _row(settings: Settings, changes: dict[str, Any]) -> list[TwinCell]:
    return [settings.cell(scene, **changes) for scene in settings.sequences]


def _prior(settings: Settings, cameras: int, imus: int, *, on: bool) -> list[TwinCell]:
    changes = {} if on else {"weights": {"projection": 0.0, "deviation": 0.0}}
    return _row(settings, {"cameras": cameras, "imus": imus, **changes})


def cells(settings: Settings) -> list[TwinCell]:
    rows = [_row(settings, changes) for changes in variants().values()]
    rows += [_prior(settings, *given, on=on) for given in SPARSE for on in (True, False)]
    by_sequence = zip(*rows, strict=True)
    return [cell for sequence in by_sequence for cell in sequence]


def report(settings: Settings, results: Results) -> Report:
    spreads = {
        name: {m: results.spread(_row(settings, changes), "score", m) for m in METRICS}
        for name, changes in variants().items()
    }
    rows = [_shown(name, spread, spreads["full"]) for name, spread in spreads.items()]
    ablation = Table(
        title="Table 3: error, and in brackets relative to the full cost function",
        columns=("variant", *METRICS.values()),
        rows=tuple(rows),
        note="E_A is off in the full cost function here and on in the paper's. MPI15, the paper's "
        "older detection model, is not simulated.",
    )
    sparse, sparsely = _sparse(settings, results)
    return Report(
        tables=(ablation, sparse),
        findings=(*sparsely, *_findings(spreads)),
        plots={"": _plot(spreads)},
    )


def _shown(name: str, spread: dict[str, Spread], full: dict[str, Spread]) -> tuple[Value, ...]:
    return (name, *[_relative(spread[m].mean, full[m].mean) for m in METRICS])


def _input(cameras: int, imus: int) -> str:
    views = f"{cameras} camera{'s' * (cameras > 1)}" if cameras else ""
    sensors = f"{imus} IMUs" if imus else ""
    return " and ".join(filter(None, (views, sensors))) + (" alone" * (not (cameras and imus)))


def _relative(value: float, full: float) -> str | None:
    return f"{value:.1f} ({value / full:.2f})" if math.isfinite(value + full) else None


def _sparse(settings: Settings, results: Results) -> tuple[Table, tuple[Claim, ...]]:
    rows: list[tuple[Value, ...]] = []
    ratios = {}
    for cameras, imus in SPARSE:
        name = _input(cameras, imus)
        means = []
        for metric in ("aligned_error_mm", "orientation_error_deg"):
            means += [
                results.spread(_prior(settings, cameras, imus, on=on), "score", metric).mean
                for on in (True, False)
            ]
        ratios[name] = (means[1] / means[0], means[3] / means[2])
        rows.append((name, *means, *ratios[name]))
    table = Table(
        title="With and without the prior (E_PP and E_PD)",
        columns=(
            "input",
            "aligned position mm",
            "without mm",
            "orientation deg",
            "without deg",
            "ratio of positions",
            "ratio of orientations",
        ),
        rows=tuple(rows),
    )
    return table, tuple(_halved(name, ratios[name]) for name in SPARSE_FINDINGS)


def _halved(name: str, ratio: tuple[float, float]) -> Claim:
    factor, why = SPARSE_FINDINGS[name]
    claim = "more than halves the errors" if factor == 2.0 else "reduces the errors"
    return Claim(
        statement=f"The prior {claim} with {name}",
        evidence=f"without it {ratio[0]:.2f} times the aligned position error, {ratio[1]:.2f} "
        "times the orientation error",
        holds=both(*[below(factor, each) for each in ratio]),
        why=why,
    )


def _findings(spreads: dict[str, dict[str, Spread]]) -> tuple[Claim, ...]:
    place, turn = "position_error_mm", "orientation_error_deg"

    def compared(name: str, against: str = "full") -> str:
        one, other = spreads[name], spreads[against]
        return (
            f"{name}: {one[place].mean:.1f} mm, {one[turn].mean:.1f} deg; {against}: "
            f"{other[place].mean:.1f} mm, {other[turn].mean:.1f} deg"
        )

    def helps(name: str, metric: str, against: str = "full") -> bool | None:
        return below(spreads[against][metric].mean, spreads[name][metric].mean)

    def ratio(name: str, metric: str) -> float:
        return spreads[name][metric].mean / spreads["full"][metric].mean

    calibrated, k12 = "25 keypoints, calibrated offsets", "12 keypoints"
    neither = "E_PP and E_PD off"
    prior, floor = "E_PP off (prior projection)", "E_FP off (floor)"
    imu, lag, deviation = (
        "E_R off (orientation)",
        "E_A on, 1e-3 (acceleration)",
        "E_PD off (prior deviation)",
    )
    return (
        Claim(
            statement="The prior projection more than halves both errors with 8 cameras and 13 "
            "IMUs",
            evidence=compared(prior),
            holds=both(below(2.0, ratio(prior, place)), below(2.0, ratio(prior, turn))),
            why="Eight views leave no joint that has a keypoint in doubt, so positions hardly need "
            "it. Orientations do: hands, toes and the twist of the spine, which nothing measures, "
            f"run away where E_PD is left alone (with both off: {spreads[neither][turn].mean:.1f} "
            "deg).",
        ),
        Claim(
            statement="The prior deviation improves both errors (the paper: a little)",
            evidence=compared(deviation),
            holds=both(helps(deviation, place), helps(deviation, turn)),
        ),
        Claim(
            statement="The orientation term reduces orientation and position errors",
            evidence=compared(imu),
            holds=both(helps(imu, place), helps(imu, turn)),
        ),
        Claim(
            statement="The acceleration term does not help the frame-by-frame solve",
            evidence=compared(lag),
            holds=both(helps(lag, place), helps(lag, turn)),
        ),
        Claim(
            statement="Without the position term the global position is lost",
            evidence=compared("E_P off (position)"),
            holds=below(10.0, ratio("E_P off (position)", place)),
        ),
        Claim(
            statement="The floor term changes the figures little (less than 5 %)",
            evidence=compared(floor),
            holds=both(*[below(abs(ratio(floor, m) - 1), 0.05) for m in (place, turn)]),
        ),
        Claim(
            statement="Calibrated offsets reduce the position error, with 25 and with 12 keypoints",
            evidence=compared(calibrated) + "; " + compared(f"{k12}, calibrated offsets", k12),
            holds=both(
                below(spreads[calibrated][place].mean, spreads["full"][place].mean),
                below(spreads[f"{k12}, calibrated offsets"][place].mean, spreads[k12][place].mean),
            ),
        ),
        Claim(
            statement="25 keypoints are better than 12, both with calibrated offsets",
            evidence=compared(calibrated, f"{k12}, calibrated offsets"),
            holds=below(
                spreads[calibrated][place].mean, spreads[f"{k12}, calibrated offsets"][place].mean
            ),
        ),
    )


def _plot(spreads: dict[str, dict[str, Spread]]) -> Figure:
    figure = Figure(figsize=(12, 7), layout="constrained")
    names = list(spreads)
    for ax, metric in zip(
        figure.subplots(1, 2, sharey=True),
        ("position_error_mm", "orientation_error_deg"),
        strict=True,
    ):
        full = spreads["full"][metric].mean
        ax.barh(names, [spreads[name][metric].mean / full for name in names])
        ax.set_xscale("log")
        ax.axvline(1.0, color="0.3", linewidth=1)
        ax.set_xlabel(f"{METRICS[metric]}, relative to full")
        ax.grid(alpha=0.3, which="both")
    figure.axes[0].invert_yaxis()
    return figure


TABLE3 = Experiment(
    name="table3",
    title="Table 3: cost terms, keypoints and offsets switched off",
    cells=cells,
    report=report,
)
