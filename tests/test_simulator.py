from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from fusecap.body.landmarks import landmark_set_named
from fusecap.body.pose import forward_kinematics, landmarks_in_world
from fusecap.errors import InputError
from fusecap.evaluate.demo_scene import VOLUME_M, demo_scene
from fusecap.evaluate.imu_noise import (
    GRAVITY_IN_WORLD_M_S2,
    IMUS_6,
    IMUS_13,
    NO_IMU_NOISE,
    measure,
)
from fusecap.evaluate.keypoint_noise import NO_KEYPOINT_NOISE, KeypointNoise, detector_bias
from fusecap.evaluate.noise import bursts, correlated_noise
from fusecap.evaluate.rig_noise import RigNoise
from fusecap.evaluate.simulated_session import write_session
from fusecap.evaluate.simulator import (
    CameraTiming,
    Person,
    at_times,
    camera_ring,
    placed,
    simulate,
)
from fusecap.sources.session_data import open_session
from fusecap.sources.session_file import load_session
from fusecap.stored_take import load_take
from motions import person, walk

BODY25 = landmark_set_named("body25")
RIG = camera_ring(3)


def two_and_a_bystander(frames=40, *, imu_bones=IMUS_13):
    theta = walk(person(), frames)
    return [
        Person(
            name="anna",
            shape=person(),
            theta=placed(theta, centre_m=(-0.8, 0.0)),
            imu_bones=imu_bones,
        ),
        Person(
            name="ben",
            shape=person(1.9),
            theta=placed(theta, turn_rad=2.0, centre_m=(0.8, 0.0), scale=1.9 / 1.75),
            imu_bones=imu_bones,
        ),
        Person(
            name="guest",
            shape=person(1.6),
            theta=placed(theta, turn_rad=1.0, centre_m=(0.0, -1.5)),
            bystander=True,
        ),
    ]


def captured(people, *, seed=3, rig=RIG, keypoint_noise=None, imu_noise=None, rate_hz=60.0):
    return simulate(
        people,
        rig,
        BODY25,
        rate_hz=rate_hz,
        seed=seed,
        keypoint_noise=keypoint_noise,
        imu_noise=imu_noise,
    )


def images(simulation, person_index):
    """True landmarks of one person in each camera (C, T, K, 2)."""
    one = simulation.people[person_index]
    position, rotation = forward_kinematics(one.shape, one.theta)
    points = landmarks_in_world(
        position, rotation, BODY25.bones(one.shape.skeleton), BODY25.offsets_m(one.shape)
    )
    return np.stack(
        [
            camera.project(points.reshape(-1, 3)).reshape(*points.shape[:2], 2)
            for camera in simulation.rig.cameras
        ]
    )


def detections_of(simulation, person_index):
    """(C, T, K, 3); NaN where the person is not detected."""
    rig, frames = simulation.rig, len(simulation.detections)
    found = np.full((len(rig), frames, len(BODY25.landmark_names), 3), np.nan)
    for frame, detections in enumerate(simulation.detections):
        for camera, people in enumerate(detections.people):
            whose = simulation.detected_person[frame][camera]
            assert len(whose) == len(people)
            for row in np.flatnonzero(whose == person_index):
                found[camera, frame] = people[row]
    return found


def test_without_noise_keypoints_are_images_of_landmarks():
    simulation = captured(two_and_a_bystander(), keypoint_noise=NO_KEYPOINT_NOISE)
    for index in range(3):
        found, true = detections_of(simulation, index), images(simulation, index)
        assert np.isfinite(found[..., 2]).all()
        seen = found[..., 2] > 0
        assert seen.mean() > 0.95
        assert np.allclose(found[seen][:, :2], true[seen], atol=1e-9)


def test_without_noise_imus_are_the_bones():
    simulation = captured(two_and_a_bystander(), imu_noise=NO_IMU_NOISE)
    assert set(simulation.imu_readings) == {"anna", "ben"}
    for subject, readings in simulation.imu_readings.items():
        one = simulation.truth.subject(subject)
        bones = [simulation.truth.bone_names.index(name) for name in IMUS_13]
        rotation = simulation.truth.bone_rotation_in_world(one)[:, bones]
        position = simulation.truth.bone_position_in_world_m[one][:, bones]
        at = simulation.imus[subject].position_in_bone_m
        place = position + np.einsum("tijk,ik->tij", rotation, at)
        accel = (place[2:] - 2 * place[1:-1] + place[:-2]) * 60.0**2
        assert np.allclose([r.bone_rotation_in_world for r in readings], rotation, atol=1e-12)
        measured = np.array([r.accel_in_world_m_s2 for r in readings])
        assert np.allclose(measured[1:-1], accel, atol=1e-8)


