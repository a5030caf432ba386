"""A take as one page of HTML that needs no server, no network and no script."""

from __future__ import annotations

import html
import io
import re
import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import matplotlib
import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.colors import ListedColormap, LogNorm
from matplotlib.figure import Figure
from matplotlib.image import AxesImage

from fusecap.batch.seen import Seen
from fusecap.edits.edit import SOLVE_REPORT, solve_notes, solve_report
from fusecap.feet import foot_events, on_floor
from fusecap.findings import Finding
from fusecap.take import Take

_COLUMNS = 1000
"""Of a picture over time; longer takes are binned."""
_DEG = (0.5, 60.0)
_DEG_TICKS = (1, 2, 5, 10, 20, 50)
_SHADES = ListedColormap([[1 - 0.9 * x, 1 - 0.5 * x, 1 - 0.25 * x] for x in np.linspace(0, 1, 64)])
_STYLE = """
body { font: 15px/1.45 system-ui, sans-serif; color: #22272b; margin: 24px auto;
  max-width: 1180px; padding: 0 16px; }
h1 { font-size: 1.5em; margin: 0 0 4px; } h2 { font-size: 1.15em; margin: 28px 0 6px; }
h3 { font-size: 1em; margin: 14px 0 2px; }
table { border-collapse: collapse; margin: 6px 0; }
td, th { padding: 2px 14px 2px 0; text-align: right; border-bottom: 1px solid #dfe4e8; }
td:first-child, th:first-child { text-align: left; }
svg { width: 100%; height: auto; } p { margin: 4px 0; } .quiet { color: #66707a; }
.error { color: #b3261e; } .warning { color: #94600b; } li { margin: 3px 0; }
"""


def report_page(
    take: Take,
    title: str,
    *,
    seen: Seen | None,
    findings: Sequence[Finding] = (),
    notes: Sequence[str] = (),
) -> str:
    """The whole page; `notes` say what is missing in it and why."""
    solve = solve_report(take)
    with matplotlib.rc_context({"svg.fonttype": "none", "text.parse_math": False}):
        parts = [
            *_head(take, title, notes),
            *_people(take),
            *_timelines(take, seen),
            *_cameras(take, seen, solve),
            *_uncertainty(take),
            *_sensors(take, seen),
            *_contacts(take),
            *_solve(take, solve),
            *_findings(findings, solve_notes(take)),
        ]
    return (
        '<!doctype html>\n<html lang="en"><head><meta charset="utf-8">'
        f"<title>{html.escape(title)}</title><style>{_STYLE}</style></head>\n<body>\n"
        + "\n".join(parts)
        + "\n</body></html>\n"
    )


def _head(take: Take, title: str, notes: Sequence[str]) -> Iterable[str]:
    frames, people = len(take.timestamps_ns), len(take.subject_names)
    made_by = str(take.provenance.get("made_by", "an unknown program"))
    simulated = " <b>Simulated.</b>" if take.provenance.get("simulated") else ""
    yield f"<h1>{html.escape(title)}</h1>"
    yield (
        f"<p>{frames} frames at {take.rate_hz:g} Hz ({frames / take.rate_hz:.2f} s), "
        f"{people} {'person' if people == 1 else 'people'}, by {html.escape(made_by)}.{simulated}"
        "</p>"
    )
    for note in notes:
        yield f'<p class="warning">{html.escape(note)}</p>'


def _people(take: Take) -> Iterable[str]:
    yield "<h2>People</h2>"
    yield (
        '<p class="quiet">Shares of frames: a camera or a sensor told of the person, or the motion '
        "around bridges the frame, or nothing is known. Error bars are medians where there is a "
        "pose.</p>"
    )
    rows = []
    for row, name in enumerate(take.subject_names):
        tracked = take.tracked[row]
        edges = np.diff(np.concatenate([[False], tracked, [False]]).astype(int))
        rows.append(
            [
                name,
                f"{take.heights_m[row]:.2f}",
                f"{100 * take.measured[row].mean():.1f} %",
                f"{100 * (tracked & ~take.measured[row]).mean():.1f} %",
                f"{100 * (~tracked).mean():.1f} %",
                str(max(int((edges == 1).sum()) - 1, 0)),
                _median(take.bone_sigma_deg[row, tracked], "{:.1f}"),
                _median(1e3 * take.position_sigma_m[row, tracked], "{:.0f}"),
            ]
        )
    yield _table(
        [
            *("person", "height m", "measured", "predicted", "unknown", "gaps"),
            *("bones +- deg", "joints +- mm"),
        ],
        rows,
    )


