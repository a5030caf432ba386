import json
from dataclasses import replace

import numpy as np
import pytest

from fusecap.body.landmarks import LANDMARKS, LandmarkOffsets, landmark_set_named
from fusecap.body.pose import forward_kinematics, landmarks_in_world
from fusecap.body.shape import BodyShape
from fusecap.body.skeleton import PAPER21
from fusecap.calibrate.offset_samples import _assigned, measure_offsets, reprojection_error_px
from fusecap.calibrate.offsets import MAX_MOVE, calibrate_session, median_offsets, self_calibrate
from fusecap.cli import main
from fusecap.errors import InputError, SessionError
from fusecap.evaluate.demo_scene import demo_scene
from fusecap.evaluate.keypoint_noise import NO_KEYPOINT_NOISE
from fusecap.evaluate.score import score_take
from fusecap.evaluate.simulated_session import write_session
from fusecap.evaluate.simulated_solve import solve_simulation
from fusecap.evaluate.simulator import Person, camera_ring, placed, simulate
from fusecap.geometry.camera import Rig
from fusecap.solve.body_measure import BodyMeasure
from fusecap.sources.offset_files import offsets_toml, read_offsets
from fusecap.sources.session_data import open_session
from fusecap.sources.session_file import load_session
from motions import person, walk

BODY25 = landmark_set_named("body25")
FRAMES, RATE_HZ = 60, 30.0


def shifted(**moves):
    """Defaults with some landmarks moved [fractions of stature], left and right alike."""
    offsets = {}
    for name, move in moves.items():
        for side in ("left_", "right_") if f"left_{name}" in LANDMARKS else ("",):
            sign = [-1, 1, 1] if side == "right_" else [1, 1, 1]
            offsets[side + name] = tuple(np.add(LANDMARKS[side + name][1], np.multiply(move, sign)))
    return LandmarkOffsets(everyone=offsets)


TRUE = shifted(
    nose=(0, 0.01, 0.02),
    ear=(0.005, -0.01, 0.01),
    neck=(0.0, 0.01, 0.01),
    elbow=(0.0, -0.006, 0.006),
    knee=(0.004, 0.0, 0.008),
    heel=(0.0, 0.01, -0.01),
)


@pytest.fixture(scope="module")
def scene():
    """Two walkers whose landmarks do not lie where the defaults say, seen without noise."""
    motion = walk(person(), FRAMES, rate_hz=RATE_HZ)
    people = [
        Person(name="anna", shape=person(), theta=placed(motion, centre_m=(-1.0, 0.0))),
        Person(name="ben", shape=person(), theta=placed(motion, turn_rad=2.0, centre_m=(1.0, 0.3))),
    ]
    return simulate(
        people,
        camera_ring(4),
        BODY25.calibrated(TRUE),
        rate_hz=RATE_HZ,
        seed=3,
        keypoint_noise=NO_KEYPOINT_NOISE,
    )


def test_calibrated_set_gives_its_offsets_and_defaults_for_the_rest():
    shape = BodyShape.from_height(PAPER21, 2.0)
    offsets_m = BODY25.calibrated(TRUE).offsets_m(shape)
    nose, wrist = BODY25.index("nose"), BODY25.index("left_wrist")
    assert np.allclose(offsets_m[nose], np.array([0.0, 0.032, 0.08]) * 2.0)
    assert np.array_equal(offsets_m[wrist], BODY25.offsets_m(shape)[wrist])


def test_offsets_of_a_subject_come_before_those_of_everyone():
    both = LandmarkOffsets(
        everyone={"nose": (0.0, 0.0, 0.1), "neck": (0.0, 0.1, 0.0)},
        subjects={"anna": {"nose": (0.0, 0.0, 0.2)}},
    )
    landmarks = BODY25.calibrated(both)
    nose, neck = BODY25.index("nose"), BODY25.index("neck")
    assert landmarks.of("anna").fractions[nose].tolist() == [0, 0, 0.2]
    assert landmarks.of("anna").fractions[neck].tolist() == [0, 0.1, 0]
    assert landmarks.of("ben") is landmarks


def test_unknown_landmark_is_refused():
    with pytest.raises(InputError, match="no landmark 'noze'; did you mean 'nose'"):
        LandmarkOffsets(everyone={"noze": (0.0, 0.0, 0.0)})


def test_truth_gives_the_offsets_back_exactly(scene):
    samples = measure_offsets(scene.rig, BODY25, scene.truth, scene.detections)
    found = BODY25.calibrated(median_offsets(BODY25, samples)).fractions
    # Triangulation stops within 1 mm.
    assert np.abs(found - BODY25.calibrated(TRUE).fractions).max() * 1.75 < 0.001
    assert samples.count.min() > FRAMES


