import importlib.util
import json
import shutil
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from derivatives import assert_jacobian
from fusecap.body.landmarks import landmark_set_named
from fusecap.body.skeleton import PAPER21
from fusecap.calibrate.imus.changes import find_change
from fusecap.calibrate.imus.checks import Worn, sensor_rotations
from fusecap.calibrate.imus.fit import (
    HeadingPrior,
    Pairs,
    _linearised,
    fit,
    inverse_right_jacobian,
    make_pairs,
    start,
)
from fusecap.calibrate.imus.identify import identify
from fusecap.calibrate.imus.joint_centres import SeenLandmarks, _Problem, fit_together
from fusecap.calibrate.imus.motion import calibrate_subject
from fusecap.calibrate.imus.reference import reference_motion
from fusecap.calibrate.imus.speeds import lag_s
from fusecap.calibrate.imus.tpose import look_at_tpose
from fusecap.cli import main
from fusecap.errors import InputError, SessionError
from fusecap.evaluate.imu_noise import IMUS_6, NO_IMU_NOISE, ImuNoise, measure
from fusecap.evaluate.simulated_session import write_session
from fusecap.evaluate.simulator import Person, camera_ring, placed, simulate
from fusecap.evaluate.twin import twin_sequence
from fusecap.geometry.camera import Y_UP_FROM_Z_UP
from fusecap.sources.imu_calibration_files import (
    CalibratedImu,
    imu_calibration_toml,
    read_imu_calibration,
)
from fusecap.sources.imu_files.track import ImuTrack
from fusecap.sources.session import ImuSettings, SubjectSettings
from fusecap.sources.session_file import load_session
from fusecap.take import take_from_theta
from fusecap.types import GRAVITY_M_S2
from session_files import edit

BONES = ("hips", "left_forearm", "left_thigh", "right_thigh", "left_shank", "right_shank")


def motion(key="T2 ROM1", frames=600):
    """A take of the twin's motion, every bone of it right."""
    sequence = twin_sequence(key)
    theta = sequence.theta[:frames]
    return sequence, take_from_theta(
        theta[None],
        [sequence.shape],
        timestamps_ns=np.round(np.arange(len(theta)) * 1e9 / 60).astype(np.int64),
        rate_hz=60.0,
        subject_names=("anna",),
        skeleton=PAPER21,
    )


@pytest.fixture(scope="module")
def reference():
    return reference_motion(motion()[1], 0, landmark_set_named("body25"))


def sensors(noise: ImuNoise, bones=BONES, key="T2 ROM1", seed=3):
    sequence, _ = motion(key)
    rng = np.random.default_rng(seed)
    imus = measure(rng, sequence.shape, sequence.theta, bones, noise, 60.0)
    worn = [
        Worn(
            settings=ImuSettings(bone=bone, file=Path(f"{bone}.csv"), imu_up="y"),
            track=ImuTrack(
                times_s=imus.times_s,
                orientation_wxyz=imus.orientation_wxyz(index),
                accel_m_s2=imus.accel_m_s2[:, index],
            ),
        )
        for index, bone in enumerate(bones)
    ]
    return imus, worn


def some_pairs(rng: np.random.Generator, mounting, heading_rad, count=60) -> Pairs:
    bone = Rotation.random(count, rng=rng)
    world = Rotation.from_rotvec([0.0, -heading_rad, 0.0])
    sensor = world * bone * Rotation.from_matrix(mounting)
    covariance = np.broadcast_to(np.diag([0.5, 0.01, 0.01]), (count, 3, 3))
    return make_pairs(np.arange(count) / 5.0, bone.as_matrix(), covariance, sensor.as_matrix())


def angle_deg(a, b):
    return np.degrees(Rotation.from_matrix(a @ b.T).magnitude())


# One sensor


