"""`fusecap overlay`, and the sticks that every picture of a solved person is made of."""

from __future__ import annotations

import json
import signal
from dataclasses import replace

import numpy as np
import pytest
from typer.testing import CliRunner

from fusecap.batch.overlay import draw_take
from fusecap.cli import app
from fusecap.errors import InputError
from fusecap.evaluate.demo_scene import demo_scene
from fusecap.evaluate.simulated_session import write_session
from fusecap.exports.plot import plot_take
from fusecap.exports.stick_figures import StickFigure, TakeSticks, passing
from fusecap.sources.session_cameras import with_detections
from fusecap.sources.session_file import load_session
from fusecap.sources.video import Video
from fusecap.take import save_take
from motions import person, take_of, walk
from video_files import write_video

FRAMES = 12


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    """A fifth of a second of the demo, black videos of a quarter of the cameras' width."""
    folder = tmp_path_factory.mktemp("scene")
    simulation = demo_scene(0, seconds=FRAMES / 60)
    write_session(simulation, folder)
    black = np.zeros((270, 480, 3), np.uint8)
    text = (folder / "session.toml").read_text()
    for name in ("cam1", "cam2"):
        write_video(folder / f"{name}.mp4", FRAMES, rate_hz=60, picture=lambda _: black)
        keypoints = f'keypoints = "keypoints/{name}"'
        text = text.replace(keypoints, f'{keypoints}\nvideo = "{name}.mp4"')
    (folder / "session.toml").write_text(text)
    save_take(simulation.truth, folder / "demo.npz")
    return folder, simulation


def drawn(scene, tmp_path, take=None, **options):
    folder, simulation = scene
    session = with_detections(load_session(folder))
    return draw_take(take or simulation.truth, session, tmp_path, "demo", **options)


def last_picture(path) -> np.ndarray:
    return list(Video(path).frames())[-1].image


def test_solved_people_lie_where_the_camera_sees_them(scene, tmp_path):
    _, simulation = scene
    made = drawn(scene, tmp_path)
    assert [path.name for path in made.files] == ["demo_cam1_overlay.mp4", "demo_cam2_overlay.mp4"]
    assert not made.interrupted
    take, camera = simulation.truth, simulation.rig.cameras[0]
    image = last_picture(made.files[0])
    for row in range(2):
        knee = take.bone_position_in_world_m[row, -1, [take.bone_names.index("left_shank")]]
        x, y = (camera.project(knee)[0] / 4).round().astype(int)
        assert image[y - 1 : y + 2, x - 1 : x + 2].max() > 120, take.subject_names[row]


def test_who_is_nobody_of_the_take_is_grey(scene, tmp_path):
    _, simulation = scene
    nobody = replace(simulation.truth, tracked=np.zeros_like(simulation.truth.tracked))
    image = last_picture(drawn(scene, tmp_path, nobody).files[0]).astype(int)
    bright = image[image.max(axis=2) > 100]
    assert len(bright) > 100
    assert np.median(np.ptp(bright, axis=1)) < 25


def test_ctrl_c_leaves_a_whole_video_and_the_earlier_one(scene, tmp_path):
    whole = drawn(scene, tmp_path).files[0].read_bytes()

    def stop(what: str, done: int, _: int) -> None:
        if what == "drawing cam1" and done == 5:
            signal.raise_signal(signal.SIGINT)

    made = drawn(scene, tmp_path, progress=stop)
    assert made.interrupted
    assert [path.name for path in made.files] == ["demo_cam1_overlay_interrupted.mp4"]
    assert Video(made.files[0]).info.frames == 5
    assert (tmp_path / "demo_cam1_overlay.mp4").read_bytes() == whole


def test_ctrl_c_at_the_last_frame_leaves_what_is_drawn_and_begins_no_other(scene, tmp_path):
    def stop(what: str, done: int, of: int) -> None:
        if what == "drawing cam1" and done == of:
            signal.raise_signal(signal.SIGINT)

    made = drawn(scene, tmp_path, progress=stop)
    assert made.interrupted
    assert [path.name for path in made.files] == ["demo_cam1_overlay.mp4"]