def test_imu_at_rest_measures_gravity_upwards(rng):
    theta = np.tile(rng.normal(size=66), (5, 1))
    imus = measure(rng, person(), theta, IMUS_6, NO_IMU_NOISE, 60.0)
    assert np.allclose(imus.gyro_rad_s, 0.0)
    force_in_world = np.einsum("tijk,tik->tij", imus.world_from_imu, imus.accel_m_s2)
    assert np.allclose(force_in_world, GRAVITY_IN_WORLD_M_S2)
    assert GRAVITY_IN_WORLD_M_S2[1] == 9.80665


def test_imu_errors_are_as_large_as_stated():
    noise = replace(NO_IMU_NOISE, misalignment_deg=4.0)
    still = np.tile(walk(person(), 1), (3, 1))
    people = [
        Person(name=str(n), shape=person(), theta=still, imu_bones=IMUS_13) for n in range(60)
    ]
    rig = camera_ring(0)
    errors = []
    for name, readings in captured(people, rig=rig, imu_noise=noise).imu_readings.items():
        _, truth = forward_kinematics(person(), still)
        bones = [person().skeleton.bone(bone) for bone in IMUS_13]
        measured = np.array([r.bone_rotation_in_world for r in readings])
        relative = np.swapaxes(truth[:, bones], -1, -2) @ measured
        assert np.allclose(relative[0], relative[-1]), name
        errors.append(Rotation.from_matrix(relative[0]).as_rotvec(degrees=True))
    assert np.std(errors) == pytest.approx(4.0, rel=0.05)


def same(a, b) -> bool:
    return all(
        np.array_equal(p, q, equal_nan=True)
        for x, y in zip(a.detections, b.detections, strict=True)
        for p, q in zip(x.people, y.people, strict=True)
    )


def test_seed_decides_every_bit():
    people = two_and_a_bystander()
    first, again, other = (captured(people, seed=seed) for seed in (5, 5, 6))
    assert same(first, again) and not same(first, other)
    for name, imus in first.imus.items():
        assert np.array_equal(imus.world_from_imu, again.imus[name].world_from_imu)
        assert np.array_equal(imus.accel_m_s2, again.imus[name].accel_m_s2)
        assert not np.array_equal(imus.accel_m_s2, other.imus[name].accel_m_s2)


def test_imus_leave_the_keypoints_as_they_were():
    assert same(captured(two_and_a_bystander()), captured(two_and_a_bystander(imu_bones=IMUS_6)))


def test_bystander_is_seen_and_is_in_no_truth():
    simulation = captured(two_and_a_bystander())
    assert simulation.truth.subject_names == ("anna", "ben")
    assert simulation.truth.provenance["simulated"] is True
    assert np.isfinite(detections_of(simulation, 2)).any()
    assert "guest" not in simulation.imus


def test_people_come_in_random_order():
    simulation = captured(two_and_a_bystander(), keypoint_noise=NO_KEYPOINT_NOISE)
    orders = {tuple(views[0]) for views in simulation.detected_person}
    assert len(orders) > 3


def test_person_behind_another_is_occluded_and_not_the_one_in_front():
    noise = replace(NO_KEYPOINT_NOISE, occluded_seen_share=0.0)
    camera = camera_ring(1, height_m=0.9)
    toward = camera.cameras[0].position_in_world * [1, 0, 1]
    toward /= np.linalg.norm(toward)
    still = np.tile(walk(person(), 1), (4, 1))
    turn = np.pi / 4
    front, back = (
        placed(still, turn_rad=turn, centre_m=(d * toward[0], d * toward[2])) for d in (0.4, -0.4)
    )
    people = [
        Person(name="back", shape=person(), theta=back),
        Person(name="front", shape=person(), theta=front),
    ]
    simulation = captured(people, rig=camera, keypoint_noise=noise)
    hidden = detections_of(simulation, 0)[0, 0, :, 2] == 0
    open_ = detections_of(simulation, 1)[0, 0, :, 2] > 0
    trunk = [BODY25.landmark_names.index(name) for name in ("mid_hip", "neck")]
    assert hidden[trunk].all()
    assert open_.mean() > 0.9