def test_inverse_right_jacobian_is_that_of_so3(rng):
    for vector in (*rng.normal(size=(5, 3)), np.array([1e-7, 0, 0]), np.array([3.0, 0.1, 0])):
        jacobian = inverse_right_jacobian(vector[None])[0]
        for axis in range(3):
            step = np.zeros(3)
            step[axis] = 1e-6
            moved = Rotation.from_rotvec(vector) * Rotation.from_rotvec(step)
            assert np.allclose((moved.as_rotvec() - vector) / 1e-6, jacobian[:, axis], atol=1e-4)


def test_derivatives_by_mounting_heading_and_drift(rng):
    mounting = Rotation.random(rng=rng).as_matrix()
    pairs = some_pairs(rng, mounting, 0.3, count=10)
    mounting = Rotation.from_rotvec([0.2, -0.1, 0.3]).as_matrix() @ mounting
    heading, ahead_s = np.full(10, 0.1), np.linspace(-1, 1, 10)

    def error(values):
        turned = Rotation.from_rotvec(values[:3]).as_matrix() @ mounting
        return _linearised(pairs, turned, heading + values[3] + values[4] * ahead_s, ahead_s, 5)[0]

    _, jacobian = _linearised(pairs, mounting, heading, ahead_s, 5)
    assert_jacobian(error, jacobian, atol=1e-6)


def test_any_mounting_and_heading_is_found(rng):
    for _ in range(10):
        mounting = Rotation.random(rng=rng).as_matrix()
        heading = rng.uniform(-np.pi, np.pi)
        pairs = some_pairs(rng, mounting, heading)
        rough, _ = start(pairs)
        assert angle_deg(rough, mounting) < 6
        found = fit(pairs)
        assert angle_deg(found.bone_from_imu, mounting) < 1e-3
        assert np.isclose(np.cos(found.heading_rad - heading), 1.0)


def test_a_third_of_wild_pairs_does_not_matter(rng):
    mounting = Rotation.random(rng=rng).as_matrix()
    pairs = some_pairs(rng, mounting, 1.0, count=120)
    bone = pairs.bone_in_world.copy()
    bone[::3] = Rotation.random(40, rng=rng).as_matrix()
    assert angle_deg(fit(replace(pairs, bone_in_world=bone)).bone_from_imu, mounting) < 2.0


def test_heading_prior_decides_what_upright_motion_leaves_open(rng):
    turns = Rotation.from_rotvec(np.outer(np.linspace(0, 4, 60), [0, 1, 0]))
    covariance = np.broadcast_to(np.eye(3) * 0.01, (60, 3, 3))
    pairs = make_pairs(np.arange(60) / 5.0, turns.as_matrix(), covariance, turns.as_matrix())
    found = fit(pairs, HeadingPrior(mean_rad=0.4, sigma_rad=0.1))
    assert found.heading_rad == pytest.approx(0.4, abs=1e-3)
    assert np.degrees(np.abs(found.errors(pairs)).max()) < 1e-3


def test_drift_is_found(rng):
    pairs = some_pairs(rng, np.eye(3), 0.0, count=200)
    spin = Rotation.from_rotvec(np.outer(0.01 * pairs.times_s, [0, 1, 0])).as_matrix()
    pairs = replace(pairs, sensor_in_imu_world=spin @ pairs.sensor_in_imu_world)
    found = fit(pairs, drift_sigma_rad_s=0.1)
    assert found.drift_rad_s == pytest.approx(-0.01, abs=1e-4)


# What cameras observe


def test_cameras_see_directions_of_limbs_but_not_their_turn(reference):
    def sigma_deg(bone):
        blocks = reference.covariance_rad2[:, PAPER21.bone(bone)]
        return np.degrees(np.sqrt(np.median(np.diagonal(blocks, axis1=1, axis2=2), axis=0)))

    along, *across = sigma_deg("left_forearm")
    assert along > 30 and max(across) < 12
    x, y, z = sigma_deg("left_thigh")
    assert y > 5 and max(x, z) < 5


