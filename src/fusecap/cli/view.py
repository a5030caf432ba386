"""`fusecap view`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Annotated

import typer

from fusecap.cli.common import Json, print_json
from fusecap.cli.terminal import console, note, progress
from fusecap.errors import FusecapError

if TYPE_CHECKING:
    from fusecap.geometry.camera import Rig
    from fusecap.sources.session import Session
    from fusecap.viewer.backdrop import OpenVideo
    from fusecap.viewer.curves import BoneCurve
    from fusecap.viewer.page import Page
    from fusecap.viewer.recording import RecordedDetections
    from fusecap.viewer.take import ViewedTake

EXAMPLE = "Example: fusecap view demo/demo.npz --truth scene/truth.npz --session scene"

Port = Annotated[
    int | None,
    typer.Option(min=1, max=65535, help="Of the page; without, the first free one from 8080 on."),
]
Host = Annotated[
    str,
    typer.Option(
        help="Address on which the page is served; 0.0.0.0 opens it to other machines. Without, "
        "only this machine can look."
    ),
]
NoBrowser = Annotated[bool, typer.Option("--no-browser", help="Only print the page's address.")]


def view(
    take: Annotated[
        Path,
        typer.Argument(
            help="A solved take (.npz) or a live recording (.mcap).", show_default=False
        ),
    ],
    session: Annotated[
        Path | None,
        typer.Option(
            help="Its session.toml or folder: shows the cameras and their videos; default: the one "
            "beside a take."
        ),
    ] = None,
    truth: Annotated[
        Path | None, typer.Option(help="A take of the true motion: plots the errors.")
    ] = None,
    port: Port = None,
    host: Host = "127.0.0.1",
    no_browser: NoBrowser = False,
    as_json: Json = False,
) -> None:
    """Look at a take or a recording in a browser: play, pause, scrub, from all sides.

    Nothing leaves this machine. Ctrl-C ends it.
    """
    from fusecap.recording.layout import SUFFIX
    from fusecap.sources.session import FILE_NAME
    from fusecap.stored_take import StoredTake
    from fusecap.viewer.backdrop import videos_of

    detections, unread = None, None
    if take.suffix == SUFFIX:
        loaded, detections, read = _recorded(take, as_json)
        unread = None if read else take
    else:
        loaded = StoredTake(take)
        loaded.check()
    rig, filmed = None, None
    if session is not None:
        rig, filmed = _filmed(session)
    elif detections is not None:
        rig = detections.setup.rig
    elif isinstance(loaded, StoredTake) and take.with_name(FILE_NAME).is_file():
        from fusecap.batch.solved_inputs import inputs_beside

        beside, why = inputs_beside(take, loaded)
        if beside is None:
            note(f"without the cameras of the session beside the take: {why}")
        elif beside.name == FILE_NAME:
            try:
                rig, filmed = _filmed(beside)
            except FusecapError as error:
                note(f"without the cameras of the session beside the take: {error}")
        else:
            note(
                f"without cameras: the take is of {beside.name}, whose clock is not that of the "
                f"session's videos; to see cameras: fusecap view {beside.name}"
            )
    curves = [] if truth is None else error_curves(loaded, StoredTake(truth))
    look(
        loaded,
        f"fusecap view {take.name}",
        rig=rig,
        # A recording has a clock of its own.
        videos={} if filmed is None or take.suffix == SUFFIX else videos_of(filmed),
        curves=curves,
        detections=detections,
        unread=unread,
        host=host,
        port=port,
        browser=not no_browser,
        as_json=as_json,
    )


def error_curves(take: ViewedTake, truth: ViewedTake) -> list[BoneCurve]:
    """Of positions and orientations; raises `TakeError` where the two have nothing in common."""
    import numpy as np

    from fusecap.evaluate.errors_over_time import errors_over_time
    from fusecap.evaluate.score import same_instants
    from fusecap.viewer.curves import BoneCurve, drawn

    shared, _ = same_instants(take.timestamps_ns, truth.timestamps_ns)
    frames = np.union1d(drawn(shared), drawn(np.arange(len(take.timestamps_ns))))
    seen = take.at_frames(frames)
    _, true_frames = same_instants(seen.timestamps_ns, truth.timestamps_ns)
    errors = errors_over_time(seen, truth.at_frames(np.unique(true_frames)))
    time_s = take.time_s[frames]
    return [
        BoneCurve(title=title, time_s=time_s, by_person=values)
        for title, values in (
            ("position error (mm)", errors.position_mm),
            ("orientation error (degrees)", errors.orientation_deg),
        )
    ]


def _filmed(path: Path) -> tuple[Rig, Session]:
    """The cameras of a session, and the session with what its files say."""
    from fusecap.sources.session_cameras import open_rig, with_detections
    from fusecap.sources.session_file import parse_session

    session = parse_session(path)
    return open_rig(session)[0], with_detections(session)


def look(
    take: ViewedTake,
    title: str,
    *,
    rig: Rig | None,
    videos: Mapping[str, OpenVideo] = MappingProxyType({}),
    curves: Sequence[BoneCurve],
    detections: RecordedDetections | None = None,
    unread: Path | None = None,
    host: str = "127.0.0.1",
    port: int | None = None,
    browser: bool = True,
    as_json: bool = False,
) -> None:
    """Serve a page until Ctrl-C, which is how it is closed and so no failure.

    `unread` is a recording of which it is not known yet what is damaged.
    """
    from fusecap.viewer.page import Page
    from fusecap.viewer.recording import look_for_damage
    from fusecap.viewer.take import TakePage

    page, is_shown = Page(title, host=host, port=port), True
    with suppress(KeyboardInterrupt):
        try:
            shown = TakePage(
                page, take, rig=rig, videos=videos, curves=curves, detections=detections
            )
            _announce(page, browser=browser, as_json=as_json)

            def tell(text: str) -> None:
                if is_shown:
                    note(text)
                    shown.tell(text)

            if unread is not None:
                look_for_damage(unread, tell)
            shown.run()
        finally:
            is_shown = False
            page.stop()


def _recorded(path: Path, quiet: bool) -> tuple[ViewedTake, RecordedDetections | None, bool]:
    """The poses of a recording, its detections where it has cameras; whether all of it was read."""
    from fusecap.batch.replay import RecordedMotion, loss_notes, recorded_setup
    from fusecap.recording.index import RecordingIndex
    from fusecap.recording.reader import Recording
    from fusecap.viewer.recording import SHOWN_HZ, RecordedDetections

    recording = Recording(path)
    with progress(quiet=quiet) as show:
        index = RecordingIndex(recording, keypoints_hz=SHOWN_HZ, progress=show)
    for text in loss_notes(recording):
        note(text)
    setup = recorded_setup(recording)
    detections = RecordedDetections(index, setup) if len(setup.rig) else None
    return RecordedMotion(recording, index), detections, index.read_whole


def _announce(page: Page, *, as_json: bool, browser: bool) -> None:
    """Says where the page is, who can reach it, and opens it."""
    import webbrowser

    from fusecap.viewer.page import note_if_open

    remark = note_if_open(page)
    if as_json:
        print_json({"address": page.address, "open": page.is_open})
    else:
        who = "" if page.is_open else " (only from this machine)"
        console.print(f"watch at {page.address}{who}; Ctrl-C ends it", soft_wrap=True)
    if remark:
        note(remark)
    if browser:
        webbrowser.open(page.address)
