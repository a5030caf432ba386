"""`fusecap detect`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from fusecap.cli.common import Json, check_choice, print_json
from fusecap.cli.models import ask_for_networks
from fusecap.cli.terminal import console, err, note, progress, remark, table_of, wrote
from fusecap.errors import InputError

if TYPE_CHECKING:
    from fusecap.batch.detect import Detected
    from fusecap.sources.session import Session

EXAMPLE = "Example: fusecap detect recordings/duo --overlay"
FEW_PEOPLE_SHARE = 0.05
"""Of a camera's frames; fewer with people are worth a warning."""


def detect(
    recording: Annotated[
        list[Path],
        typer.Argument(
            help="A session (session.toml or its folder), a folder of videos, or video files.",
            show_default=False,
        ),
    ],
    out: Annotated[
        Path | None,
        typer.Option(help="Folder for a folder per camera; default: keypoints beside the videos."),
    ] = None,
    model: Annotated[
        str | None, typer.Option(help="Pose network: a name, or a file (.onnx, .xml).")
    ] = None,
    person_model: Annotated[
        str | None, typer.Option(help="Person detector: a name, or a file (.onnx, .xml).")
    ] = None,
    runtime: Annotated[
        str | None, typer.Option(help="auto (default), onnxruntime or openvino.")
    ] = None,
    person_every: Annotated[
        int | None,
        typer.Option(min=1, help="Instants between runs of the person detector; default 10."),
    ] = None,
    packed: Annotated[
        bool, typer.Option("--packed", help="All views in one picture for whole-image networks.")
    ] = False,
    overlay: Annotated[
        bool, typer.Option("--overlay", help="Also a video per camera with people drawn in.")
    ] = False,
    as_json: Json = False,
) -> None:
    """Find everyone's keypoints in videos, as OpenPose JSON; goes on where it was stopped."""
    from fusecap.batch.detect import (
        detect_videos,
        detector_options,
        loose_videos,
        session_videos,
        video_setup,
    )
    from fusecap.detect.build import build_detector
    from fusecap.detect.runtimes.choice import RUNTIMES
    from fusecap.sources.session_file import load_session

    if runtime is not None:
        check_choice("--runtime", runtime, RUNTIMES)
    file = _session_file(recording)
    session = load_session(file) if file else None
    options = detector_options(
        session,
        model=model,
        person_model=person_model,
        runtime=runtime,
        person_every=person_every,
        packed=packed or None,
    )
    if session is not None:
        cameras = session_videos(session, out)
        if not cameras:
            raise InputError(f'{session.path}: no camera has a video; name one: video = "left.mp4"')
    else:
        videos = _videos(recording)
        cameras = loose_videos(videos, out or videos[0].parent / "keypoints")
    ask_for_networks(options, quiet=as_json)
    with progress(quiet=as_json, rate=True) as show:
        detector = build_detector(options, show)
        setup = video_setup(session, cameras, detector.landmarks) if session else None
        found = detect_videos(cameras, detector, setup=setup, progress=show)
        drawn = None
        if overlay and not found.interrupted:
            from fusecap.batch.overlay import draw_overlays

            drawn = draw_overlays(cameras, detector.landmarks, show)
    files = [] if drawn is None else drawn.files
    if as_json:
        print_json(found.as_json() | {"files": [str(path) for path in files]})
    else:
        print_detection(found)
        wrote(*files)
    _warn(found)
    if found.interrupted or (drawn is not None and drawn.interrupted):
        err.print("interrupted: what was found until then is kept; the same command goes on")
        raise typer.Exit(130)


def detect_missing(session: Session, *, quiet: bool) -> Detected | None:
    """Detects the session's videos that have no keypoints yet; None without such videos."""
    from fusecap.batch.detect import (
        detect_videos,
        detector_options,
        session_videos,
        video_setup,
    )
    from fusecap.detect.build import build_detector
    from fusecap.sources.session_cameras import refuse_other_landmarks

    cameras = session_videos(session, undetected=True)
    if not cameras:
        return None
    options = detector_options(session)
    ask_for_networks(options, quiet=quiet)
    with progress(quiet=quiet, rate=True) as show:
        detector = build_detector(options, show)
        refuse_other_landmarks(session, detector.landmarks.name)
        setup = video_setup(session, cameras, detector.landmarks)
        found = detect_videos(cameras, detector, setup=setup, progress=show)
    _warn(found)
    return found


def _session_file(recording: list[Path]) -> Path | None:
    from fusecap.sources.session import FILE_NAME

    first = recording[0]
    is_session = first.suffix == ".toml" or (first / FILE_NAME).is_file()
    if is_session and len(recording) > 1:
        raise InputError(f"{first} is a session; expected it alone, found {len(recording)} paths")
    return first if is_session else None


def _videos(recording: list[Path]) -> list[Path]:
    from fusecap.sources.video import videos_in

    return [video for path in recording for video in (videos_in(path) if path.is_dir() else [path])]


def print_detection(found: Detected) -> None:
    """What was found, camera by camera."""
    table = table_of(
        "camera", "frames", "people per frame", "frames with people", "mean confidence"
    )
    for column in table.columns[1:]:
        column.justify = "right"
    for name, camera in found.cameras.items():
        table.add_row(
            name,
            f"{camera.frames} of {camera.frames_in_video}",
            f"{camera.people_per_frame:.2f}",
            f"{100 * camera.frames_with_people:.1f} %",
            f"{camera.mean_confidence:.2f}",
        )
    console.print(table)
    if found.frames_detected:
        console.print(
            f"  detected           {found.frames_detected} frames ({found.landmark_set}), "
            f"{found.frames_per_s:.1f} frames/s; {found.elapsed_s:.1f} s in all"
        )
    else:
        console.print("  detected           nothing new: all frames were there already")
    for folder in sorted({str(Path(camera.folder).parent) for camera in found.cameras.values()}):
        console.print(f"keypoints in {folder}", soft_wrap=True)


def _warn(found: Detected) -> None:
    for text in found.notes:
        note(text)
    for name, camera in found.cameras.items():
        if camera.frames and camera.frames_with_people < FEW_PEOPLE_SHARE:
            remark(
                ("warning", "yellow"),
                f"camera '{name}' sees people in "
                f"{100 * camera.frames_with_people:.1f} % of its frames; look at its video with "
                "--overlay: turned on its side, too dark, or people too small for the network?",
            )