def _timelines(take: Take, seen: Seen | None) -> Iterable[str]:
    yield "<h2>Who was seen when, by what</h2>"
    if seen is None:
        yield (
            '<p class="quiet">When people were followed; which cameras and sensors saw them, the '
            "session knows.</p>"
        )
    else:
        yield (
            '<p class="quiet">The darker, the more: of a camera the share of keypoints found, of a '
            f"sensor and of people the share of instants. {_looked(seen)}</p>"
        )
    for row, name in enumerate(take.subject_names):
        predicted = take.tracked[row] & ~take.measured[row]
        labels, times = ["measured", "predicted"], [take.time_s, take.time_s]
        rows = [take.measured[row].astype(float), predicted.astype(float)]
        if seen is not None:
            most = max(int(seen.keypoints.max(initial=0)), 1)
            for camera, found in zip(seen.cameras, seen.keypoints[row], strict=True):
                labels.append(camera)
                rows.append(found / most)
                times.append(take.time_s[seen.frames])
            for sensor in seen.sensors:
                if sensor.subject == name:
                    labels.append(sensor.bone)
                    rows.append(np.isfinite(sensor.off_deg).astype(float))
                    times.append(take.time_s[seen.frames])
        grid = np.stack([_binned(take, t, v, np.mean) for t, v in zip(times, rows, strict=True)])
        yield f"<h3>{html.escape(name)}</h3>"
        yield _shares(take, grid, labels)


def _cameras(take: Take, seen: Seen | None, solve: Mapping[str, Any]) -> Iterable[str]:
    residuals = seen.reprojection_px if seen is not None else solve.get("reprojection_px")
    if not isinstance(residuals, Mapping) or not residuals:
        return
    yield "<h2>Cameras</h2>"
    head = ["camera", "residual median px", "p90 px", "keypoints"]
    rows = [
        [str(name), *(_number(_of(values, key)) for key in ("median", "p90")), _count(values)]
        for name, values in residuals.items()
    ]
    if seen is not None:
        head += [f"sees {name}" for name in take.subject_names] + ["others seen"]
        for row, shares in zip(rows, _coverage(take, seen), strict=True):
            row += shares
    yield _table(head, rows)
    if seen is None:
        yield '<p class="quiet">As the solve told them.</p>'
        return
    yield (
        '<p class="quiet">Residuals lie between keypoints and the images of the solved landmarks, '
        "in the camera's own pixels. Shares are of the instants at which the person was followed; "
        "others are detections per instant that are nobody of the take.</p>"
    )
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # nobody seen by a camera
        medians = np.nanmedian(seen.residual_px, axis=0)
    figure = Figure(figsize=(14, 2.6), layout="constrained")
    ax = figure.subplots()
    for row, camera in enumerate(seen.cameras):
        values = _binned(take, take.time_s[seen.frames], medians[row], _nanmedian)
        ax.plot(_centres(take), values, linewidth=1, label=camera)
    _over_time(ax, take)
    ax.set_ylabel("residual [px]")
    ax.set_ylim(bottom=0)
    if len(seen.cameras):
        ax.legend(loc="upper right", fontsize=8, ncols=min(len(seen.cameras), 6))
    yield _svg(figure)


def _coverage(take: Take, seen: Seen) -> Iterable[list[str]]:
    tracked = take.tracked[:, seen.frames]
    for row in range(len(seen.cameras)):
        shares = [
            f"{100 * (found[row][there] > 0).mean():.0f} %" if there.any() else "-"
            for found, there in zip(seen.keypoints, tracked, strict=True)
        ]
        yield [*shares, f"{seen.others[row].mean():.2f}"]


def _uncertainty(take: Take) -> Iterable[str]:
    yield "<h2>How sure the poses are</h2>"
    yield (
        '<p class="quiet">Expected error of every bone\'s rotation; what only the prior tells is '
        "yellow. White: not tracked.</p>"
    )
    for row, name in enumerate(take.subject_names):
        values = np.where(take.tracked[row][:, None], take.bone_sigma_deg[row], np.nan).T
        grid = np.stack([_binned(take, take.time_s, each, _nanmedian) for each in values])
        yield f"<h3>{html.escape(name)}</h3>"
        yield _heat(take, grid, list(take.bone_names))
    figure = Figure(figsize=(14, 2.2), layout="constrained")
    ax = figure.subplots()
    for row, name in enumerate(take.subject_names):
        place_mm = np.where(take.tracked[row], 1e3 * take.position_sigma_m[row, :, 0], np.nan)
        ax.plot(_centres(take), _binned(take, take.time_s, place_mm, _nanmedian), label=name)
    _over_time(ax, take)
    ax.set_ylabel("place of hips +- [mm]")
    ax.set_ylim(bottom=0)
    if len(take.subject_names):
        ax.legend(loc="upper right", fontsize=8)
    yield _svg(figure)


