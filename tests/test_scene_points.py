"""Cameras placed by points of the scene, as Pose2Sim's users do it, and what goes wrong there."""

import json
from dataclasses import replace

import numpy as np
import pytest

from fusecap.calibrate.cameras.scene_points import place_cameras
from fusecap.cli import main
from fusecap.errors import CalibrationError
from fusecap.geometry.camera import Rig
from fusecap.sources.calibration_files import load_rig, write_rig
from fusecap.sources.marked_points import MarkedPoints
from session_files import calibration_toml, ring

TRUE = ring(3)
ROOM = np.array(
    [[0, 0, 0], [1.2, 0, 0.1], [-0.3, 0.8, 0.9], [0.5, 1.5, -0.8], [-1, 0.2, -0.6], [0.9, 1, 0.7]]
)
FLOOR = np.array([[0, 0, 0], [0.9, 0, 0], [0, 0, 0.9], [0.9, 0, 0.9], [-0.7, 0, 0.4], [0, 0, -1.0]])


def marked(places: np.ndarray, told: np.ndarray, noise_px: float = 0.0) -> MarkedPoints:
    rng = np.random.default_rng(5)
    pixels = np.stack([camera.project(places) for camera in TRUE.cameras])
    pixels += noise_px * rng.standard_normal(pixels.shape)
    return MarkedPoints(
        names=tuple("abcdef"[: len(places)]),
        keypoints=np.concatenate([pixels, np.ones((*pixels.shape[:2], 1))], axis=2),
        in_world_m=told,
    )


@pytest.mark.parametrize("places", [ROOM, FLOOR, FLOOR[:4]], ids=["room", "floor", "four"])
def test_cameras_stand_where_the_points_say(places):
    placed, unseen = place_cameras(TRUE.cameras, marked(places, places))
    assert not unseen
    for found, true in zip(placed, TRUE.cameras, strict=True):
        assert np.allclose(found.camera.position_in_world, true.position_in_world, atol=1e-4)
        assert np.allclose(found.camera.rotation, true.rotation, atol=1e-4)
        assert found.rms_px < 0.01


def test_noise_of_marks_moves_cameras_as_far_as_stated():
    placed, _ = place_cameras(TRUE.cameras, marked(ROOM, ROOM, noise_px=2.0))
    off_mm = [
        1e3 * np.linalg.norm(found.camera.position_in_world - true.position_in_world)
        for found, true in zip(placed, TRUE.cameras, strict=True)
    ]
    stated_mm = [found.place_sd_mm for found in placed]
    assert 0.3 < np.sqrt(np.mean(np.square(off_mm)) / np.mean(np.square(stated_mm))) < 2
    assert not any(found.problems for found in placed)


def test_a_place_that_was_noted_wrongly_is_named_and_left_out():
    told = ROOM.copy()
    told[3, 1] += 0.25
    placed, _ = place_cameras(TRUE.cameras, marked(ROOM, told, noise_px=1.0))
    for found, true in zip(placed, TRUE.cameras, strict=True):
        assert "'d' is" in found.problems[0]
        assert np.allclose(found.camera.position_in_world, true.position_in_world, atol=0.05)


@pytest.mark.parametrize("aside", [[0.5, 0, 0.8], [0.5, 1.1, 0.8]])
def test_the_one_point_beside_a_line_of_five_is_no_outlier(aside):
    places = np.array([*np.linspace([-1, 0, 0], [1, 0, 0.3], 5), aside])
    placed, _ = place_cameras(TRUE.cameras, marked(places, places))
    for found, true in zip(placed, TRUE.cameras, strict=True):
        assert found.used.all()
        assert np.allclose(found.camera.position_in_world, true.position_in_world, atol=1e-3)


def test_places_of_a_left_handed_system_are_told():
    placed, _ = place_cameras(TRUE.cameras, marked(ROOM, ROOM * [1, 1, -1]))
    assert all("left-handed" in found.problems[0] for found in placed)


@pytest.mark.parametrize(
    ("places", "expected"),
    [
        (ROOM[:3], "3 points are marked, expected 4"),
        (ROOM[:1] + np.eye(3)[0] * np.arange(5)[:, None], "on a line"),
    ],
)
def test_what_places_no_camera_is_refused(places, expected):
    with pytest.raises(CalibrationError, match=expected):
        place_cameras(TRUE.cameras, marked(places, places))


