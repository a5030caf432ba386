"""`fusecap live`."""

from __future__ import annotations

import signal
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from datetime import datetime
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from fusecap.cli.common import Json, SessionPath, check_choice, print_json
from fusecap.cli.models import ask_for_networks
from fusecap.cli.targets import TO_HELP, placed_targets, warn_if_open
from fusecap.cli.terminal import console, err, note, progress
from fusecap.errors import InputError
from fusecap.interrupts import leave_terminal

if TYPE_CHECKING:
    from fusecap.live.devices.playback_sources import PlaybackOptions, Stall
    from fusecap.live.recorder import RecordSwitch
    from fusecap.live.run import LiveRun
    from fusecap.live.streaming import Streaming
    from fusecap.sources.session import Session
    from fusecap.streams.target import Target
    from fusecap.viewer.live import LiveViewer

EXAMPLE = "Example: fusecap live studio --to vmc://127.0.0.1:39539 --to ws --view"


def live(
    session: SessionPath,
    to: Annotated[list[str] | None, typer.Option(help=TO_HELP, show_default=False)] = None,
    record: Annotated[
        Path | None,
        typer.Option(
            help="The recording to write; default SESSION/<name>-<date>-<time>.mcap.",
            show_default=False,
        ),
    ] = None,
    no_record: Annotated[bool, typer.Option("--no-record", help="Record nothing.")] = False,
    record_images: Annotated[
        bool, typer.Option("--record-images", help="Also record the pictures, as JPEG.")
    ] = False,
    view: Annotated[bool, typer.Option(help="Serve a page that shows the run.")] = False,
    host: Annotated[
        str | None,
        typer.Option(
            help="Address on which ws and the page are served; 0.0.0.0 opens them to other "
            "machines. Without, only this machine can connect.",
            show_default=False,
        ),
    ] = None,
    view_port: Annotated[
        int | None, typer.Option(min=1, max=65535, help="Of the page.", show_default=False)
    ] = None,
    seconds: Annotated[
        float | None, typer.Option(min=0.1, help="End after so many seconds; default: Ctrl-C.")
    ] = None,
    delay_ms: Annotated[
        float | None,
        typer.Option(
            min=0,
            max=5000,
            help="Between exposure and solve, in milliseconds; default: as the session says, else "
            "200 with a detector and 50 without.",
        ),
    ] = None,
    poses: Annotated[
        str | None,
        typer.Option(
            help="Which are sent: solved, when pictures are there; ahead of these, by sensors and "
            "motion; or settled, by what was measured since. Default: as the session says, else "
            "solved.",
            show_default=False,
        ),
    ] = None,
    playback: Annotated[
        bool,
        typer.Option(
            "--playback", help="Play the session's recorded files as if they were devices."
        ),
    ] = False,
    loop: Annotated[
        bool, typer.Option("--loop", help="Of --playback: start again at the end.")
    ] = False,
    in_memory: Annotated[
        bool,
        typer.Option(
            "--in-memory", help="Of --playback: decode the videos before the run, not during it."
        ),
    ] = False,
    jitter_ms: Annotated[
        float,
        typer.Option(min=0, help="Of --playback: random delay of arrival, up to milliseconds."),
    ] = 0.0,
    loss: Annotated[
        float, typer.Option(min=0, max=1, help="Of --playback: share of samples that get lost.")
    ] = 0.0,
    stall: Annotated[
        list[str] | None,
        typer.Option(
            help="Of --playback: CAMERA:START:LENGTH in seconds, when a camera (or SUBJECT, or "
            "SUBJECT/BONE) delivers nothing. Repeatable.",
            show_default=False,
        ),
    ] = None,
    as_json: Json = False,
) -> None:
    """Capture, solve and stream people in real time, from live cameras and sensors.

    What the session's live keys name is opened; docs/live.md describes them, delay and faults.
    Ctrl-C ends the run and leaves a whole recording.
    """
    from fusecap.cli.live_status import LiveLine, print_report
    from fusecap.live.devices.source import SessionClock
    from fusecap.live.opening import check_live, networks_of, open_setup, open_sources
    from fusecap.live.recorder import RecordSwitch
    from fusecap.live.run import LiveOptions, LiveRun
    from fusecap.recording.layout import SUFFIX
    from fusecap.sources.session import POSES
    from fusecap.sources.session_file import load_session

    if no_record and (record is not None or record_images):
        raise InputError("--no-record says that nothing is recorded; leave it or --record out")
    if record is not None and record.suffix != SUFFIX:
        raise InputError(f"--record {record}: a recording is one {SUFFIX} file")
    targets = placed_targets(to or [], host, other_servers=view)
    if poses is not None:
        check_choice("--poses", poses, POSES)
    loaded = load_session(session)
    if poses is not None:
        live_settings = loaded.live.model_copy(update={"poses": poses})
        loaded = loaded.model_copy(update={"live": live_settings})
    played = _playback(
        playback,
        loop=loop,
        in_memory=in_memory,
        jitter_ms=jitter_ms,
        loss=loss,
        stalls=stall or [],
    )
    missing = [] if played else check_live(loaded)
    if (networks := networks_of(loaded, playback=playback)) is not None:
        ask_for_networks(networks, quiet=as_json)
    with progress(quiet=as_json) as show:
        setup, detector = open_setup(loaded, playback=playback, progress=show)
        clock = SessionClock()
        sources = open_sources(loaded, clock, played, show)
    options = LiveOptions(delay_s=None if delay_ms is None else 1e-3 * delay_ms)
    run = LiveRun(setup, sources, detector, options, clock=clock)
    try:
        streaming = _add_streams(run, targets)
        switch = RecordSwitch(run, partial(recording_path, loaded), images=record_images)
        page = _add_viewer(run, switch, host, view_port) if view else None
        path = None if no_record else switch.begin(record)  # last: a refused port leaves no file
    except BaseException:
        run.close()
        raise
    if not as_json:
        _announce(run, streaming, path, page.address if page else None, missing)
    for target in targets:
        warn_if_open(target)
    if page is not None and page.note:
        note(page.note)
    with _until_interrupted(run, quiet=as_json):
        with LiveLine(run, quiet=as_json):
            report = run.run(seconds)
        if as_json:
            print_json({**report.as_json(), "missing": missing})
        else:
            print_report(report)
    if streaming is not None and streaming.down:
        raise InputError("streams were not sent at the end of the run: see its incidents")