def _sensors(take: Take, seen: Seen | None) -> Iterable[str]:
    if seen is None or not seen.sensors:
        return
    yield "<h2>Sensors against poses</h2>"
    yield (
        '<p class="quiet">Angle between the orientation that a sensor measured and that of its '
        "bone. What stays the same is the mounting or the heading (fusecap calibrate imu), what "
        "grows is drift.</p>"
    )
    rows = []
    for sensor in seen.sensors:
        off = sensor.off_deg[np.isfinite(sensor.off_deg)]
        there = take.tracked[take.subject(sensor.subject), seen.frames]
        share = f"{100 * len(off) / there.sum():.0f} %" if there.any() else "-"
        p90 = f"{np.percentile(off, 90):.1f}" if len(off) else "-"
        rows.append([sensor.subject, sensor.bone, _median(off, "{:.1f}"), p90, share])
    yield _table(["person", "bone", "median deg", "p90 deg", "measures"], rows)
    for name in dict.fromkeys(sensor.subject for sensor in seen.sensors):
        worn = [sensor for sensor in seen.sensors if sensor.subject == name]
        times = take.time_s[seen.frames]
        grid = np.stack([_binned(take, times, each.off_deg, _nanmedian) for each in worn])
        yield f"<h3>{html.escape(name)}</h3>"
        labels = [each.bone for each in worn]
        yield _heat(take, grid, labels)


def _contacts(take: Take) -> Iterable[str]:
    if not {"left_foot", "right_foot", "left_toes", "right_toes"} <= {*take.bone_names}:
        return
    yield "<h2>Feet on the floor</h2>"
    yield (
        '<p class="quiet">Low and slow ankles or toes over a floor at y = 0; on a treadmill from '
        "farthest before the hips to farthest behind.</p>"
    )
    rows = []
    for row, name in enumerate(take.subject_names):
        stands = [on_floor(take, row, side) for side in ("left", "right")]
        strikes = [event.side for event in foot_events(take, row) if event.strikes]
        tracked = max(int(take.tracked[row].sum()), 1)
        rows.append(
            [
                name,
                *(f"{100 * each.sum() / tracked:.0f} %" for each in stands),
                *(str(strikes.count(side)) for side in ("left", "right")),
            ]
        )
        grid = np.stack([_binned(take, take.time_s, s.astype(float), np.mean) for s in stands])
        yield f"<h3>{html.escape(name)}</h3>"
        yield _shares(take, grid, ["left", "right"])
    yield _table(["person", "left stands", "right stands", "left strikes", "right strikes"], rows)


def _solve(take: Take, solve: Mapping[str, Any]) -> Iterable[str]:
    yield "<h2>The solve</h2>"
    if solve:
        if SOLVE_REPORT in take.provenance:
            yield '<p class="quiet">Of the take before its edits.</p>'
        statuses = solve.get("statuses")
        ended = statuses.items() if isinstance(statuses, Mapping) else ()
        yield _table(
            ["solves", "median ms", "p99 ms", "in all s", "ended"],
            [
                [
                    _number(solve.get("solves"), "{:.0f}"),
                    _number(solve.get("solve_ms_median"), "{:.2f}"),
                    _number(solve.get("solve_ms_p99"), "{:.2f}"),
                    _number(solve.get("elapsed_s"), "{:.1f}"),
                    ", ".join(f"{name} {count}" for name, count in ended),
                ]
            ],
        )
    else:
        yield '<p class="quiet">The take does not say how long its solve took.</p>'
    edits = take.provenance.get("edits")
    for edit in edits if isinstance(edits, list) else ():
        told = edit.items() if isinstance(edit, Mapping) else ()
        text = ", ".join(f"{key} {value}" for key, value in told if key not in ("edit", "made_by"))
        name = str(_of(edit, "edit"))
        yield f"<p>Edited: {html.escape(name)} ({html.escape(text)})</p>"
    steps_ms = np.diff(take.timestamps_ns) * 1e-6
    if len(steps_ms):
        yield (
            f"<p>Frames lie {np.median(steps_ms):.2f} ms apart, the longest step is "
            f"{steps_ms.max():.2f} ms.</p>"
        )


