"""A spoilt session is refused by `doctor` and by `solve` alike, in words."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from fusecap.cli import app
from fusecap.errors import FusecapError
from session_files import imu_csv, write_session
from tiny_networks import constant_network
from video_files import stripe, write_video

Spoil = Callable[[Path], None]
IMU, VIDEO, FRAME = "arm.csv", "cam1.mp4", "keypoints/cam0/cam0_000000000003_keypoints.json"


@pytest.fixture(scope="module")
def sound(tmp_path_factory) -> Path:
    """A camera with keypoints, one with a video and networks for it, and a sensor."""
    folder = tmp_path_factory.mktemp("sound")
    session = write_session(folder, frames=12, cameras=2)
    shutil.rmtree(folder / "keypoints" / "cam1")
    write_video(folder / VIDEO, 12, picture=lambda n: stripe(n, (1280, 720)))
    heatmaps = np.zeros((1, 25, 32, 24), np.float32)
    constant_network(folder / "pose.onnx", ("n", 3, 128, 96), {"maps": heatmaps})
    boxes = {"dets": np.zeros((1, 1, 5)), "labels": np.zeros((1, 1), np.int64)}
    constant_network(folder / "rtmdet.onnx", (1, 3, 640, 640), boxes)
    still = np.tile([1.0, 0.0, 0.0, 0.0], (25, 1))
    (folder / IMU).write_text(imu_csv(np.arange(25) / 60, still))
    text = session.read_text().replace('keypoints = "keypoints/cam1"', f'video = "{VIDEO}"')
    session.write_text(
        text + '\n[detector]\nmodel = "pose.onnx"\nperson_model = "rtmdet.onnx"\n'
        f'[[subject]]\nname = "anna"\n[[subject.imu]]\nbone = "left_forearm"\nfile = "{IMU}"\n'
        "bone_from_imu_wxyz = [1, 0, 0, 0]\n"
    )
    return folder


@pytest.fixture(scope="module")
def solvable(sound, tmp_path_factory) -> Path:
    """Two cameras with keypoints and the sensor."""
    folder = tmp_path_factory.mktemp("solvable")
    session = write_session(folder, frames=12, cameras=2)
    shutil.copy(sound / IMU, folder)
    subject = (sound / "session.toml").read_text().partition("[[subject]]")[2]
    session.write_text(session.read_text() + "\n[[subject]]" + subject)
    return folder


def pipe(path: Path) -> None:
    path.unlink()
    os.mkfifo(path)


def folder(path: Path) -> None:
    path.unlink()
    path.mkdir()


def empty(path: Path) -> None:
    path.write_bytes(b"")


def endless(path: Path) -> None:
    path.unlink()
    path.symlink_to("/dev/zero")


def not_to_be_opened(path: Path) -> None:
    """As a file without permission, for which the superuser has one all the same."""
    path.unlink()
    path.symlink_to(path.name)


def gone(path: Path) -> None:
    path.unlink()


def garbage(path: Path) -> None:
    path.write_bytes(np.random.default_rng(0).bytes(3000))


def halved(path: Path) -> None:
    content = path.read_bytes()
    path.write_bytes(content[: len(content) // 2])


def drawing(path: Path) -> None:
    path.write_text('<svg xmlns="http://www.w3.org/2000/svg" width="64" height="48"/>')


def times(change: Callable[[np.ndarray], np.ndarray]) -> Spoil:
    def spoil(path: Path) -> None:
        still = np.tile([1.0, 0.0, 0.0, 0.0], (25, 1))
        path.write_text(imu_csv(change(np.arange(25) / 60), still))

    return spoil


ANYTHING = (pipe, folder, empty, endless, not_to_be_opened, gone, garbage)
CASES: dict[str, tuple[str, Spoil]] = {
    f"{name} {spoil.__name__}": (name, spoil)
    for name in (IMU, VIDEO, "calibration.toml", "pose.onnx", "rtmdet.onnx", "session.toml")
    for spoil in ANYTHING
} | {
    "video halved": (VIDEO, halved),
    "video that is a drawing": (VIDEO, drawing),
}
TIMES: dict[str, tuple[Spoil, bool]] = {
    "as they should be": (times(lambda t: t), False),
    "backwards": (times(lambda t: t[::-1]), False),
    "all the same": (times(lambda t: 0 * t), False),
    "infinite from somewhere on": (times(lambda t: np.where(t > 0.1, np.inf, t)), False),
    "no number from somewhere on": (times(lambda t: np.where(t > 0.1, np.nan, t)), False),
    "all infinite": (times(lambda t: t + np.inf), True),
    "beyond any clock": (times(lambda t: t * 1e300), True),
    "beyond numbers": (times(lambda t: t * 1.7e308), True),
    "of another year": (times(lambda t: t + 3e7), True),
}


def verdict(command: str, session: Path) -> tuple[bool, str]:
    """Whether it is refused, and what is said; raises what is no message."""
    more = ["--json"] if command == "doctor" else ["--out", str(session / "take.npz")]
    ran = CliRunner().invoke(app, [command, str(session), *more])
    if ran.exception is not None and not isinstance(ran.exception, FusecapError | SystemExit):
        raise ran.exception
    said = f"{ran.output}{ran.exception or ''}"
    if command == "doctor" and not isinstance(ran.exception, FusecapError):
        said = json.dumps(json.loads(ran.stdout)["findings"], ensure_ascii=False)
        assert ran.exit_code == int('"severity": "error"' in said)
    return ran.exit_code != 0, said


@pytest.mark.parametrize("case", CASES)
def test_what_doctor_refuses_solve_refuses_and_the_other_way_round(case, sound, tmp_path):
    name, spoil = CASES[case]
    session = shutil.copytree(sound, tmp_path / "session")
    spoil(session / name)
    by_doctor, told_by_doctor = verdict("doctor", session)
    by_solve, told_by_solve = verdict("solve", session)
    assert (by_doctor, by_solve) == (True, True), (told_by_doctor, told_by_solve)
    where = {IMU: "left_forearm", VIDEO: "cam1"}.get(name, "calib")
    where = {"session.toml": "session", "pose.onnx": "pose", "rtmdet.onnx": "rtmdet"}.get(
        name, where
    )
    for said in (told_by_doctor, told_by_solve):
        assert where in said or name in said


@pytest.mark.parametrize(("keypoints", "refused"), [(25, False), (17, True)])
def test_keypoints_of_another_detector_are_refused_before_videos_are_looked_at(
    keypoints, refused, sound, tmp_path
):
    session = shutil.copytree(sound, tmp_path / "session")
    heatmaps = np.zeros((1, keypoints, 32, 24), np.float32)
    constant_network(session / "pose.onnx", ("n", 3, 128, 96), {"maps": heatmaps})
    by_doctor, told_by_doctor = verdict("doctor", session)
    assert by_doctor is refused, told_by_doctor
    if refused:
        by_solve, told_by_solve = verdict("solve", session)
        assert by_solve
        for said in (told_by_doctor, told_by_solve):
            assert "the detector finds coco17" in said and "'cam0' body25" in said


@pytest.mark.parametrize("case", TIMES)
def test_times_are_judged_alike(case, solvable, tmp_path):
    spoil, refused = TIMES[case]
    session = shutil.copytree(solvable, tmp_path / "session")
    spoil(session / IMU)
    by_doctor, told_by_doctor = verdict("doctor", session)
    by_solve, told_by_solve = verdict("solve", session)
    assert (by_doctor, by_solve) == (refused, refused), (told_by_doctor, told_by_solve)
    assert case == "as they should be" or "left_forearm" in told_by_doctor or refused


@pytest.mark.parametrize("spoil", [pipe, folder, empty, endless, not_to_be_opened, garbage])
def test_a_single_frame_that_cannot_be_read_is_a_frame_without_people(spoil, sound, tmp_path):
    """As one that is missing; with all of them so, both refuse."""
    session = shutil.copytree(sound, tmp_path / "session")
    frames = sorted((session / FRAME).parent.iterdir())
    spoil(session / FRAME)
    assert "1 of 12 keypoint files (8.3%) are truncated" in verdict("doctor", session)[1]
    for frame in frames:
        if frame != session / FRAME:
            spoil(frame)
    assert verdict("doctor", session)[0] and verdict("solve", session)[0]


@pytest.mark.parametrize("spoil", [None, garbage, empty, halved, drawing, pipe, gone])
def test_a_video_that_cannot_be_read_beside_keypoints_is_told_by_both(
    spoil, sound, solvable, tmp_path
):
    """Refused where nothing of that name can be a video at all, as it is without keypoints."""
    session = shutil.copytree(solvable, tmp_path / "session")
    shutil.copy(sound / VIDEO, session)
    text = (session / "session.toml").read_text()
    camera = 'keypoints = "keypoints/cam1"'
    (session / "session.toml").write_text(
        text.replace(camera, f'{camera}\nvideo = "{VIDEO}"\nrate_hz = 60')
    )
    if spoil is not None:
        spoil(session / VIDEO)
    refused = spoil in (pipe, gone)
    for command in ("doctor", "solve"):
        was_refused, said = verdict(command, session)
        assert was_refused is refused, said
        assert (VIDEO in said) == (spoil is not None)