def _playback(
    wanted: bool,
    *,
    loop: bool,
    in_memory: bool,
    jitter_ms: float,
    loss: float,
    stalls: Sequence[str],
) -> PlaybackOptions | None:
    from fusecap.live.devices.playback_sources import PlaybackOptions

    if not wanted:
        if loop or in_memory or jitter_ms or loss or stalls:
            raise InputError(
                "--loop, --in-memory, --jitter-ms, --loss and --stall are about recorded files; "
                "add --playback"
            )
        return None
    return PlaybackOptions(
        loop=loop,
        in_memory=in_memory,
        jitter_ms=jitter_ms,
        loss=loss,
        stalls=tuple(_stall(text) for text in stalls),
    )


def _stall(text: str) -> Stall:
    from fusecap.live.devices.playback_sources import Stall

    source, *numbers = text.rsplit(":", 2)
    try:
        start_s, length_s = map(float, numbers)
    except ValueError:
        raise InputError(
            f"--stall {text}: expected CAMERA:START:LENGTH with seconds, as in left:10:2.5"
        ) from None
    if not source or not start_s >= 0 or not length_s > 0:
        raise InputError(f"--stall {text}: expected a name, a start from 0 and a length above 0")
    return Stall(source=source, start_s=start_s, length_s=length_s)


def _add_streams(run: LiveRun, targets: Sequence[Target]) -> Streaming | None:
    if not targets:
        return None
    from fusecap.live.streaming import Streaming

    streaming = Streaming(
        targets, run.setup, run.rate_hz, run.clock, run.latency, run.incidents.add
    )
    run.add_listener(streaming)
    return streaming


def recording_path(session: Session) -> Path:
    """A name of its own for each recording, beside the session."""
    from fusecap.files import safe_name
    from fusecap.recording.layout import SUFFIX

    now = datetime.now().strftime("%Y-%m-%d-%H%M%S")
    return session.folder / f"{safe_name(session.settings.name)}-{now}{SUFFIX}"


def _add_viewer(
    run: LiveRun, switch: RecordSwitch, host: str | None, port: int | None
) -> LiveViewer:
    from fusecap.viewer.live import LiveViewer

    viewer = LiveViewer(run.setup, run, host or "127.0.0.1", port, on_record=switch.turn)
    run.add_listener(viewer)
    return viewer


def _announce(
    run: LiveRun,
    streaming: Streaming | None,
    path: Path | None,
    page: str | None,
    missing: Sequence[str],
) -> None:
    session = run.setup.session
    sensors = sum(len(subject.imus) for subject in session.subjects)
    pace = ", or sooner where all is there" if run.eager else ""
    sends = {
        "solved": "",
        "ahead": ", and sent ahead of that",
        "settled": f", and sent {1e3 * session.live.settle_s:.0f} ms later",
    }[session.live.poses]
    lines = [
        f"{session.settings.name}: {len(session.cameras)} cameras, {len(session.subjects)} people "
        f"with {sensors} sensors; {run.rate_hz:g} instants/s, each solved "
        f"{1e3 * run.delay_s:.0f} ms after exposure{pace}{sends}; Ctrl-C ends it"
    ]
    for where in streaming.addresses if streaming else ():
        lines += [f"  {name} -> {address}" for name, address in where.items()]
    if path is not None:
        lines.append(f"  recording -> {path}")
    if page is not None:
        lines.append(f"  page -> {page}")
    for line in lines:
        console.print(line, soft_wrap=True)
    if missing:
        note(f"no live key, and so not used: {', '.join(missing)}")


@contextmanager
def _until_interrupted(run: LiveRun, *, quiet: bool) -> Iterator[None]:
    """Ctrl-C, SIGTERM and SIGHUP end the run; a second one does not cut its end short."""

    def end(number: int, frame: object) -> None:
        leave_terminal(number)
        run.stop()
        if not quiet:
            err.print("ending: closing devices, streams and the recording")

    names = ("SIGINT", "SIGTERM", "SIGHUP")  # Windows knows no SIGHUP
    numbers = [getattr(signal, name) for name in names if hasattr(signal, name)]
    before = {number: signal.signal(number, end) for number in numbers}
    try:
        yield
    finally:
        for number, handler in before.items():
            if signal.getsignal(number) is end:
                signal.signal(number, handler)
