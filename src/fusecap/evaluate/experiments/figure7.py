"""Figure 7: 0-8 cameras with 0, 6 and 13 IMUs, IMU-only and monocular included [1, sec. 4.1.1]."""

from __future__ import annotations

from matplotlib.figure import Figure

from fusecap.evaluate.cells import TwinCell
from fusecap.evaluate.experiments.experiment import (
    Claim,
    Experiment,
    Report,
    Results,
    Settings,
    Spread,
    below,
    both,
    with_spread,
)
from fusecap.evaluate.tables import Table

IMUS = (0, 6, 13)
METRICS = {
    "position_error_mm": "position, global mm",
    "root_relative_error_mm": "position, w.r.t. root mm",
    "aligned_error_mm": "position, Procrustes mm",
    "orientation_error_deg": "orientation, global deg",
    "aligned_orientation_error_deg": "orientation, Procrustes deg",
    "axial_error_deg": "axial rotation deg",
}


def cameras(settings: Settings) -> tuple[int, ...]:
    return (0, 1, 3, 8) if settings.quick else tuple(range(9))


def row(settings: Settings, count: int, imus: int) -> list[TwinCell]:
    return [settings.cell(scene, cameras=count, imus=imus) for scene in settings.sequences]


def cells(settings: Settings) -> list[TwinCell]:
    """Sequence by sequence, since a worker keeps the capture of the last ones."""
    grid = [(c, i) for c in cameras(settings) for i in IMUS if c or i]
    return [
        settings.cell(scene, cameras=count, imus=imus)
        for scene in settings.sequences
        for count, imus in grid
    ]


def report(settings: Settings, results: Results) -> Report:
    errors = {
        (count, imus, metric): results.spread(row(settings, count, imus), "score", metric)
        for count in cameras(settings)
        for imus in IMUS
        if count or imus
        for metric in METRICS
    }
    return Report(
        tables=tuple(_table(settings, errors, metric) for metric in METRICS),
        findings=_findings(errors),
        plots={"": _plot(settings, errors)},
    )


Errors = dict[tuple[int, int, str], Spread]


def _table(settings: Settings, errors: Errors, metric: str) -> Table:
    return Table(
        title=f"Figure 7: {METRICS[metric]}",
        columns=("cameras", *[f"{i} IMUs, mean (std)" for i in IMUS], "median (MAD), 13 IMUs"),
        rows=tuple(
            (
                count,
                *[_shown(errors.get((count, imus, metric))) for imus in IMUS],
                with_spread(errors[count, 13, metric].median, errors[count, 13, metric].mad),
            )
            for count in cameras(settings)
        ),
        note="Without a camera nothing measures where a person is: the global position drifts."
        if metric == "position_error_mm"
        else "",
    )


def _shown(spread: Spread | None) -> str | None:
    return with_spread(spread.mean, spread.std) if spread else None


def _findings(errors: Errors) -> tuple[Claim, ...]:
    def mean(count: int, imus: int, metric: str) -> float:
        return errors[count, imus, metric].mean

    place, turn, shape = "position_error_mm", "orientation_error_deg", "aligned_error_mm"
    fused = both(
        below(mean(8, 13, place), mean(8, 0, place)),
        below(mean(8, 13, turn), mean(8, 0, turn)),
        below(mean(8, 13, shape), mean(0, 13, shape)),
        below(mean(8, 13, turn), mean(0, 13, turn)),
    )
    sparse = both(
        *[
            below(mean(count, 13, metric), mean(count, 0, metric))
            for count in (1, 3)
            for metric in (place, turn)
        ]
    )
    three = both(
        below(mean(3, 13, place), mean(8, 13, place), 1.5),
        below(
            mean(3, 13, place) - mean(8, 13, place),
            mean(1, 13, place) - mean(3, 13, place),
            0.25,
        ),
    )
    return (
        Claim(
            statement="Fusion beats either modality: 8 cameras with 13 IMUs against 8 cameras "
            "alone (position, orientation) and 13 IMUs alone (aligned position, orientation)",
            evidence=f"{mean(8, 13, place):.1f} mm and {mean(8, 13, turn):.1f} deg fused; "
            f"{mean(8, 0, place):.1f} mm and {mean(8, 0, turn):.1f} deg from video; aligned "
            f"{mean(8, 13, shape):.1f} mm fused, {mean(0, 13, shape):.1f} mm and "
            f"{mean(0, 13, turn):.1f} deg from IMUs",
            holds=fused,
        ),
        Claim(
            statement="Fusion beats video with 1 and with 3 cameras (position, orientation)",
            evidence=", ".join(
                f"{count} camera{'s' * (count > 1)}: {mean(count, 13, place):.1f} mm, "
                f"{mean(count, 13, turn):.1f} deg against {mean(count, 0, place):.1f} mm, "
                f"{mean(count, 0, turn):.1f} deg"
                for count in (1, 3)
            ),
            holds=sparse,
        ),
        Claim(
            statement="Three cameras are enough for global position (13 IMUs: within 1.5 times "
            "the error of eight, and from 3 to 8 less than a quarter of the gain from 1 to 3)",
            evidence=f"1 camera {mean(1, 13, place):.1f} mm, 3 cameras {mean(3, 13, place):.1f} "
            f"mm, 8 cameras {mean(8, 13, place):.1f} mm",
            holds=three,
        ),
        Claim(
            statement="6 IMUs reduce the orientation error, and 13 reduce it further (3 and 8 "
            "cameras)",
            evidence=", ".join(
                f"{count} cameras: " + " / ".join(f"{mean(count, i, turn):.1f}" for i in IMUS)
                for count in (3, 8)
            )
            + " deg",
            holds=both(
                *[
                    below(mean(count, more, turn), mean(count, fewer, turn))
                    for count in (3, 8)
                    for fewer, more in ((0, 6), (6, 13))
                ]
            ),
        ),
    )


def _plot(settings: Settings, errors: Errors) -> Figure:
    figure = Figure(figsize=(15, 8), layout="constrained")
    for ax, (metric, title) in zip(figure.subplots(2, 3).flat, METRICS.items(), strict=True):
        for colour, imus in enumerate(IMUS):
            counts = [c for c in cameras(settings) if (c, imus, metric) in errors]
            spreads = [errors[c, imus, metric] for c in counts]
            ax.plot(
                counts,
                [s.mean for s in spreads],
                "--o",
                color=f"C{colour}",
                label=f"{imus} IMUs, mean",
            )
            ax.errorbar(
                # Side by side, to be told apart.
                [count + 0.1 * (colour - 1) for count in counts],
                [s.median for s in spreads],
                [s.mad for s in spreads],
                color=f"C{colour}",
                capsize=3,
                label=f"{imus} IMUs, median and MAD",
            )
        if metric.endswith("_mm"):
            ax.set_yscale("log")
        else:
            ax.set_ylim(bottom=0.0)
        ax.set_xlabel("cameras")
        ax.set_title(title)
        ax.grid(alpha=0.3, which="both")
    figure.axes[0].legend(fontsize=8)
    return figure


FIGURE7 = Experiment(
    name="figure7",
    title="Figure 7: 0 to 8 cameras with 0, 6 and 13 IMUs",
    cells=cells,
    report=report,
)