def test_overlay_command_finds_the_session_beside_the_take(scene, tmp_path):
    folder, simulation = scene
    result = CliRunner().invoke(
        app, ["overlay", str(folder / "demo.npz"), "--out", str(tmp_path), "--json"]
    )
    assert result.exit_code == 0, result.output
    assert len(json.loads(result.stdout)["files"]) == 2
    save_take(simulation.truth, tmp_path / "away.npz")
    away = CliRunner().invoke(app, ["overlay", str(tmp_path / "away.npz")])
    assert away.exit_code != 0 and "--session" in str(away.exception)


def test_a_session_without_videos_is_told_so(tmp_path):
    simulation = demo_scene(0, seconds=0.1)
    write_session(simulation, tmp_path)
    with pytest.raises(InputError, match="no camera has a video"):
        draw_take(simulation.truth, load_session(tmp_path), tmp_path, "demo")


def test_bones_that_nothing_measures_are_told_from_the_others():
    shape = person()
    take = take_of(walk(shape, 2)[None], [shape], names=("anna",))
    shank = take.bone_names.index("left_shank")
    sigma = take.bone_sigma_deg.copy()
    sigma[:, :, shank] = 60.0
    sticks = TakeSticks(replace(take, bone_sigma_deg=sigma)).at_frame(0, 0)
    assert sticks is not None
    (only,) = np.flatnonzero(~sticks.measured)
    np.testing.assert_allclose(sticks.start_m[only], take.bone_position_in_world_m[0, 0, shank])
    assert sticks.left[only] and not sticks.right[only]


def test_between_frames_people_move_straight_and_beyond_them_nobody_is():
    shape = person()
    take = take_of(walk(shape, 4)[None], [shape], names=("anna",))
    lost = replace(take, tracked=np.array([[True, True, False, True]]))
    figures, period_ns = TakeSticks(lost), 1e9 / 60
    first, second = (figures.at_frame(0, frame) for frame in (0, 1))
    middle = figures.at_time(0, round(0.5 * period_ns))
    assert first is not None and second is not None and middle is not None
    np.testing.assert_allclose(middle.end_m, (first.end_m + second.end_m) / 2, atol=1e-6)
    assert figures.at_time(0, round(1.4 * period_ns)) is not None
    assert figures.at_time(0, round(2.0 * period_ns)) is None
    assert figures.at_time(0, round(-0.6 * period_ns)) is None
    assert figures.at_time(0, round(3.4 * period_ns)) is not None
    assert figures.at_time(0, round(9.0 * period_ns)) is None


def test_sticks_reach_every_joint_and_every_end():
    shape = person()
    sticks = StickFigure(shape.skeleton).sticks(
        shape,
        np.zeros((shape.skeleton.bone_count, 3)),
        np.tile(np.eye(3), (shape.skeleton.bone_count, 1, 1)),
        np.ones(shape.skeleton.bone_count),
    )
    assert len(sticks.start_m) == shape.skeleton.bone_count - 1 + 5


def test_passers_by_do_not_widen_a_picture(tmp_path, monkeypatch):
    shape = person()
    theta = np.stack([walk(shape, 20), walk(shape, 20)])
    theta[1, :, 0] = 40.0
    take = take_of(theta, [shape, shape], names=("anna", "somebody"))
    tracked = take.tracked.copy()
    tracked[1, 2:] = False
    take = replace(take, tracked=tracked)
    assert passing(take.tracked).tolist() == [False, True]
    limits = []
    monkeypatch.setattr(
        "fusecap.exports.plot.write_picture",
        lambda figure, _: (
            figure.canvas.draw(),
            limits.extend(ax.get_xlim() for ax in figure.axes),
        ),
    )
    plot_take(take, [0], tmp_path / "take.png")
    assert max(high for _, high in limits) < 10
    assert passing(take.of_subjects([]).tracked).tolist() == []