def test_keypoint_error_has_the_stated_size():
    noise = replace(NO_KEYPOINT_NOISE, sigma_px=5.0, correlation_s=0.0)
    people = two_and_a_bystander(400)[:1]
    for size_px, focal_px in (((1920, 1080), 1150.0), ((960, 540), 575.0)):
        rig = camera_ring(2, size_px=size_px, focal_px=focal_px)
        simulation = captured(people, rig=rig, keypoint_noise=noise)
        found, true = detections_of(simulation, 0), images(simulation, 0)
        depth = np.stack(
            [
                people[0].theta[:, :3] @ camera.rotation[2] + camera.translation[2]
                for camera in rig.cameras
            ]
        )
        apparent = focal_px * 1.75 / depth
        seen = found[..., 2] > 0
        unit = ((found[..., :2] - true) * 600.0 / apparent[..., None, None])[seen]
        assert np.std(unit) == pytest.approx(5.0, rel=0.03)


def test_confidence_falls_with_the_error():
    simulation = captured(
        two_and_a_bystander(200)[:1],
        keypoint_noise=replace(NO_KEYPOINT_NOISE, sigma_px=5.0, confidence_per_error=0.1),
    )
    found, true = detections_of(simulation, 0), images(simulation, 0)
    seen = found[..., 2] > 0
    error = np.linalg.norm((found[..., :2] - true)[seen], axis=-1)
    assert np.corrcoef(error, found[..., 2][seen])[0, 1] < -0.3
    assert found[seen][:, 2].max() <= 1.0


def test_swapped_sides_are_each_others_images():
    noise = replace(NO_KEYPOINT_NOISE, swap_share=1.0)
    simulation = captured(two_and_a_bystander(5)[:1], keypoint_noise=noise)
    found, true = detections_of(simulation, 0), images(simulation, 0)
    swapped = true[:, :, BODY25.mirror]
    face = [n.split("_")[-1] in ("eye", "ear") for n in BODY25.landmark_names]
    expected = np.where(np.array(face)[:, None], true, swapped)
    seen = found[..., 2] > 0
    assert np.allclose(found[..., :2][seen], expected[seen])


def test_outliers_are_as_far_off_as_stated():
    noise = replace(NO_KEYPOINT_NOISE, outlier_share=1.0, occluded_outlier_share=1.0)
    people = two_and_a_bystander(200)[:1]
    found, true, apparent = against_truth(captured(people, keypoint_noise=noise))
    seen = found[..., 2] > 0
    distance = np.linalg.norm(found[..., :2] - true, axis=-1) / apparent[..., None]
    assert np.median(distance[seen]) == pytest.approx(noise.outlier_size, rel=0.05)
    assert found[..., 2].max() <= 0.8


def against_truth(simulation):
    """Keypoints and true images of the first person, and its stature in the image [px]."""
    rig, one = simulation.rig, simulation.people[0]
    depth = [one.theta[:, :3] @ c.rotation[2] + c.translation[2] for c in rig.cameras]
    focal = np.array([[camera.matrix[0, 0]] for camera in rig.cameras])
    apparent = focal * one.shape.height_m / np.array(depth)
    return detections_of(simulation, 0), images(simulation, 0), apparent


def error_px(noise, *, rate_hz=60.0, speed_m_s=0.0, rig=RIG):
    """Standard deviation per axis of somebody who stands, or glides along x."""
    theta = np.tile(walk(person(), 1), (300, 1))
    theta[:, 0] += speed_m_s * (np.arange(300) / rate_hz - 150 / rate_hz)
    one = Person(name="anna", shape=person(), theta=theta)
    found, true, _ = against_truth(captured([one], keypoint_noise=noise, rate_hz=rate_hz, rig=rig))
    return np.nanstd(found[..., :2] - true)