def test_hinges_hold_in_true_motion(reference):
    truth = reference_motion(motion()[1], 0)
    turned = np.swapaxes(truth.rotation_in_world, -1, -2) @ reference.rotation_in_world
    angle = Rotation.from_matrix(turned.reshape(-1, 3, 3)).magnitude()
    assert np.degrees(angle).max() < 1.0, "a motion of hinges is not bent"


# One subject


@pytest.mark.slow
def test_mountings_come_back_from_perfect_sensors(reference):
    imus, worn = sensors(NO_IMU_NOISE)
    found = calibrate_subject(reference, worn)
    for index, sensor in enumerate(found.sensors):
        w, x, y, z = sensor.bone_from_imu_wxyz
        mounting = Rotation.from_quat([x, y, z, w]).as_matrix()
        assert sensor.held_out_deg < 2.5, "the heading others have pulls a little"
        assert sensor.usable, sensor.fault
        if sensor.bone != "hips":
            assert angle_deg(mounting, imus.mounting[index]) < 3.0
    assert max(found.sensors[1].sigma_deg) == found.sensors[1].sigma_deg[0] > 20, "a forearm's turn"
    assert found.lag_s == 0.0


@pytest.mark.slow
def test_swapped_sensors_are_both_named(reference):
    _, worn = sensors(ImuNoise())
    swapped = [
        *worn[:4],
        replace(worn[4], track=worn[5].track),
        replace(worn[5], track=worn[4].track),
    ]
    found = calibrate_subject(reference, swapped).sensors
    assert [(sensor.verdict, sensor.fault) for sensor in found[4:]] == [("poor", "wrong bone")] * 2
    assert "left_shank.csv' is stated on left_shank but moves like right_shank" in found[4].remedy
    assert all(sensor.fault != "wrong bone" for sensor in found[:4])


@pytest.mark.slow
def test_sensor_on_a_bone_nobody_stated_is_identified(reference):
    _, worn = sensors(ImuNoise())
    stated = ["head" if bone == "left_thigh" else bone for bone in BONES]
    said = identify(reference, stated, sensor_rotations(worn, reference.times_s))
    assert [each.found for each in said] == list(BONES)
    assert said[2].contradicts and said[2].stated == "head"


@pytest.mark.slow
def test_sensor_turned_half_way_is_noticed_where_it_happened(reference):
    _, worn = sensors(ImuNoise())
    quaternion = worn[2].track.orientation_wxyz.copy()
    turn = Rotation.from_euler("xz", [20, 22], degrees=True)
    later = Rotation.from_quat(quaternion[300:][:, [1, 2, 3, 0]]) * turn
    quaternion[300:] = np.roll(later.as_quat(canonical=True), 1, axis=1)
    worn[2] = replace(worn[2], track=replace(worn[2].track, orientation_wxyz=quaternion))
    found = calibrate_subject(reference, worn).sensors
    assert [sensor.fault == "moved" for sensor in found] == [i == 2 for i in range(len(BONES))]
    assert found[2].change is not None
    assert found[2].change.time_s == pytest.approx(5.0, abs=2.1)


def test_short_recordings_have_no_change(rng):
    pairs = some_pairs(rng, np.eye(3), 0.0, count=20)
    assert find_change(pairs, fit(pairs)) is None


def test_lag_of_the_clocks_is_measured_and_refused(reference):
    _, worn = sensors(ImuNoise())
    late = [replace(e, track=replace(e.track, times_s=e.track.times_s + 1.5)) for e in worn]
    bones = [PAPER21.bone(bone) for bone in BONES]
    assert lag_s(reference, bones, [e.track for e in late])[0] == pytest.approx(1.5, abs=0.021)
    with pytest.raises(InputError, match=r"1\.5\d? s behind the cameras.*fusecap calibrate sync"):
        calibrate_subject(reference, late)