def csv(path, places, told, cameras=TRUE.cameras):
    head = ["name", "x_m", "y_m", "z_m"] + [f"{c.name}_{a}_px" for c in cameras for a in "uv"]
    rows = [
        [name, *told[i], *np.ravel([camera.project(places)[i] for camera in cameras])]
        for i, name in enumerate("abcdef"[: len(places)])
    ]
    path.write_text("\n".join(",".join(map(str, row)) for row in [head, *rows]) + "\n")
    return path


def run(capsys, monkeypatch, *arguments):
    monkeypatch.setattr("sys.argv", ["fusecap", "calibrate", "extrinsics", *map(str, arguments)])
    with pytest.raises(SystemExit) as end:
        main()
    out = capsys.readouterr()
    return end.value.code, out.out, out.err


def lenses(tmp_path):
    at_origin = [
        type(c)(
            **{k: getattr(c, k) for k in ("name", "size_px", "matrix", "distortion")},
            rotation=np.eye(3),
            translation=np.zeros(3),
        )
        for c in TRUE.cameras
    ]
    path = tmp_path / "lenses.toml"
    write_rig(path, Rig(cameras=tuple(at_origin)))
    return path


def test_command_places_cameras_of_a_z_up_room(tmp_path, capsys, monkeypatch):
    z_up = ROOM @ np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]]).T
    marks, out = csv(tmp_path / "marks.csv", ROOM, z_up), tmp_path / "calibration.toml"
    code, text, _ = run(
        capsys,
        monkeypatch,
        "--points",
        marks,
        "--intrinsics",
        lenses(tmp_path),
        "--up",
        "z",
        "--out",
        out,
        "--json",
    )
    report = json.loads(text)
    assert code == 0 and report["verdict"] == "good"
    for camera in load_rig(out).cameras:
        assert np.allclose(camera.position_in_world, TRUE[camera.name].position_in_world, atol=1e-4)


def test_command_tells_that_the_world_is_upside_down(tmp_path, capsys, monkeypatch):
    """perfanalytics/pose2sim #192: four points on the floor, one axis with the wrong sign."""
    told = FLOOR[:4] * [-1, 1, 1]
    marks, out = csv(tmp_path / "marks.csv", FLOOR[:4], told), tmp_path / "calibration.toml"
    code, text, errors = run(
        capsys, monkeypatch, "--points", marks, "--intrinsics", lenses(tmp_path), "--out", out
    )
    assert code == 0 and "poor" in text
    assert "below the floor" in errors and "upside down" in errors


def test_a_camera_on_the_floor_is_not_upside_down(tmp_path, capsys, monkeypatch):
    """It came out 1 cm below, as it may: stated are decimetres."""
    lowered = [
        replace(c, translation=-c.rotation @ (c.position_in_world * [1, 0, 1] - [0, 0.01, 0]))
        for c in TRUE.cameras
    ]
    marks, out = csv(tmp_path / "marks.csv", ROOM, ROOM, lowered), tmp_path / "calibration.toml"
    code, _, errors = run(
        capsys, monkeypatch, "--points", marks, "--intrinsics", lenses(tmp_path), "--out", out
    )
    assert code == 0 and "below the floor" not in errors


def test_lenses_of_cameras_that_stood_in_millimetres_are_read(tmp_path, capsys, monkeypatch):
    far = tmp_path / "old.toml"
    far.write_text(calibration_toml(TRUE, unit_per_metre=1000))
    marks, out = csv(tmp_path / "marks.csv", ROOM, ROOM), tmp_path / "calibration.toml"
    command = ["--points", marks, "--intrinsics", far, "--out", out]
    assert run(capsys, monkeypatch, *command)[0] == 0


@pytest.mark.parametrize(
    ("arguments", "option"),
    [
        (["--points", "m.csv"], "--points"),
        (["--points", "m.csv", "a=b"], "--points"),
        (["--points", "m.csv", "--refine-intrinsics"], "--refine-intrinsics"),
        (["--points", "m.csv", "--origin-frame", "0"], "--origin-frame"),
        (["--points", "m.csv", "--timestamps", "t.csv"], "--timestamps"),
        (["--points", "m.csv", "--every", "2"], "--every"),
        (["--from-people", "s", "--every", "2"], "--every"),
        (["--from-people", "s", "--intrinsics", "i.toml"], "--intrinsics"),
        (["--from-people", "s", "--up", "z"], "--up"),
        (["a=a.mp4", "b=b.mp4", "--board", "b.toml", "--up", "z"], "--up"),
    ],
)
def test_misuse_is_told(capsys, monkeypatch, arguments, option):
    code, _, errors = run(capsys, monkeypatch, *arguments)
    assert code == 2 and f"for {option}" in errors