def test_floor_of_the_noise_is_the_same_near_and_far():
    noise = replace(NO_KEYPOINT_NOISE, floor_px=3.0)
    for radius_m in (3.0, 9.0):
        rig = camera_ring(3, radius_m=radius_m)
        assert error_px(noise, rig=rig) == pytest.approx(3.0, rel=0.03)
    half = camera_ring(3, size_px=(960, 540), focal_px=575.0)
    assert error_px(noise, rig=half) == pytest.approx(1.5, rel=0.03)


def test_noise_grows_with_the_speed_of_the_image():
    noise = replace(NO_KEYPOINT_NOISE, floor_px=3.0, motion_s=0.01)
    assert error_px(noise) == pytest.approx(3.0, rel=0.03)
    one_camera = camera_ring(1, span_deg=10.0)
    fast = error_px(noise, speed_m_s=1.0, rig=one_camera)
    expected_px_s = 1150.0 / np.hypot(4.5, 1.5)
    assert fast == pytest.approx(np.hypot(3.0, 0.01 * expected_px_s), rel=0.15)


def test_limbs_are_taken_from_the_person_behind_only_where_boxes_overlap():
    noise = replace(NO_KEYPOINT_NOISE, confusion_share=1.0)
    camera = camera_ring(1, span_deg=10.0)
    still = np.tile(walk(person(), 1), (4, 1))
    for x, z, confused in ((0.1, -0.6, True), (1.6, 0.0, False)):
        people = [
            Person(name="a", shape=person(), theta=placed(still, centre_m=(0.0, 0.0))),
            Person(name="b", shape=person(), theta=placed(still, centre_m=(x, z))),
        ]
        simulation = captured(people, keypoint_noise=noise, rig=camera)
        found = detections_of(simulation, 0)[0]
        other = images(simulation, 1 if confused else 0)[0]
        limb = [BODY25.landmark_names.index(f"left_{part}") for part in ("elbow", "knee")]
        assert np.allclose(found[:, limb, :2], other[:, limb], atol=1e-9)
        nose = BODY25.landmark_names.index("nose")
        assert np.allclose(found[:, nose, :2], images(simulation, 0)[0][:, nose], atol=1e-9)


def test_landmarks_lie_where_the_simulation_says():
    noise = replace(NO_KEYPOINT_NOISE, detector_bias=0.01, landmark_bias_m=0.005)
    simulation = captured(two_and_a_bystander(), keypoint_noise=noise)
    one = simulation.people[1]
    position, rotation = forward_kinematics(one.shape, one.theta)
    points = landmarks_in_world(
        position, rotation, BODY25.bones(one.shape.skeleton), simulation.landmark_offsets_m[1]
    )
    camera = simulation.rig.cameras[0]
    expected = camera.project(points.reshape(-1, 3)).reshape(*points.shape[:2], 2)
    found = detections_of(simulation, 1)[0]
    seen = found[..., 2] > 0
    assert np.allclose(found[..., :2][seen], expected[seen], atol=1e-9)


def test_detector_bias_is_everybodys_and_symmetric():
    bias = detector_bias(BODY25, KeypointNoise(detector_bias=0.01))
    assert np.allclose(bias[BODY25.mirror] * [-1, 1, 1], bias)
    simulation = captured(two_and_a_bystander(2), keypoint_noise=KeypointNoise())
    again = captured(two_and_a_bystander(2), keypoint_noise=KeypointNoise(), seed=4)
    for one, other, who in zip(
        simulation.landmark_offsets_m, again.landmark_offsets_m, simulation.people, strict=True
    ):
        common = detector_bias(BODY25, KeypointNoise()) * who.shape.height_m
        own = [offsets - BODY25.offsets_m(who.shape) - common for offsets in (one, other)]
        assert np.std(own[0]) == pytest.approx(0.008, rel=0.3)
        assert not np.allclose(*own)


def test_a_subset_is_the_same_capture_without_the_rest():
    full = captured(two_and_a_bystander())
    part = full.subset(cameras=("cam3", "cam1"), imu_bones=IMUS_6)
    assert part.rig.names == ("cam3", "cam1") and part.truth is full.truth
    for whole, fewer in zip(full.detections, part.detections, strict=True):
        assert np.array_equal(fewer.people[0], whole.people[2], equal_nan=True)
        assert np.array_equal(fewer.people[1], whole.people[0], equal_nan=True)
    kept = [IMUS_13.index(bone) for bone in part.imus["anna"].bones]
    assert set(part.imus["anna"].bones) == set(IMUS_6)
    assert np.array_equal(
        part.imus["anna"].world_from_imu, full.imus["anna"].world_from_imu[:, kept]
    )
    nothing = full.subset(cameras=(), imu_bones=())
    assert nothing.imus == {} and nothing.detections[0].people == ()