def test_calibrated_offsets_explain_the_keypoints(scene):
    before = reprojection_error_px(scene.rig, BODY25, scene.truth, scene.detections)
    after = reprojection_error_px(scene.rig, BODY25.calibrated(TRUE), scene.truth, scene.detections)
    assert after.mean < 1e-6 < before.mean
    assert after.count == before.count


def test_keypoints_of_others_do_not_count(scene):
    alone = measure_offsets(scene.rig, BODY25, scene.truth, scene.detections)
    # Reverse the order of people in every view: the same people, the same samples.
    turned = [replace(d, people=tuple(p[::-1] for p in d.people)) for d in scene.detections]
    again = measure_offsets(scene.rig, BODY25, scene.truth, turned)
    assert np.array_equal(alone.in_bone, again.in_bone, equal_nan=True)


def test_person_beside_the_camera_is_not_taken_for_one_in_front_of_it(scene):
    """Landmarks in the camera's own plane project to millions of pixels, whatever is there."""
    camera = scene.rig.cameras[0]
    beside = np.tile([0.01, 0.01, 1e-3], (len(BODY25.landmark_names), 1))
    beside[0] = [0.3, 0.3, 1e-3]
    landmarks = (beside - camera.translation) @ camera.rotation
    (in_front,) = camera_seen = scene.detections[0].people[0][:1]
    moment = replace(scene.detections[0], people=(camera_seen,))
    assigned = _assigned(Rig(cameras=(camera,)), landmarks[None], moment)
    assert not (assigned[..., 2] > 0).any() and (in_front[:, 2] > 0).any()


def test_landmark_seen_too_rarely_keeps_its_default(scene):
    samples = measure_offsets(scene.rig, BODY25, scene.truth, scene.detections)
    nose = BODY25.index("nose")
    in_bone = samples.in_bone.copy()
    in_bone[10:, nose] = np.nan
    found = median_offsets(BODY25, replace(samples, in_bone=in_bone))
    assert found.everyone["nose"] == LANDMARKS["nose"][1]


def test_subjects_get_tables_of_their_own(scene):
    samples = measure_offsets(scene.rig, BODY25, scene.truth, scene.detections)
    found = median_offsets(BODY25, samples, per_subject=True)
    assert set(found.subjects) == {"anna", "ben"}
    assert np.allclose(found.subjects["anna"]["nose"], TRUE.everyone["nose"], atol=1e-3)


ELSEWHERE = shifted(
    **{
        name.removeprefix("left_"): move * ([1, 1, 1] if name.startswith("left_") else [0, 1, 1])
        for name, move in zip(
            [name for name in BODY25.landmark_names if not name.startswith("right_")],
            np.random.default_rng(1).normal(0.0, 0.008, (25, 3)),
            strict=False,
        )
    }
)
"""Every landmark about 14 mm off per axis, as a detector might see it."""


@pytest.fixture(scope="module")
def real_motion():
    """Two people of the demo: motion that the pose prior knows; else its pull shows as offsets."""
    demo = demo_scene(seconds=1.0)
    return simulate(
        demo.subjects,
        demo.rig,
        BODY25.calibrated(ELSEWHERE),
        rate_hz=demo.rate_hz,
        seed=3,
        keypoint_noise=NO_KEYPOINT_NOISE,
    )


def solved(scene, landmarks):
    return solve_simulation(replace(scene, landmark_set=landmarks)).take


@pytest.mark.slow
def test_self_calibration_recovers_most_and_stays_symmetric(real_motion):
    found = self_calibrate(
        lambda landmarks: solved(real_motion, landmarks),
        real_motion.rig,
        BODY25,
        real_motion.detections,
    )
    true = BODY25.calibrated(ELSEWHERE).fractions
    before, after = (np.abs(x - true).mean() for x in (BODY25.fractions, found.landmarks.fractions))
    assert after < 0.6 * before
    moved = found.landmarks.fractions - BODY25.fractions
    assert np.allclose(moved, moved[BODY25.mirror] * [-1, 1, 1])
    assert np.abs(moved).max() <= MAX_MOVE
    assert list(found.error_px) == sorted(found.error_px, reverse=True)
    error = [
        score_take(solved(real_motion, x), real_motion.truth).position_error_mm.mean
        for x in (BODY25, found.landmarks)
    ]
    assert error[1] < error[0] + 1.0, "better offsets, hardly another pose (docs/accuracy.md)"


@pytest.mark.slow
def test_self_calibration_leaves_right_offsets_alone(real_motion):
    landmarks = BODY25.calibrated(ELSEWHERE)
    honest = replace(real_motion, landmark_set=landmarks)
    found = self_calibrate(
        lambda some: solved(honest, some), real_motion.rig, landmarks, real_motion.detections
    )
    moved = np.abs(found.landmarks.fractions - landmarks.fractions).max()
    assert moved * 1.75 < 0.012