def _findings(findings: Sequence[Finding], notes: Sequence[str]) -> Iterable[str]:
    if notes:
        yield "<h2>Notes of the solve</h2>"
        yield f"<ul>{''.join(f'<li>{html.escape(note)}</li>' for note in notes)}</ul>"
    told = [finding for finding in findings if str(finding) not in notes]
    if told:
        yield "<h2>What the checks say of the session</h2>"
        items = (
            f'<li><b class="{f.severity}">{f.severity}</b> {html.escape(str(f))}</li>' for f in told
        )
        yield f"<ul>{''.join(items)}</ul>"


def _looked(seen: Seen) -> str:
    return f"Every {seen.every}. instant was looked at." if seen.every > 1 else ""


def _edges(take: Take) -> Float[np.ndarray, " e"]:
    """Of the bins [s]: one a frame, or `_COLUMNS`."""
    half_s = 0.5 / take.rate_hz
    bins = min(len(take.timestamps_ns), _COLUMNS)
    return np.linspace(-half_s, take.time_s[-1] + half_s, bins + 1)


def _centres(take: Take) -> Float[np.ndarray, " e"]:
    edges = _edges(take)
    return (edges[1:] + edges[:-1]) / 2


def _binned(
    take: Take,
    time_s: Float[np.ndarray, " n"],
    values: Float[np.ndarray, " n"],
    of: Callable[[np.ndarray], Any],
) -> Float[np.ndarray, " e"]:
    """One value per bin; a bin without any has that of the last sample before it."""
    edges = _edges(take)
    starts = np.searchsorted(time_s, edges[:-1])
    ends = np.searchsorted(time_s, edges[1:])
    return np.array(
        [
            of(values[start:end] if end > start else values[max(start - 1, 0) : max(start, 1)])
            for start, end in zip(starts, ends, strict=True)
        ],
        dtype=np.float64,
    )


def _nanmedian(values: np.ndarray) -> float:
    known = values[np.isfinite(values)]
    return float(np.median(known)) if len(known) else float("nan")


def _shares(take: Take, grid: Float[np.ndarray, "r e"], labels: list[str]) -> str:
    """Rows of 0-1 over time, the darker the more."""
    figure, _ = _rows(take, grid, labels, cmap=_SHADES, vmin=0.0, vmax=1.0)
    return _svg(figure)


def _heat(take: Take, grid_deg: Float[np.ndarray, "r e"], labels: list[str]) -> str:
    """Rows of degrees over time."""
    figure, shown = _rows(take, grid_deg, labels, cmap="viridis", norm=LogNorm(*_DEG))
    bar = figure.colorbar(shown, ax=figure.axes, label="deg", pad=0.01)
    bar.set_ticks(_DEG_TICKS, labels=[str(tick) for tick in _DEG_TICKS])
    bar.minorticks_off()
    return _svg(figure)


def _rows(
    take: Take, grid: Float[np.ndarray, "r e"], labels: list[str], **how: Any
) -> tuple[Figure, AxesImage]:
    figure = Figure(figsize=(14, 0.75 + 0.19 * len(labels)), layout="constrained")
    ax = figure.subplots()
    edges = _edges(take)
    extent = (edges[0], edges[-1], len(labels) - 0.5, -0.5)
    shown = ax.imshow(grid, aspect="auto", interpolation="nearest", extent=extent, **how)
    ax.set_yticks(range(len(labels)), labels, fontsize=8)
    _over_time(ax, take)
    return figure, shown


def _over_time(ax: Axes, take: Take) -> None:
    edges = _edges(take)
    ax.set_xlim(edges[0], edges[-1])
    ax.set_xlabel("s", fontsize=8)
    ax.tick_params(axis="x", labelsize=8)


def _svg(figure: Figure) -> str:
    """The figure as an element of the page."""
    file = io.StringIO()
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="Glyph")  # the browser has other fonts
        figure.savefig(file, format="svg", metadata={"Date": None})
    text = file.getvalue()
    return re.sub(r"<metadata>.*?</metadata>", "", text[text.index("<svg") :], flags=re.DOTALL)


def _table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    cells = "".join(f"<th>{html.escape(each)}</th>" for each in head)
    lines = [f"<tr>{''.join(f'<td>{html.escape(each)}</td>' for each in row)}</tr>" for row in rows]
    return f"<table><tr>{cells}</tr>{''.join(lines)}</table>"


def _median(values: np.ndarray, form: str) -> str:
    return form.format(np.median(values)) if values.size else "-"


def _of(values: object, key: str) -> object:
    return values.get(key) if isinstance(values, Mapping) else None


def _count(values: object) -> str:
    return _number(_of(values, "keypoints"), "{:.0f}")


def _number(value: object, form: str = "{:.1f}") -> str:
    known = isinstance(value, int | float) and np.isfinite(value)
    return form.format(value) if known else "-"