def test_cameras_of_other_rates_and_offsets_see_the_motion_at_their_own_times():
    timing = [
        CameraTiming(rate_hz=60.0),
        CameraTiming(rate_hz=60.0, offset_s=0.005),
        CameraTiming(rate_hz=25.0, offset_s=0.01),
    ]
    people = two_and_a_bystander(61)[:1]
    simulation = simulate(
        people,
        RIG,
        BODY25,
        rate_hz=60.0,
        seed=0,
        keypoint_noise=NO_KEYPOINT_NOISE,
        timing=timing,
    )
    assert [len(view.times_s) for view in simulation.views] == [61, 60, 25]
    assert not simulation.synchronous
    with pytest.raises(InputError, match="per frame of each camera"):
        _ = simulation.detected_person
    for camera, view in zip(RIG.cameras, simulation.views, strict=True):
        theta = at_times(people[0].theta, 60.0, view.times_s)
        position, rotation = forward_kinematics(people[0].shape, theta)
        shape = people[0].shape
        points = landmarks_in_world(
            position, rotation, BODY25.bones(shape.skeleton), BODY25.offsets_m(shape)
        )
        expected = camera.project(points.reshape(-1, 3)).reshape(*points.shape[:2], 2)
        for frame, keypoints in enumerate(view.people):
            seen = keypoints[0, :, 2] > 0
            assert np.allclose(keypoints[0, seen, :2], expected[frame, seen])
    true = images(simulation, 0)
    for frame in range(5, 50):
        between = simulation.detections[frame].people[1][0]
        seen = between[:, 2] > 0
        assert np.abs(between[seen, :2] - true[1, frame, seen]).max() < 1.0


def test_clock_error_shows_what_was_true_at_another_time():
    noise = replace(NO_KEYPOINT_NOISE, clock_s=0.02)
    people = two_and_a_bystander(40)[:1]
    found, true, _ = against_truth(captured(people, keypoint_noise=noise))
    off = np.nanmedian(np.linalg.norm(found[..., :2] - true, axis=-1), axis=(1, 2))
    assert (off > 0.1).any()
    imus = captured(people, imu_noise=replace(NO_IMU_NOISE, clock_s=0.05)).imu_readings["anna"]
    right = captured(people, imu_noise=NO_IMU_NOISE).imu_readings["anna"]
    assert not np.allclose(imus[20].bone_rotation_in_world, right[20].bone_rotation_in_world)


def test_poses_between_frames_are_on_the_way():
    theta = walk(person(), 30)
    assert at_times(theta, 60.0, np.arange(30) / 60.0) == pytest.approx(theta)
    fine = at_times(theta, 60.0, np.array([4.5 / 60.0]))
    before, _ = forward_kinematics(person(), theta[4:6])
    between, _ = forward_kinematics(person(), fine)
    assert np.allclose(between[0], before.mean(axis=0), atol=2e-3)


def test_rig_noise_moves_what_is_believed_and_not_what_is_seen():
    people = two_and_a_bystander(3)
    exact = captured(people, keypoint_noise=NO_KEYPOINT_NOISE)
    off = simulate(
        people,
        RIG,
        BODY25,
        rate_hz=60.0,
        seed=3,
        keypoint_noise=NO_KEYPOINT_NOISE,
        rig_noise=RigNoise(world_m=0.01),
    )
    assert same(exact, off)
    shifts = [
        a.position_in_world - b.position_in_world
        for a, b in zip(off.rig.cameras, RIG.cameras, strict=True)
    ]
    assert np.allclose(shifts, shifts[0]) and 0.001 < np.linalg.norm(shifts[0]) < 0.05


