"""Cameras refined from people: derivatives, gauge, recovery on simulated scenes, real clips."""

from __future__ import annotations

import dataclasses
import json

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

from derivatives import assert_jacobian
from fusecap.calibrate.cameras.people import check_rigs, refine_from_people
from fusecap.calibrate.cameras.people_adjust import (
    Evidence,
    Free,
    State,
    adjust,
    cost_of,
    lengths_of,
    linearise,
    stepped,
)
from fusecap.calibrate.cameras.people_gauge import align, gauge_free, motions
from fusecap.calibrate.cameras.world_frame import Similarity
from fusecap.cli import app
from fusecap.errors import InputError
from fusecap.evaluate.rig_noise import RigNoise, believed
from fusecap.geometry.camera import Rig
from fusecap.sources.calibration_files import load_rig
from fusecap.sources.session_data import open_session
from fusecap.sources.session_file import load_session
from scenes import ring
from session_files import calibration_toml, edit, write_session
from test_real_recordings import script

EVERYTHING = Free(focal=True, centre=True, distortion=True)


def walkers(rng, rig: Rig, instants: int = 12, people: int = 2, noise_px: float = 0.0):
    """Random stick figures of rigid limbs: evidence and its true state."""
    limbs = np.array([(0, 1), (1, 2), (2, 3), (3, 4)])
    lengths = rng.uniform(0.2, 0.5, (people, len(limbs)))
    person = np.arange(instants) % people
    points = np.empty((instants, 5, 3))
    points[:, 0] = rng.uniform([-1.2, 0.3, -1.2], [1.2, 1.6, 1.2], (instants, 3))
    for limb, (a, b) in enumerate(limbs):
        way = rng.normal(size=(instants, 3))
        way /= np.linalg.norm(way, axis=1, keepdims=True)
        points[:, b] = points[:, a] + lengths[person, limb, None] * way
    keypoints = np.zeros((instants, len(rig), 5, 3))
    for c, camera in enumerate(rig.cameras):
        pixels = camera.project(points.reshape(-1, 3)).reshape(instants, 5, 2)
        keypoints[:, c, :, :2] = pixels + noise_px * rng.normal(size=pixels.shape)
        keypoints[:, c, :, 2] = 0.9
    keypoints[1, 0, 2] = [np.nan, np.nan, 0.0]
    evidence = Evidence(keypoints=keypoints, person=person, limbs=limbs, weight=np.ones(instants))
    return evidence, State(rig=rig, points=points, lengths_m=lengths)


def perturbed(rng, rig: Rig, deg: float = 2.0, metres: float = 0.05) -> Rig:
    return believed(rng, rig, RigNoise(rotation_deg=deg, position_m=metres))


@pytest.mark.slow
@pytest.mark.parametrize("free", [Free(), EVERYTHING])
def test_gradient_is_that_of_finite_differences(rng, free):
    rig = ring(3, distortion=(-0.1, 0.02, 0.001, -0.002, 0.0))
    evidence, true = walkers(rng, rig, instants=4)
    state = dataclasses.replace(
        true,
        rig=perturbed(rng, rig, 0.5, 0.02),
        points=true.points + 0.02 * rng.normal(size=true.points.shape),
        lengths_m=true.lengths_m + 0.01,
    )
    linear = linearise(state, rig, evidence, free, 8.0)
    analytic = np.concatenate([linear.g_global, linear.g_local.ravel()])

    def cost(step):
        local = step[len(linear.g_global) :].reshape(linear.g_local.shape)
        moved = stepped(state, evidence, free, step[: len(linear.g_global)], local)
        return cost_of(moved, rig, evidence, free, 8.0)

    assert_jacobian(cost, analytic, rtol=2e-3, atol=2e-2)


