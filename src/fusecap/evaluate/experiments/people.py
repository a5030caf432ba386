"""Several people: two, four, bystanders, close interaction; our tracker against Algorithm 1.

The paper shows these cases without numbers [1, sec. 4.2] and reports that its sorter occasionally
swaps subjects after close interaction.
"""

from __future__ import annotations

from dataclasses import replace

from matplotlib.figure import Figure

from fusecap.evaluate.cells import TwinCell
from fusecap.evaluate.experiments.experiment import (
    Claim,
    Experiment,
    Report,
    Results,
    Settings,
    below,
    both,
    number,
)
from fusecap.evaluate.tables import Table, Value

SCENES = ("duo", "quad", "bystanders", "close")
SORTERS = {"tracker": "tracker", "paper": "Algorithm 1"}
CAMERAS = (8, 4)
COUNTS = {
    "identity switches": "identity_switches",
    "missed people": "missed_tracks",
    "false people": "false_tracks",
}
SEEDS = 3


def _seeds(settings: Settings) -> range:
    return range(settings.seed, settings.seed + (1 if settings.quick else SEEDS))


def _row(settings: Settings, scene: str, cameras: int, sorter: str) -> list[TwinCell]:
    return [
        replace(settings, seed=seed).cell(scene, cameras=cameras, associate=sorter)
        for seed in _seeds(settings)
    ]


def cells(settings: Settings) -> list[TwinCell]:
    return [
        replace(settings, seed=seed).cell(scene, cameras=cameras, associate=sorter)
        for scene in SCENES
        for seed in _seeds(settings)
        for cameras in CAMERAS
        for sorter in SORTERS
    ]


def report(settings: Settings, results: Results) -> Report:
    rows: list[tuple[Value, ...]] = []
    for scene in SCENES:
        for cameras in CAMERAS:
            for sorter, name in SORTERS.items():
                chosen = _row(settings, scene, cameras, sorter)
                rows.append(
                    (
                        scene,
                        cameras,
                        name,
                        *[_sum(results, chosen, key) for key in COUNTS.values()],
                        results.mean(chosen, "score", "idf1"),
                        100 * (1 - results.mean(chosen, "score", "found_share")),
                        100 * results.mean(chosen, "score", "extra_share"),
                        results.spread(chosen, "score", "position_error_mm").mean,
                        results.spread(chosen, "score", "orientation_error_deg").mean,
                    )
                )
    runs = len(_seeds(settings))
    return Report(
        tables=(
            Table(
                title="Several people, 13 IMUs on each subject",
                columns=(
                    "scene",
                    "cameras",
                    "sorter",
                    *COUNTS,
                    "IDF1",
                    "missed person-frames %",
                    "false person-frames %",
                    "position mm",
                    "orientation deg",
                ),
                rows=tuple(rows),
                digits=2,
                note=f"Counts are sums over {runs} seeds of 10 s each. A person is found within "
                "0.5 m (mean over joints).",
            ),
        ),
        findings=_findings(settings, results),
        plots={"": _plot(settings, results)},
    )


def _sum(results: Results, cells: list[TwinCell], key: str) -> int | None:
    values = [number(results.of(cell), "score", key) for cell in cells]
    total = sum(values)
    return int(total) if total == total else None


def _findings(settings: Settings, results: Results) -> tuple[Claim, ...]:
    every = {
        sorter: [
            cell
            for scene in SCENES
            for cameras in CAMERAS
            for cell in _row(settings, scene, cameras, sorter)
        ]
        for sorter in SORTERS
    }
    faults = {s: [_sum(results, every[s], key) for key in COUNTS.values()] for s in SORTERS}
    idf1 = {sorter: results.mean(every[sorter], "score", "idf1") for sorter in SORTERS}
    close = {s: [cell for c in CAMERAS for cell in _row(settings, "close", c, s)] for s in SORTERS}
    swaps = _sum(results, close["paper"], "identity_switches")
    error_mm = {s: results.spread(close[s], "score", "position_error_mm").mean for s in SORTERS}
    return (
        Claim(
            statement="The tracker neither swaps, misses nor invents anybody",
            evidence="switches, missed, false: " + " / ".join(map(str, faults["tracker"])),
            holds=None if None in faults["tracker"] else not any(faults["tracker"]),
        ),
        Claim(
            statement="The tracker keeps identities better than Algorithm 1 (IDF1)",
            evidence=f"{idf1['tracker']:.3f} against {idf1['paper']:.3f}; Algorithm 1's switches, "
            "missed, false: " + " / ".join(map(str, faults["paper"])),
            holds=both(below(idf1["paper"], idf1["tracker"])),
        ),
        Claim(
            statement="Algorithm 1 swaps subjects in close interaction",
            evidence=f"{swaps} switches in scene 'close', but {error_mm['paper']:.0f} mm where the "
            f"tracker has {error_mm['tracker']:.0f} mm",
            holds=None if swaps is None else swaps > 0,
            why="In ten seconds it does not exchange the two for good; the error suggests that it "
            "gives one the other's detections in single views.",
        ),
    )


def _plot(settings: Settings, results: Results) -> Figure:
    figure = Figure(figsize=(9, 4), layout="constrained")
    ax = figure.subplots()
    for shift, (sorter, name) in zip((-0.2, 0.2), SORTERS.items(), strict=True):
        heights = [
            results.mean(
                [cell for c in CAMERAS for cell in _row(settings, scene, c, sorter)],
                "score",
                "idf1",
            )
            for scene in SCENES
        ]
        ax.bar([x + shift for x in range(len(SCENES))], heights, 0.38, label=name)
    ax.set_xticks(range(len(SCENES)), SCENES)
    ax.set_ylabel("IDF1")
    ax.legend(loc="lower left")
    return figure


PEOPLE = Experiment(
    name="people",
    title="Several people: tracker against Algorithm 1",
    cells=cells,
    report=report,
)