def test_flesh_falls_behind_a_turning_bone_and_rests_with_a_resting_one(rng):
    noise = replace(NO_IMU_NOISE, tissue_lag_s=0.01, tissue_s=0.0)
    theta = np.zeros((60, 66))
    theta[:, 4] = np.arange(60) / 60.0
    imus = measure(rng, person(), theta, ("left_thigh",), noise, 60.0)
    measured = np.array([r.bone_rotation_in_world[0] for r in imus.readings()])
    heading = np.arctan2(measured[:, 0, 2], measured[:, 2, 2])
    assert np.allclose(heading[1:], theta[1:, 4] - 0.01, atol=1e-9)
    assert np.allclose(np.linalg.norm(imus.gyro_rad_s, axis=-1), 1.0)


def test_heading_drifts_at_a_steady_rate(rng):
    noise = replace(NO_IMU_NOISE, heading_drift_deg_min=600.0)
    imus = measure(rng, person(), np.zeros((61, 66)), IMUS_13, noise, 60.0)
    measured = np.array([r.bone_rotation_in_world for r in imus.readings()])
    heading = np.degrees(np.arctan2(measured[..., 0, 2], measured[..., 2, 2]))
    assert np.allclose(heading[30], heading[60] / 2) and np.std(heading[60]) > 2.0


def test_lost_samples_are_bridged_as_a_session_bridges_them(rng):
    theta = walk(person(), 600)
    noise = replace(NO_IMU_NOISE, lost_share=0.2, lost_s=0.1)
    imus = measure(rng, person(), theta, IMUS_13, noise, 60.0)
    assert (~imus.received).mean() == pytest.approx(0.2, rel=0.15)
    measured = np.array([r.bone_rotation_in_world for r in imus.readings()])
    missing = np.isnan(measured[..., 0, 0])
    assert 0 < missing.mean() < 0.2
    assert not missing[imus.received].any()


def test_bystanders_alone_are_no_simulation():
    with pytest.raises(InputError, match="everybody is a bystander"):
        captured(two_and_a_bystander(3)[2:])


def test_picture_on_the_wall_is_nobodys():
    noise = replace(NO_KEYPOINT_NOISE, spurious_share=1.0)
    simulation = captured(two_and_a_bystander(5), keypoint_noise=noise)
    for detections, whose in zip(simulation.detections, simulation.detected_person, strict=True):
        for people, indices in zip(detections.people, whose, strict=True):
            assert sorted(indices) == [-1, 0, 1, 2]
            assert people[np.flatnonzero(indices == -1)[0], :, 2].max() <= 0.5


def test_person_out_of_every_view_is_in_no_detection():
    away = Person(
        name="away", shape=person(), theta=placed(walk(person(), 4), centre_m=(500.0, 0.0))
    )
    noise = KeypointNoise(spurious_share=0.0)
    simulation = captured([*two_and_a_bystander(4)[:1], away], keypoint_noise=noise)
    assert np.isnan(detections_of(simulation, 1)).all()
    alone = captured([away], keypoint_noise=noise, rig=camera_ring(2, radius_m=2.0))
    assert alone.detections[0].people[0].shape == (0, 25, 3)


def test_missing_keypoint_is_nan_with_confidence_zero():
    for detections in captured(two_and_a_bystander()).detections:
        for people in detections.people:
            missing = people[..., 2] == 0
            assert np.isnan(people[missing][:, :2]).all()
            assert np.isfinite(people[~missing]).all()


def test_motions_of_different_length_are_refused():
    people = [*two_and_a_bystander(4)[:1], *two_and_a_bystander(5)[1:2]]
    with pytest.raises(InputError, match="one length"):
        captured(people)


@pytest.mark.parametrize(("share", "mean"), [(0.05, 10.0), (0.5, 4.0), (0.0, 5.0), (1.0, 5.0)])
def test_bursts_have_the_stated_share_and_length(rng, share, mean):
    active = bursts(rng, 4000, (50,), share=share, mean_frames=mean)
    assert active.mean() == pytest.approx(share, rel=0.1)
    if 0 < share < 1:
        starts = (np.diff(active.astype(int), axis=0) == 1).sum()
        assert active.sum() / starts == pytest.approx(mean, rel=0.1)


@pytest.mark.parametrize("correlation", [0.0, 5.0])
def test_correlated_noise_is_unit_and_correlated_as_stated(rng, correlation):
    noise = correlated_noise(rng, 4000, (50,), correlation)
    assert noise.std() == pytest.approx(1.0, rel=0.02)
    lag = 5
    expected = np.exp(-lag / correlation) if correlation else 0.0
    assert (noise[lag:] * noise[:-lag]).mean() == pytest.approx(expected, abs=0.02)


