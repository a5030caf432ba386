import json
import tomllib

import numpy as np
import pytest

from fusecap.body.landmarks import landmark_set_named
from fusecap.body.pose import forward_kinematics, landmarks_in_world
from fusecap.body.shape import BodyShape
from fusecap.body.skeleton import PAPER21
from fusecap.calibrate import shape as module
from fusecap.calibrate.shape import MeasuredBody, shape_toml
from fusecap.cli import main
from fusecap.sources.session import SubjectSettings
from fusecap.sources.session_file import load_session
from session_files import write_session

LANDMARKS = landmark_set_named("body25")
LIMBS = [
    f"{side}_{bone}" for side in ("left", "right") for bone in ("forearm", "hand", "shank", "foot")
]


def other_body(height_m: float = 1.7) -> BodyShape:
    """Long shanks, short upper arms."""
    shape = BodyShape.from_height(PAPER21, height_m)
    lengths = {}
    for side in ("left", "right"):
        for bone, factor in (("foot", 1.06), ("forearm", 0.94)):
            index = PAPER21.bone(f"{side}_{bone}")
            lengths[f"{side}_{bone}"] = factor * float(np.linalg.norm(shape.offsets_m[index]))
    return shape.with_lengths(lengths)


def moments(shape: BodyShape, *, angle: float, offset_m: float = 0.0, noise_m: float = 0.0):
    """Everything triangulated over 80 instants with joints bent at random."""
    rng = np.random.default_rng(5)
    theta = angle * rng.standard_normal((80, PAPER21.pose_size))
    position, rotation = forward_kinematics(shape, theta)
    off = offset_m * np.random.default_rng(8).standard_normal((len(LANDMARKS.landmark_names), 3))
    points = landmarks_in_world(
        position, rotation, LANDMARKS.bones(PAPER21), LANDMARKS.offsets_m(shape) + off
    )
    points += noise_m * rng.standard_normal(points.shape)
    return module._Moments(points=points, rotation=rotation)


def fitted(data, height_m: float | None = 1.7) -> MeasuredBody:
    return module._fitted(PAPER21, LANDMARKS, "anna", data, height_m, 1.72)


def errors_mm(body: MeasuredBody, shape: BodyShape) -> dict[str, float]:
    true = np.linalg.norm(shape.offsets_m, axis=1)
    return {bone.bone: 1e3 * (bone.length_m - true[PAPER21.bone(bone.bone)]) for bone in body.bones}


def test_lengths_come_out_of_motion_although_landmarks_lie_beside_joints():
    shape = other_body()
    body = fitted(moments(shape, angle=0.6, offset_m=0.012, noise_m=0.005))
    errors = errors_mm(body, shape)
    assert max(abs(errors[bone]) for bone in LIMBS) < 3.0


def test_distances_between_landmarks_would_be_off_by_their_offsets():
    shape = other_body()
    data = moments(shape, angle=0.6, offset_m=0.012)
    hip, knee = (LANDMARKS.index(name) for name in ("left_hip", "left_knee"))
    read = np.median(np.linalg.norm(data.points[:, hip] - data.points[:, knee], axis=1))
    true = np.linalg.norm(shape.offsets_m[PAPER21.bone("left_shank")])
    fit = abs(errors_mm(fitted(data), shape)["left_shank"])
    assert fit < 0.5 * 1e3 * abs(read - true)


def test_motion_shrinks_the_uncertainty_of_a_fit():
    variance = []
    for angle in (0.0, 0.6):
        data = moments(other_body(), angle=angle, offset_m=0.012, noise_m=0.005)
        _, covariance = module._Problem(PAPER21, LANDMARKS, data).solve(1.7, symmetric=True)
        variance.append(np.diag(covariance))
    still, moving = np.sqrt(variance)
    for bone in LIMBS:
        assert moving[PAPER21.bone(bone) - 1] < 0.3 * still[PAPER21.bone(bone) - 1]


def test_bone_without_landmarks_follows_the_stature():
    data = moments(other_body(), angle=0.6, noise_m=0.005)
    data.points[:, [LANDMARKS.index("left_wrist"), LANDMARKS.index("right_wrist")]] = np.nan
    bones = {bone.bone: bone for bone in fitted(data).bones}
    for bone in (bones["left_hand"], bones["right_hand"]):
        assert not bone.told
        assert bone.length_m == bone.from_height_m
        assert bone.sigma_m == pytest.approx(module.LENGTH_SIGMA * bone.from_height_m)
    assert bones["left_forearm"].told
    assert "left_hand" not in fitted(data).lengths_m