@pytest.mark.slow
def test_sensors_that_cannot_be_used_say_why(reference):
    _, worn = sensors(NO_IMU_NOISE)
    still = worn[2].track.orientation_wxyz.copy()
    still[:] = still[0]
    short = worn[3].track
    worn[2] = replace(worn[2], track=replace(worn[2].track, orientation_wxyz=still))
    worn[3] = replace(
        worn[3],
        track=ImuTrack(
            times_s=short.times_s[:120],
            orientation_wxyz=short.orientation_wxyz[:120],
            accel_m_s2=short.accel_m_s2[:120],
        ),
    )
    settings = worn[4].settings.model_copy(update={"imu_up": "z"})
    worn[4] = replace(worn[4], settings=settings)
    found = calibrate_subject(reference, worn)
    reasons = {each.bone: each.reason for each in found.skipped}
    assert set(reasons) == {"left_thigh", "right_thigh", "left_shank"}
    assert "never changes by more than 2 deg" in reasons["left_thigh"]
    assert "only 2.0 s of its samples" in reasons["right_thigh"]
    assert 'set imu_up = "y"' in reasons["left_shank"]
    assert len(found.sensors) == 3


def test_subject_that_is_hardly_seen_is_refused():
    _, take = motion(frames=120)
    with pytest.raises(InputError, match=r"is seen for 2.0 s, expected 6 s"):
        calibrate_subject(reference_motion(take, 0), [])


# Joint centres


ARM = ("spine3", "left_upper_arm", "left_forearm")


@pytest.fixture(scope="module")
def biased_arm():
    """An arm whose landmarks are where a detector puts them: always 20 mm off; its sensors err
    in nothing. Bones of the reference go through the landmarks, as a solve's do."""
    sequence, take = motion()
    imus, worn = sensors(NO_IMU_NOISE, ARM)
    landmarks = landmark_set_named("body25")
    bones = landmarks.bones(PAPER21)
    frames = np.arange(0, 600, 5)
    times_s = frames / 60.0
    rotation = take.bone_rotation_in_world(0)[frames]
    offset = landmarks.offsets_m(sequence.shape)
    offset_seen = offset + 0.02 * np.random.default_rng(5).choice([-1, 1], offset.shape)
    points = take.bone_position_in_world_m[0][frames][:, bones]
    points = points + np.einsum("tkij,kj->tki", rotation[:, bones], offset_seen)
    seen = SeenLandmarks(
        times_s=times_s,
        points_in_world_m=points,
        landmark_bone=np.asarray(bones),
        landmark_offset_m=offset,
        joint_offset_m=take.offsets_m[0],
    )
    turned = sensor_rotations(worn, times_s)
    index = [PAPER21.bone(bone) for bone in ARM]
    joints = [landmarks.landmark_names.index(f"left_{j}") for j in ("shoulder", "elbow", "wrist")]
    tight = np.broadcast_to(np.eye(3) * 0.01, (len(frames), 3, 3))
    pairs = [make_pairs(times_s, rotation[:, index[0]], tight, turned[0])]
    for number, bone in enumerate(index[1:]):
        true = points[:, joints[number + 1]] - points[:, joints[number]]
        now = rotation[:, bone] @ [1.0, 0.0, 0.0]
        axis = np.cross(now, true / np.linalg.norm(true, axis=1, keepdims=True))
        bent = Rotation.from_rotvec(axis).as_matrix() @ rotation[:, bone]
        covariance = np.broadcast_to(np.diag([0.3, 0.01, 0.01]), bent.shape)
        pairs.append(make_pairs(times_s, bent, covariance, turned[number + 1]))
    return imus, seen, index, turned, pairs, [fit(some) for some in pairs]


def direction_deg(found, imus, turned, number):
    """Mean error of the direction of a bone's length; the sensors' true heading is 0."""
    spin = Rotation.from_euler("y", found.heading_rad).as_matrix()
    ours = spin @ turned[number] @ found.bone_from_imu.T @ [1.0, 0.0, 0.0]
    true = turned[number] @ imus.mounting[number].T @ [1.0, 0.0, 0.0]
    return np.degrees(np.arccos(np.sum(ours * true, axis=1))).mean()