def test_ring_cameras_look_at_the_axis_and_stand_upright():
    rig = camera_ring(5, radius_m=4.0, height_m=2.0, target_height_m=1.0, size_px=(801, 601))
    assert rig.names == ("cam1", "cam2", "cam3", "cam4", "cam5")
    for camera in rig.cameras:
        place = camera.position_in_world
        assert np.hypot(place[0], place[2]) == pytest.approx(4.0)
        assert place[1] == pytest.approx(2.0)
        target, above = camera.project(np.array([[0.0, 1.0, 0.0], [0.0, 1.5, 0.0]]))
        assert np.allclose(target, [400.0, 300.0])
        assert above[0] == pytest.approx(400.0) and above[1] < 300.0


def test_placed_motion_is_the_same_motion_elsewhere():
    theta = walk(person(), 30)
    turn = Rotation.from_rotvec([0, 1.1, 0])
    before, _ = forward_kinematics(person(), theta)
    after, _ = forward_kinematics(person(), placed(theta, turn_rad=1.1, centre_m=(3.0, 4.0)))
    turned = turn.apply(before.reshape(-1, 3)).reshape(before.shape)
    shift = after - turned
    assert np.allclose(shift, shift[0, 0], atol=1e-12) and shift[0, 0, 1] == pytest.approx(0.0)
    path = after[:, 0]
    assert np.allclose(((path.min(axis=0) + path.max(axis=0)) / 2)[[0, 2]], [3.0, 4.0], atol=0.05)


def test_demo_has_its_subjects_inside_and_the_bystander_outside():
    scene = demo_scene(seconds=2.0)
    assert scene.truth.subject_names == ("anna", "ben")
    assert len(scene.rig) == 4 and len(scene.people) == 3
    assert all(imus.bones == IMUS_13 for imus in scene.imus.values())
    for one in demo_scene().people:
        x, z = one.theta[:, 0], one.theta[:, 2]
        inside = (VOLUME_M[0] < x) & (x < VOLUME_M[1]) & (VOLUME_M[2] < z) & (z < VOLUME_M[3])
        assert not inside.any() if one.bystander else inside.all()


@pytest.mark.parametrize("seconds", [0.0, 1e4])
def test_demo_of_impossible_length_is_refused(seconds):
    with pytest.raises(InputError, match="demo lasts"):
        demo_scene(seconds=seconds)


def test_written_session_reads_back_as_the_simulation(tmp_path):
    scene = demo_scene(2, seconds=0.5)
    data = open_session(load_session(write_session(scene, tmp_path / "demo")))
    assert data.rig.names == scene.rig.names
    for read, made in zip(data.rig.cameras, scene.rig.cameras, strict=True):
        assert np.allclose(read.packed, made.packed)
    assert np.abs(data.timestamps_ns - scene.truth.timestamps_ns).max() <= 1
    for frame in range(30):
        people = data.detections(frame).people
        for read, made in zip(people, scene.detections[frame].people, strict=True):
            assert np.allclose(read, made, atol=1e-3, equal_nan=True)
    for imus in data.imus:
        assert imus.bones == scene.imus[imus.subject].bones
        for frame, made in enumerate(scene.imu_readings[imus.subject]):
            read = imus.reading(frame)
            assert np.allclose(read.bone_rotation_in_world, made.bone_rotation_in_world, atol=1e-6)
            assert np.allclose(read.accel_in_world_m_s2, made.accel_in_world_m_s2, atol=1e-5)
    truth = load_take(tmp_path / "demo" / "truth.npz")
    assert np.allclose(truth.theta, scene.truth.theta, rtol=0.0, atol=1e-6)


def test_views_without_anybody_are_written_and_read_back_as_empty(tmp_path):
    nobody = replace(NO_KEYPOINT_NOISE, person_miss_share=1.0)
    simulation = captured(two_and_a_bystander(5), keypoint_noise=nobody)
    data = open_session(load_session(write_session(simulation, tmp_path / "empty")))
    assert all(len(people) == 0 for people in data.detections(0).people)
