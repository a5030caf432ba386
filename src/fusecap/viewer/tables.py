"""How a live run goes, as a page's HTML: lights, rates, latency, streams, incidents.

Whatever comes from a session, a device or a receiver is escaped.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

import numpy as np

from fusecap.engine.engine import LiveStep
from fusecap.live.status import Light, LiveStatus, SourceStatus
from fusecap.types import TrackState
from fusecap.viewer.palette import Rgb, css, escaped

_LIGHTS = {
    Light.FRESH: ("&#9679;", "#009e73"),
    Light.LATE: ("&#9680;", "#b07000"),
    Light.LOST: ("&#10007;", "#c43c00"),
    Light.WAITING: ("&#9675;", "#888888"),
}
"""A symbol and a colour each, so that colour is not needed."""
_SMALL = "font-size:0.85em;line-height:1.45;margin:2px 12px"


def lights(sources: Sequence[SourceStatus]) -> str:
    """A line per camera, then the sensors of each person."""
    lines = [
        f"<div>{_light(source)} <b>{escaped(source.name)}</b> {source.rate_hz:.1f} Hz{_age(source)}"
        f"{_remark(source)}</div>"
        for source in sources
        if source.kind == "camera"
    ]
    sensors: dict[str, list[SourceStatus]] = {}
    for source in sources:
        if source.kind == "imu":
            sensors.setdefault(source.name.rpartition("/")[0], []).append(source)
    for subject, group in sensors.items():
        fresh = [source for source in group if source.light is Light.FRESH]
        rate_hz = np.median([source.rate_hz for source in fresh]) if fresh else 0.0
        chips = " ".join(
            f'<span style="white-space:nowrap;margin-right:6px">{_light(source)} '
            f"{escaped(source.name.rpartition('/')[2])}</span>"
            for source in group
        )
        lines.append(
            f"<div><b>{escaped(subject)}</b>: {len(fresh)} of {len(group)} sensors fresh, "
            f"{rate_hz:.0f} Hz<br>{chips}</div>"
        )
    key = " ".join(f"{_dot(light)} {light.value}" for light in Light)
    return f'<div style="{_SMALL}">{"".join(lines)}<div style="opacity:0.7">{key}</div></div>'


def people(step: LiveStep, colours: Mapping[str, Rgb]) -> str:
    """A line per subject: how it is followed and how sure its pose is."""
    state = {update.name: update.state for update in step.step.updates}
    lines = []
    for name, estimate in step.people.items():
        if estimate is None:
            how = "not found yet"
        else:
            followed = state.get(name)
            seen = f"in {int(estimate.views.sum())} views"
            how = "unseen, held" if followed in (None, TrackState.COASTING) else seen
            how += (
                f", &plusmn;{float(np.median(estimate.bone_sigma_deg)):.0f} deg, "
                f"&plusmn;{1e3 * float(np.median(estimate.position_sigma_m)):.0f} mm"
            )
        dot = f'<span style="color:{css(colours[name])};font-size:1.3em">&#9679;</span>'
        lines.append(f"<div>{dot} <b>{escaped(name)}</b>: {how}</div>")
    return f'<div style="{_SMALL}">{"".join(lines) or "nobody yet"}</div>'


def numbers(status: LiveStatus) -> str:
    """Rates and the process."""
    rows = [
        ("running for", _clock(status.elapsed_s)),
        ("detections", f"{status.detections_per_s:.1f} per second"),
        ("solved instants", f"{status.solves_per_s:.1f} per second"),
        ("packets, each person", f"{status.packets_per_s:.1f} per second"),
        ("late instants", f"{100 * status.late_share:.1f} %"),
        ("processor", f"{status.cpu_share:.2f} cores"),
        ("memory", f"{status.memory_mb:.0f} MB"),
    ]
    recording = status.recording
    if recording is not None:
        how = recording.problem or f"{recording.megabytes:.1f} MB, {_clock(recording.seconds)}"
        rows.append(("recording", f"{recording.path}: {how}"))
    return _table((), ((name, value) for name, value in rows))


def latency(status: LiveStatus) -> str:
    """Milliseconds per stage, over the last seconds."""
    return _table(
        ("stage", "p50 ms", "p95 ms", "p99 ms"),
        (
            (one.stage, f"{one.p50_ms:.1f}", f"{one.p95_ms:.1f}", f"{one.p99_ms:.1f}")
            for one in status.latency
            if one.count
        ),
    )


def streams(status: LiveStatus) -> str:
    """A line per receiver."""
    if not status.streams:
        return f'<div style="{_SMALL}">none; add one with --to</div>'
    return _table(
        ("to", "sent", "dropped", "refused", "failed"),
        (
            (f"{one.to} {one.remark}", one.sent, one.dropped, one.refused, one.failed)
            for one in status.streams
        ),
    )


def incidents(status: LiveStatus) -> str:
    """The latest first."""
    lines = [
        f"<div>{_clock(one.time_s)} {escaped(one.what)}</div>" for one in reversed(status.incidents)
    ]
    return f'<div style="{_SMALL};overflow-wrap:anywhere">{"".join(lines) or "none"}</div>'


def _light(source: SourceStatus) -> str:
    return _dot(source.light, f"{source.light.value}, {source.rate_hz:.0f} Hz{_age(source)}")


def _dot(light: Light, title: str = "") -> str:
    symbol, colour = _LIGHTS[light]
    return f'<span style="color:{colour}" title="{escaped(title or light.value)}">{symbol}</span>'


def _age(source: SourceStatus) -> str:
    if source.light is Light.WAITING:
        return ", nothing yet"
    return "" if source.light is Light.FRESH else f", last {source.age_s:.1f} s ago"


def _remark(source: SourceStatus) -> str:
    dropped = f", {source.dropped} passed over" if source.dropped else ""
    return dropped + (f" ({escaped(source.note)})" if source.note else "")


def _table(head: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    def row(cells: Sequence[object], tag: str) -> str:
        first, *others = (escaped(str(cell)) for cell in cells)
        right = "".join(f'<{tag} style="text-align:right">{cell}</{tag}>' for cell in others)
        return f'<tr><{tag} style="text-align:left">{first}</{tag}>{right}</tr>'

    body = "".join(row(cells, "td") for cells in rows)
    top = row(head, "th") if head else ""
    return (
        f'<div style="{_SMALL}">'
        '<table style="width:100%;border-spacing:0 1px;overflow-wrap:anywhere">'
        f"{top}{body}</table></div>"
    )


def _clock(seconds: float) -> str:
    minutes, rest = divmod(int(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{rest:02d}" if hours else f"{minutes}:{rest:02d}"