def test_joint_centres_undo_what_constant_distances_of_keypoints_do(biased_arm):
    imus, seen, index, turned, pairs, alone = biased_arm
    together = fit_together(PAPER21, seen, index, turned, pairs, alone)
    before = direction_deg(alone[1], imus, turned, 1)
    after = direction_deg(together[1], imus, turned, 1)
    assert before > 3.0 and after < 0.5 * before, (before, after)


def test_derivatives_of_landmarks_by_sensors_and_offsets(biased_arm, rng):
    _, seen, index, turned, _, alone = biased_arm
    problem = _Problem(PAPER21, seen, index, turned, np.arange(len(seen.times_s)) < 4)
    mounting = np.array([each.bone_from_imu for each in alone])
    heading = rng.normal(size=3)
    offsets = 0.01 * rng.normal(size=problem.size - 12)

    def error(values):
        own = values[:12].reshape(3, 4)
        moved = Rotation.from_rotvec(own[:, :3]).as_matrix() @ mounting
        return problem.residuals(moved, heading + own[:, 3], offsets + values[12:])[0]

    _, jacobian = problem.residuals(mounting, heading, offsets)
    assert_jacobian(error, jacobian, atol=1e-7)


def test_nobody_seen_leaves_the_fits_as_they_are(biased_arm):
    _, seen, index, turned, pairs, alone = biased_arm
    blind = replace(seen, points_in_world_m=np.full_like(seen.points_in_world_m, np.nan))
    assert fit_together(PAPER21, blind, index, turned, pairs, alone) == alone


# T-pose


def tpose_track(tilt_deg=0.0, sway_deg=0.0):
    times_s = np.arange(200) / 100.0
    sway = Rotation.from_rotvec(np.outer(np.radians(sway_deg) * np.sin(6 * times_s), [1, 0, 0]))
    world = sway * Rotation.from_euler("y", 30.0, degrees=True)
    force = np.array([0.0, np.cos(np.radians(tilt_deg)), np.sin(np.radians(tilt_deg))])
    return ImuTrack(
        times_s=times_s,
        orientation_wxyz=np.roll(world.as_quat(canonical=True), 1, axis=1),
        accel_m_s2=world.inv().apply(np.tile(GRAVITY_M_S2 * force, (200, 1))),
    )


def test_tpose_gives_the_mounting_and_doubts_what_moved():
    subject = SubjectSettings(name="anna", tpose_s=(0.5, 1.5), tpose_facing_deg=30.0)
    imu = ImuSettings(bone="hips", file=Path("hips.csv"), imu_up="y")
    pose = look_at_tpose(subject, imu, tpose_track())
    assert angle_deg(pose.bone_from_imu, np.eye(3)) < 1e-6
    assert pose.complaints == ()
    assert "moved by" in look_at_tpose(subject, imu, tpose_track(sway_deg=10.0)).complaints[0]
    assert "gravity is 9.0 deg off" in look_at_tpose(subject, imu, tpose_track(9.0)).complaints[0]
    with pytest.raises(SessionError, match="no sample in tpose_s"):
        look_at_tpose(subject.model_copy(update={"tpose_s": (5.0, 6.0)}), imu, tpose_track())
    with pytest.raises(SessionError, match="tpose_s states when"):
        look_at_tpose(subject.model_copy(update={"tpose_s": None}), imu, tpose_track())


# Files and the command


ONE = CalibratedImu(
    subject="an na", bone="head", bone_from_imu_wxyz=(0.5, 0.5, -0.5, 0.5), heading_deg=-3.25
)