def test_moving_turning_and_scaling_the_world_changes_no_residual(rng):
    rig = ring(3)
    evidence, state = walkers(rng, rig, noise_px=2.0)
    same = similarity(rng, 1.3)
    moved = State(
        rig=same.rig(rig), points=same.points(state.points), lengths_m=1.3 * state.lengths_m
    )
    cameras = [camera.project(state.points[0]) for camera in rig.cameras]
    again = [camera.project(moved.points[0]) for camera in moved.rig.cameras]
    np.testing.assert_allclose(cameras, again, atol=1e-8)
    np.testing.assert_allclose(lengths_of(moved.points, evidence), moved.lengths_m, atol=1e-9)


def similarity(rng, scale: float = 1.0) -> Similarity:
    return Similarity(
        scale=scale,
        rotation=Rotation.from_rotvec(0.3 * rng.normal(size=3)).as_matrix(),
        translation_m=rng.normal(size=3),
    )


def test_adjustment_recovers_the_rig_from_exact_keypoints(rng):
    rig = ring(4)
    evidence, true = walkers(rng, rig, instants=40)
    rough = perturbed(rng, rig, 1.0, 0.03)
    start = dataclasses.replace(
        true, rig=rough, points=true.points + 0.05 * rng.normal(size=true.points.shape)
    )
    found = adjust(start, rough, evidence, Free(), sigma_px=30.0)
    aligned = align(found.state.rig, rig).similarity.rig(found.state.rig)
    shift_m, angle_rad = motions(aligned, rig)
    assert shift_m.max() < 0.5e-3 and np.degrees(angle_rad).max() < 0.01


def test_gross_outliers_do_not_move_the_cameras(rng):
    rig = ring(4)
    evidence, true = walkers(rng, rig, instants=40, noise_px=2.0)
    wild = rng.random(evidence.keypoints.shape[:3]) < 0.1
    evidence.keypoints[wild, :2] += rng.normal(scale=200, size=(wild.sum(), 2))
    start = dataclasses.replace(true, lengths_m=lengths_of(true.points, evidence))
    found = adjust(start, perturbed(rng, rig, 1.0, 0.03), evidence, Free(), sigma_px=10.0)
    aligned = align(found.state.rig, rig).similarity.rig(found.state.rig)
    shift_m, _ = motions(aligned, rig)
    assert shift_m.max() < 0.02


def test_alignment_undoes_a_similarity(rng):
    rig = ring(5)
    moved = similarity(rng, 1.2).rig(rig)
    found = align(moved, rig)
    shift_m, angle_rad = motions(found.similarity.rig(moved), rig)
    assert shift_m.max() < 1e-9 and angle_rad.max() < 1e-9
    assert found.similarity.scale == pytest.approx(1 / 1.2)


def test_one_camera_that_was_knocked_over_does_not_turn_the_room(rng):
    rig = ring(6)
    knocked = Rig(
        cameras=(
            believed(
                rng, Rig(cameras=rig.cameras[:1]), RigNoise(rotation_deg=10.0, position_m=0.5)
            ).cameras[0],
            *rig.cameras[1:],
        )
    )
    moved = similarity(rng).rig(rig)
    found = align(moved, knocked)
    shift_m, _ = motions(found.similarity.rig(moved), rig)
    assert shift_m.max() < 0.02
    assert found.weight[0] < 0.3 * found.weight[1:].min()


def test_two_cameras_can_be_aligned(rng):
    rig = ring(2)
    moved = similarity(rng, 0.9).rig(rig)
    shift_m, angle_rad = motions(align(moved, rig).similarity.rig(moved), rig)
    assert shift_m.max() < 1e-6 and angle_rad.max() < 1e-6


@pytest.mark.slow
def test_uncertainty_is_the_scatter_over_noise(rng):
    rig = ring(4)
    reach, predicted = [], None
    for _ in range(16):
        own = np.random.default_rng(3)
        evidence, true = walkers(own, rig, instants=20)
        evidence.keypoints[..., :2] += 4.0 * rng.normal(size=evidence.keypoints[..., :2].shape)
        found = adjust(true, rig, evidence, Free(), sigma_px=4.0)
        alignment = align(found.state.rig, rig)
        reach.append(motions(alignment.similarity.rig(found.state.rig), rig)[0] ** 2)
        covariance = gauge_free(found.information, found.state.rig, alignment, 6)
        predicted = np.sqrt([np.trace(covariance[i + 3 : i + 6, i + 3 : i + 6]) for i in (0, 6)])
    measured = np.sqrt(np.mean(reach, axis=0))[:2]
    assert predicted is not None
    np.testing.assert_allclose(measured, predicted, rtol=0.5)


