"""One person over time: when the past counts and when it does not."""

import numpy as np
import pytest

from fusecap.body.prior import load_prior
from fusecap.body.skeleton import PAPER21
from fusecap.evaluate.demo_scene import demo_scene
from fusecap.evaluate.simulated_solve import setup_of_simulation
from fusecap.geometry.triangulation import triangulate
from fusecap.pipeline import make_estimator
from fusecap.solve.estimator import Estimator, SubjectModel
from fusecap.solve.options import SolverOptions
from fusecap.types import ImuReading, Observation

LATER_NS = 10**12


@pytest.fixture(scope="module")
def simulation():
    return demo_scene(seconds=0.5)


def estimator(simulation, **options):
    person = simulation.subjects[0]
    return Estimator(
        SubjectModel(name=person.name, shape=person.shape),
        rig=simulation.rig,
        landmarks=simulation.landmark_set,
        prior=load_prior(PAPER21),
        options=SolverOptions(**options),
    )


def follow(estimator, simulation, instant, at_ns, cameras=slice(None)):
    """The pose from what was seen at an instant, as if it had been seen at `at_ns`."""
    keypoints = np.zeros((len(simulation.rig), 25, 3))
    for camera, whose in enumerate(simulation.detected_person[instant]):
        for person in np.flatnonzero(whose == 0):
            keypoints[camera] = simulation.detections[instant].people[camera][person]
    kept = np.zeros_like(keypoints)
    kept[cameras] = keypoints[cameras]
    keypoints = kept
    points, _ = triangulate(simulation.rig, keypoints)
    return estimator.follow(0, Observation(timestamp_ns=at_ns, keypoints=keypoints), points)


def seen_before(simulation):
    """An estimator that has followed its person for a moment, until `LATER_NS`."""
    known = estimator(simulation)
    for instant in range(6):
        follow(known, simulation, instant, LATER_NS - (5 - instant) * 16_666_667)
    return known


def test_after_a_second_away_nothing_before_counts(simulation):
    back_ns = LATER_NS + 1_000_000_001
    returned, fresh = seen_before(simulation), estimator(simulation)
    for instant, at_ns in ((25, back_ns), (26, back_ns + 16_666_667)):
        ours = follow(returned, simulation, instant, at_ns)
        theirs = follow(fresh, simulation, instant, at_ns)
        assert ours.theta.tobytes() == theirs.theta.tobytes()
        ahead_ns = at_ns + 50_000_000
        assert np.array_equal(returned.predict(ahead_ns), fresh.predict(ahead_ns))


def test_up_to_a_second_away_the_last_pose_is_where_the_solve_starts(simulation):
    back_ns = LATER_NS + 1_000_000_000
    returned, fresh = seen_before(simulation), estimator(simulation)
    ours = follow(returned, simulation, 25, back_ns)
    theirs = follow(fresh, simulation, 25, back_ns)
    assert ours.theta.tobytes() != theirs.theta.tobytes()
    assert not np.array_equal(returned.predict(back_ns + 50_000_000), fresh.predict(back_ns))


@pytest.mark.parametrize(("cameras", "alone"), [(2, False), (3, True)])
def test_poses_that_few_cameras_see_are_not_found_alone_for_a_take(simulation, cameras, alone):
    first_pass = estimator(simulation, seeding=True, window=4)
    instants = estimator(simulation, window=1)
    for instant in range(6):
        at_ns = LATER_NS + instant * 16_666_667
        ours, theirs = (
            follow(one, simulation, instant, at_ns, slice(cameras))
            for one in (first_pass, instants)
        )
    assert np.array_equal(ours.theta, theirs.theta) == alone


@pytest.mark.parametrize("tells", [True, False])
def test_a_reading_in_which_no_sensor_told_measures_nothing(simulation, tells):
    setup = setup_of_simulation(simulation, options=SolverOptions(ahead=4))
    known = make_estimator(setup, setup.subjects[0])
    sensors = len(known.model.sites.bone)
    assert sensors
    for instant in range(6):
        follow(known, simulation, instant, LATER_NS + instant * 16_666_667)
    turns = np.tile(np.eye(3) if tells else np.full((3, 3), np.nan), (sensors, 1, 1))
    unseen = np.zeros((len(simulation.rig), 25, 3))
    silent = ImuReading(bone_rotation_in_world=turns, accel_in_world_m_s2=np.zeros((sensors, 3)))
    later = Observation(timestamp_ns=LATER_NS + 10**8, keypoints=unseen, imu=silent)
    assert known.ahead(later).measured == tells
    assert known.update(later).measured == tells