def test_file_round_trip(tmp_path):
    path = tmp_path / "imu_calibration.toml"
    path.write_text(imu_calibration_toml([ONE], origin='a "test"'))
    assert read_imu_calibration(path) == (ONE,)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (("fusecap imu calibration 1", "other"), "format is 'other'"),
        (("origin", "orign"), "unknown key 'orign'; did you mean 'origin'"),
        (("heading_deg = -3.250", 'heading_deg = "x"'), "heading_deg is 'x', expected a number"),
        (("[0.5000000", "[5.5000000"), "expected a unit quaternion"),
        (("heading_deg", "heading"), "unknown key 'heading'"),
        (("bone = ", "# bone = "), "has no bone"),
        (("[[imu]]", "[imu]"), r"expected \[\[imu\]\] tables"),
        (("[0.5", "[[0.5"), "not valid TOML"),
    ],
)
def test_garbled_file_says_what_is_wrong(tmp_path, change, message):
    path = tmp_path / "imu_calibration.toml"
    path.write_text(imu_calibration_toml([ONE], origin="test").replace(*change))
    with pytest.raises(InputError, match=message):
        read_imu_calibration(path)


def test_file_with_two_sensors_on_one_bone_is_refused(tmp_path):
    path = tmp_path / "imu_calibration.toml"
    path.write_text(imu_calibration_toml([ONE, ONE], origin="test"))
    with pytest.raises(InputError, match=r"'head' of 'an na' has two"):
        read_imu_calibration(path)


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    """Ten seconds before three cameras at 60 Hz, with six sensors."""
    sequence = twin_sequence("T2 ROM1")
    person = Person(
        name="anna",
        shape=sequence.shape,
        theta=placed(sequence.theta[:480]),
        imu_bones=IMUS_6,
    )
    folder = tmp_path_factory.mktemp("recording")
    write_session(
        simulate([person], camera_ring(3), landmark_set_named("body25"), rate_hz=60.0, seed=1),
        folder,
    )
    return folder


def run(monkeypatch, capsys, *arguments):
    monkeypatch.setattr("sys.argv", ["fusecap", "calibrate", "imu", *map(str, arguments)])
    with pytest.raises(SystemExit) as ended:
        main()
    return ended.value.code, capsys.readouterr()


@pytest.mark.slow
def test_command_writes_what_solve_then_uses(recording, tmp_path, monkeypatch, capsys):
    out = tmp_path / "imu_calibration.toml"
    code, said = run(monkeypatch, capsys, recording, "--out", out, "--json")
    assert code == 0
    sensors = json.loads(said.out)["subjects"][0]["sensors"]
    assert {sensor["bone"] for sensor in sensors} == set(IMUS_6)
    legs = [sensor for sensor in sensors if "shank" in sensor["bone"]]
    assert all(sensor["held_out_deg"] < 6 for sensor in legs)
    assert (tmp_path / "imu_calibration_anna.png").stat().st_size > 10_000
    text = (recording / "session.toml").read_text()
    used = recording / "calibrated.toml"
    used.write_text(text.replace("[session]", f'[session]\nimu_calibration = "{out}"', 1))
    settings = load_session(used).subjects[0].imus
    by_bone = {imu.bone: imu for imu in read_imu_calibration(out)}
    assert all(imu.heading_deg == by_bone[imu.bone].heading_deg for imu in settings)
    code, said = run(
        monkeypatch, capsys, recording, "--take", recording / "truth.npz", "--identify"
    )
    assert code == 0 and said.out.count("as stated") == 6


def test_calibration_of_another_session_is_refused(recording, tmp_path):
    path = tmp_path / "imu_calibration.toml"
    path.write_text(imu_calibration_toml([ONE], origin="test"))
    used = recording / "other.toml"
    text = (recording / "session.toml").read_text()
    used.write_text(text.replace("[session]", f'[session]\nimu_calibration = "{path}"', 1))
    with pytest.raises(SessionError, match="holds imu 'head' of 'an na'"):
        load_session(used)