def rough_session(folder, rng, *, deg: float = 2.0, metres: float = 0.05, **options):
    """The walking person of `session_files` under a calibration that is off; and the true rig."""
    path = write_session(folder, **options)
    true = load_rig(folder / "calibration.toml")
    (folder / "calibration.toml").write_text(calibration_toml(perturbed(rng, true, deg, metres)))
    return path, true


def opened(path):
    return open_session(load_session(path))


@pytest.mark.slow
def test_session_recovers_the_rig_and_says_how_sure_it_is(rng, tmp_path):
    path, true = rough_session(tmp_path, rng)
    data = opened(path)
    found = refine_from_people(data)
    assert found.improved
    assert found.before.median_px > 10 and found.after.median_px < 0.2
    shift_m, angle_rad = motions(align(found.rig, true).similarity.rig(found.rig), true)
    assert shift_m.max() < 5e-3 and np.degrees(angle_rad).max() < 0.1
    # The world is the rough one's: no farther from it than the truth is.
    assert np.mean(motions(found.rig, data.rig)[0]) < 1.2 * np.mean(motions(true, data.rig)[0])
    assert all(camera.repeat_mm < 20 for camera in found.cameras)
    assert found.scale == 1.0 and found.scale_from == "the rough calibration"
    checked = check_rigs(data, found.rig, (data.rig, found.rig, true))
    before, after, best = checked["all"]
    assert before.median_px > 10 > 0.2 > after.median_px and best.median_px < 1e-3


@pytest.mark.slow
def test_stated_bones_scale_the_world(rng, tmp_path):
    path, true = rough_session(tmp_path, rng, deg=0.5, metres=0.01)
    larger = Similarity(scale=1.1).rig(true)
    (tmp_path / "calibration.toml").write_text(calibration_toml(perturbed(rng, larger, 0.5, 0.01)))
    with path.open("a") as file:
        file.write('\n[[subject]]\nname = "anna"\nheight_m = 1.75\n')
        file.write("bone_lengths_m = { left_shank = 0.429 }\n")
    found = refine_from_people(opened(path))
    assert found.scale == pytest.approx(1 / 1.1, rel=0.01)
    assert found.scale_from == "the bodies of 1 subject, which contradict the rough calibration"
    distances = [
        np.linalg.norm(rig.cameras[0].position_in_world - rig.cameras[2].position_in_world)
        for rig in (found.rig, larger)
    ]
    assert distances[0] / distances[1] == pytest.approx(found.scale, rel=0.02)


@pytest.mark.slow
def test_right_calibration_is_kept(rng, tmp_path):
    path, _ = rough_session(tmp_path, rng, deg=0.0, metres=0.0)
    found = refine_from_people(opened(path))
    assert not found.improved
    assert any("keep the old calibration" in note for note in found.notes)


@pytest.mark.slow
def test_person_who_stands_still_is_noted(rng, tmp_path):
    path, _ = rough_session(tmp_path, rng, deg=0.5, metres=0.01)
    for folder in (tmp_path / "keypoints").iterdir():
        files = sorted(folder.iterdir())
        for file in files[1:]:
            file.write_text(files[0].read_text())
    found = refine_from_people(opened(path))
    assert any("walks through the whole volume" in note for note in found.notes)


@pytest.mark.slow
def test_hopeless_input_is_refused_in_words(rng, tmp_path):
    with pytest.raises(InputError, match=r"found 1 camera with keypoints.*board"):
        refine_from_people(opened(write_session(tmp_path / "one", cameras=1)))
    with pytest.raises(InputError, match=r"30 instants.*40 or more"):
        refine_from_people(opened(write_session(tmp_path / "short", frames=30)))
    path, _ = rough_session(tmp_path / "wild", rng, deg=60.0, metres=2.0)
    with pytest.raises(InputError, match=r"could be followed at .*too rough to start from"):
        refine_from_people(opened(path))