def test_difference_between_the_sides_is_reported():
    shape = other_body()
    long = 1.04 * float(np.linalg.norm(shape.offsets_m[PAPER21.bone("left_shank")]))
    body = fitted(moments(shape.with_lengths({"left_shank": long}), angle=0.6, noise_m=0.003))
    bone = next(bone for bone in body.bones if bone.bone == "left_shank")
    assert bone.asymmetry_m == pytest.approx(0.04 * long / 1.04, abs=0.005)


def test_stature_follows_from_lengths_where_nobody_states_it():
    shape = BodyShape.from_height(PAPER21, 1.6)
    body = fitted(moments(shape, angle=0.6, noise_m=0.003), None)
    assert body.height_m == pytest.approx(1.6, abs=0.02)
    assert not body.height_stated
    assert 0.02 < body.height_sigma_m < 0.1


def test_gross_errors_do_not_move_lengths():
    shape = other_body()
    data = moments(shape, angle=0.6, noise_m=0.005)
    rng = np.random.default_rng(2)
    wrong = rng.random(data.points.shape[:2]) < 0.05
    data.points[wrong] += 0.5 * rng.standard_normal((wrong.sum(), 3))
    assert max(abs(errors_mm(fitted(data), shape)[bone]) for bone in LIMBS) < 5.0


def test_errors_that_last_count_as_fewer_samples():
    rng = np.random.default_rng(1)
    noise = rng.standard_normal((400, 25, 3))
    seen = np.ones((400, 25), dtype=bool)
    assert module._lasting(noise, seen) < 1.2
    lasting = np.repeat(noise[::10], 10, axis=0)
    assert module._lasting(lasting, seen) > 8


def test_snippet_is_a_subject_of_a_session():
    body = fitted(moments(other_body(), angle=0.6, noise_m=0.005))
    [table] = tomllib.loads(shape_toml([body], origin="a test"))["subject"]
    subject = SubjectSettings(**table)
    assert subject.height_m == 1.7
    assert subject.bone_lengths_m == pytest.approx(body.lengths_m, abs=1e-4)


def run(monkeypatch, *arguments) -> int:
    monkeypatch.setattr("sys.argv", ["fusecap", "calibrate", "shape", *map(str, arguments)])
    try:
        main()
    except SystemExit as end:
        return int(end.code or 0)
    return 0


@pytest.mark.slow
def test_command_writes_subject_tables_and_a_plot(tmp_path, monkeypatch, capsys):
    session = write_session(tmp_path, frames=60)
    out = tmp_path / "shape.toml"
    assert run(monkeypatch, session, "--out", out, "--json") == 0
    report = json.loads(capsys.readouterr().out)
    assert report["bodies"][0]["name"] == "person1"
    assert tomllib.loads(out.read_text())["subject"][0]["height_m"] == pytest.approx(1.75, abs=0.1)
    assert out.with_suffix(".png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.slow
def test_a_poor_body_is_not_written_into_the_session_and_a_good_one_is(
    tmp_path, monkeypatch, capsys
):
    session = write_session(tmp_path, frames=60)
    before = session.read_text()
    assert run(monkeypatch, session, "--write") == 1
    assert "stays as it is" in capsys.readouterr().out and session.read_text() == before
    monkeypatch.setattr("fusecap.cli.calibrate_shape._problems", lambda found: [])
    assert run(monkeypatch, session, "--write") == 0
    assert "uses it now" in capsys.readouterr().out
    [measured] = tomllib.loads((tmp_path / "shape.toml").read_text())["subject"]
    [used] = load_session(session).subjects
    assert (used.name, used.height_m) == ("person1", measured["height_m"])
    assert used.bone_lengths_m == measured.get("bone_lengths_m", {})


@pytest.mark.slow
def test_unknown_subject_is_refused(tmp_path, monkeypatch, capsys):
    session = write_session(tmp_path, frames=40)
    assert run(monkeypatch, session, "--subject", "anna", "--out", tmp_path / "x.toml") == 1
    assert "no 'anna' was found" in capsys.readouterr().err
    assert not (tmp_path / "x.toml").exists()