@pytest.mark.slow
def test_a_take_serves_instead_of_cameras_and_write_makes_the_session_use_it(
    recording, tmp_path, monkeypatch, capsys
):
    folder = shutil.copytree(recording, tmp_path / "take")
    monkeypatch.chdir(tmp_path)
    arguments = ["take", "--take", "take/truth.npz", "--optical", "--write"]
    code, said = run(monkeypatch, capsys, *arguments, "--out", "x.toml")
    assert code == 2 and not Path("x.toml").exists()
    code, said = run(monkeypatch, capsys, *arguments)
    assert code == 0 and "session.toml uses it now" in said.out, said.out + said.err
    assert said.out.count("good") == 6
    calibration = load_session(folder / "session.toml").settings.imu_calibration
    assert calibration == folder / "imu_calibration.toml" and calibration.is_file()


def test_misuse_and_missing_inputs_are_told(recording, tmp_path, monkeypatch, capsys):
    code, _ = run(monkeypatch, capsys, recording, "--from", "tpos")
    assert code == 2
    code, _ = run(monkeypatch, capsys, recording, "--optical")
    assert code == 2
    code, said = run(monkeypatch, capsys, recording, "--from", "tpose")
    assert code == 1 and "tpose_s states when" in said.err
    text = (recording / "session.toml").read_text()
    bare = text.split("[[camera]]")[0] + "[[subject]]" + text.split("[[subject]]", 1)[1]
    path = recording / "bare.toml"
    path.write_text(bare)
    code, said = run(monkeypatch, capsys, path)
    assert code == 1 and "there are no cameras" in said.err
    path.write_text(text.replace('bone = "right_shank"', 'bone = "left_shank"'))
    code, said = run(monkeypatch, capsys, path, "--take", recording / "truth.npz")
    assert code == 1 and "two [[subject.imu]] on left_shank" in said.err
    path.write_text(text.split("[[subject.imu]]")[0])
    code, said = run(monkeypatch, capsys, path)
    assert code == 1 and "nothing to calibrate" in said.err


def test_tpose_command_leaves_out_sensors_that_moved(recording, tmp_path, monkeypatch, capsys):
    path = recording / "tpose.toml"
    path.write_text((recording / "session.toml").read_text())
    edit(path, 'name = "anna"', 'name = "anna"\ntpose_s = [0.0, 0.02]')
    out = tmp_path / "imu.toml"
    code, said = run(monkeypatch, capsys, path, "--from", "tpose", "--out", out, "--json")
    rows = json.loads(said.out)["imus"]
    kept = [row["bone"] for row in rows if not row["complaints"]]
    assert len(rows) == 6 and len(kept) < 6, "the subject walks, it does not stand in a T-pose"
    assert code == (0 if kept else 1)
    assert out.is_file() == bool(kept)


# A real walk


@pytest.mark.real_data
def test_known_yaw_error_of_the_ankle_sensors_is_found(data_dir):
    path = Path(__file__).resolve().parents[1] / "examples" / "gait_imu_only.py"
    spec = importlib.util.spec_from_file_location("gait_imu_only", path)
    assert spec is not None and spec.loader is not None
    gait = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = gait
    spec.loader.exec_module(gait)
    from fusecap.sources.imu_files import read_imu

    folder = data_dir / "gait_imu_vicon"
    vicon, known = gait.read_vicon(folder / "vicon_first_400.csv"), gait.heading_deg(folder)
    for side in ("left", "right"):
        bone = f"{side}_shank"
        name = gait.SEGMENTS[bone][0]
        track = read_imu(gait.imu_file(folder, name), format="gaittoolbox-csv")
        quaternion = track.orientation_wxyz[:400][:, [1, 2, 3, 0]]
        rotation = vicon.rotation[bone].as_matrix()
        covariance = np.broadcast_to(np.eye(3) * np.radians(3.0) ** 2, rotation.shape)
        pairs = make_pairs(
            np.arange(400) / gait.RATE_HZ,
            rotation,
            covariance,
            Y_UP_FROM_Z_UP @ Rotation.from_quat(quaternion).as_matrix(),
        )
        assert np.degrees(fit(pairs).heading_rad) == pytest.approx(known[name], abs=5.0)