@pytest.mark.slow
def test_cameras_that_share_nobody_are_refused_by_name(tmp_path):
    path = write_session(tmp_path)
    nobody = '{"version": 1.3, "people": []}'
    for file in (tmp_path / "keypoints/cam3").iterdir():
        file.write_text(nobody)
    with pytest.raises(InputError, match="camera 'cam3' sees nobody together with the others"):
        refine_from_people(opened(path))
    for folder in (tmp_path / "keypoints").iterdir():
        for file in folder.iterdir():
            file.write_text(nobody)
    with pytest.raises(InputError, match="no camera has a keypoint"):
        refine_from_people(opened(path))


@pytest.mark.slow
def test_command_writes_a_calibration_that_the_session_can_use(rng, tmp_path):
    path, _ = rough_session(tmp_path, rng)
    out = tmp_path / "refined.toml"
    command = ["calibrate", "extrinsics", "--from-people", str(path), "--out", str(out)]
    result = CliRunner().invoke(app, [*command, "--json"])
    assert result.exit_code == 0, result.output
    report = json.loads(result.stdout)
    assert report["improved"] and len(report["cameras"]) == 4
    assert report["files"] == [str(out), str(out.with_suffix(".png"))]
    edit(path, "calibration.toml", "refined.toml")
    out.with_suffix(".png").unlink()
    again = CliRunner().invoke(app, [*command[:-1], str(tmp_path / "again.toml")])
    assert "calibration: " in again.stdout and "known to" in again.stdout


@pytest.mark.slow
def test_write_makes_the_session_use_the_refined_cameras(rng, tmp_path, monkeypatch):
    """Of millimetres in a z-up world, from a folder that is not the session's."""
    path, true = rough_session(tmp_path / "take", rng)
    to_z_up = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
    rough = load_rig(path.parent / "calibration.toml")
    turned = Rig(
        cameras=tuple(
            dataclasses.replace(c, rotation=c.rotation @ to_z_up.T) for c in rough.cameras
        )
    )
    (path.parent / "calibration.toml").write_text(calibration_toml(turned, unit_per_metre=1000.0))
    edit(path, "[session]", '[session]\nup = "z"\ncalibration_unit = "mm"')
    monkeypatch.chdir(tmp_path)
    command = ["calibrate", "extrinsics", "--from-people", "take", "--write"]
    result = CliRunner().invoke(app, command)
    assert result.exit_code == 0 and "session.toml uses it now" in result.output, result.output
    used = load_session(path).settings
    assert (used.calibration, used.up) == (path.parent / "refined.toml", "y")
    rig = opened(path).rig
    shift_m, _ = motions(align(rig, true).similarity.rig(rig), true)
    assert shift_m.max() < 5e-3
    assert np.mean(motions(rig, rough)[0]) < 0.2


def test_command_refuses_boards_and_people_at_once():
    command = ["calibrate", "extrinsics", "--from-people", "duo"]
    for more in (["left=a.mp4"], ["--board", "b.toml"], ["--refine", "focl"]):
        assert CliRunner().invoke(app, [*command, *more]).exit_code == 2
    assert CliRunner().invoke(app, [*command[:2], "--refine", "focal"]).exit_code == 2
    assert CliRunner().invoke(app, [*command[:2], "left=a.mp4", "--write"]).exit_code == 2


@pytest.mark.real_data
@pytest.mark.slow
def test_pose2sim_clip_halves_its_error_on_frames_held_out(data_dir, tmp_path):
    clip = script("examples/pose2sim_clip.py")
    folder = data_dir / "pose2sim_demo/v0.8.4_openpose_body25b"
    found = refine_from_people(opened(clip.write_session(folder, tmp_path, "balancing")))
    assert found.improved
    assert 12 < found.before.median_px < 14
    assert found.after.median_px < 7
    assert found.skeleton_after_px < 0.75 * found.skeleton_before_px