def test_bone_lengths_are_between_joints_whatever_the_offsets():
    shape = BodyShape.from_height(PAPER21, 1.75)
    for offsets in (None, shifted(hip=(0.02, 0, 0), shoulder=(-0.01, 0, 0))):
        landmarks = BODY25.calibrated(offsets)
        measure = BodyMeasure(PAPER21, landmarks)
        position, rotation = forward_kinematics(shape, np.zeros((1, PAPER21.pose_size)))
        points = landmarks_in_world(
            position, rotation, landmarks.bones(PAPER21), landmarks.offsets_m(shape)
        )
        for _ in range(5):
            measure.add(points[0])
        found = measure.shape()
        assert found is not None
        assert np.allclose(found.offsets_m, shape.offsets_m, atol=2e-3)


# Files


def test_file_round_trip(tmp_path):
    landmarks = BODY25.calibrated(
        LandmarkOffsets(everyone=TRUE.everyone, subjects={"an na": {"nose": (0.0, 0.02, 0.07)}})
    )
    path = tmp_path / "offsets.toml"
    path.write_text(offsets_toml(landmarks, origin='a "test"'))
    again = BODY25.calibrated(read_offsets(path, "body25"))
    assert np.allclose(again.fractions, landmarks.fractions, atol=1e-5)
    assert again.of("an na").fractions[0].tolist() == [0.0, 0.02, 0.07]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (('format = "fusecap landmark offsets 1"', 'format = "other"'), "format is 'other'"),
        (('landmark_set = "body25"', 'landmark_set = "coco17"'), "holds offsets of 'coco17'"),
        (("[everyone]", "[everybody]"), "unknown key 'everybody'; did you mean 'everyone'"),
        (("nose = [", "noze = ["), "has no landmark 'noze'; did you mean 'nose'"),
        (("nose = [0", "nose = [40.0, 0"), r"nose is \[40.0, .*expected \[x, y, z\]"),
        (("nose = [0.00000", "nose = [0.5"), "fractions of stature, not metres"),
        (("nose = [", "nose = [["), "not valid TOML"),
    ],
)
def test_garbled_file_says_what_is_wrong(tmp_path, change, message):
    path = tmp_path / "offsets.toml"
    path.write_text(offsets_toml(BODY25, origin="test").replace(*change))
    with pytest.raises(InputError, match=message):
        read_offsets(path, "body25")


def test_missing_file_is_named(tmp_path):
    with pytest.raises(InputError, match=r"offsets\.toml: no such file"):
        read_offsets(tmp_path / "offsets.toml", "body25")


# Sessions


@pytest.fixture
def session(tmp_path, scene):
    write_session(scene, tmp_path)
    return tmp_path


def use(session, offsets):
    path = session / "session.toml"
    path.write_text(path.read_text().replace("[session]", f"[session]\n{offsets}", 1))


def test_session_uses_its_offsets(session):
    before = open_session(load_session(session))
    (session / "offsets.toml").write_text(offsets_toml(BODY25.calibrated(TRUE), origin="test"))
    use(session, 'landmark_offsets = "offsets.toml"')
    data = open_session(load_session(session))
    assert data.landmarks is not None
    assert np.allclose(data.landmarks.fractions, BODY25.calibrated(TRUE).fractions, atol=1e-5)
    assert data.content_hash != before.content_hash


def test_session_without_the_named_file_says_so(session):
    use(session, 'landmark_offsets = "nowhere.toml"')
    with pytest.raises(SessionError, match="landmark_offsets: no file"):
        load_session(session)


def test_session_with_truth_is_calibrated_and_checked(session, scene):
    data = open_session(load_session(session))
    found = calibrate_session(data, scene.truth)
    assert found.with_truth
    assert found.held_out_after_px.mean < 0.1 * found.held_out_before_px.mean
    row = next(row for row in found.rows if row.landmark == "nose")
    assert row.fraction == pytest.approx((0.0, 0.032, 0.080), abs=1e-3)
    assert row.moved_mm == pytest.approx(1.75e3 * np.hypot(0.01, 0.02), abs=2.0)


def test_truth_of_another_session_is_refused(session, scene):
    elsewhere = replace(
        scene.truth, bone_position_in_world_m=scene.truth.bone_position_in_world_m + 50.0
    )
    with pytest.raises(InputError, match="no keypoints match the people of the truth"):
        calibrate_session(open_session(load_session(session)), elsewhere)


def test_command_writes_offsets_that_solve_reads(session, monkeypatch, capsys):
    out = session / "offsets.toml"
    arguments = ["calibrate", "offsets", str(session), "--truth", str(session / "truth.npz")]
    monkeypatch.setattr("sys.argv", ["fusecap", *arguments, "--out", str(out), "--json"])
    with pytest.raises(SystemExit) as ended:
        main()
    assert ended.value.code == 0
    report = json.loads(capsys.readouterr().out)
    assert report["held_out_after_px"]["mean"] < report["held_out_before_px"]["mean"]
    assert read_offsets(out, "body25").everyone["nose"][2] == pytest.approx(0.08, abs=1e-3)
