"""A right person in a wrong pose is found anew, counted and told. Built input, simulated."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from fusecap.body.skeleton import PAPER21
from fusecap.evaluate.demo_scene import demo_scene
from fusecap.evaluate.score import score_take
from fusecap.evaluate.simulated_solve import setup_of_simulation, solve_simulation
from fusecap.geometry.quaternions import from_wxyz
from fusecap.pipeline import Pipeline, make_estimator
from fusecap.solve import watchdog
from fusecap.solve.estimator import Estimator
from fusecap.solve.watchdog import FITS, POOR, Watchdog
from fusecap.types import Observation

FRAME_NS = 16_666_667
LIMBS = np.array([name.endswith(("arm", "thigh", "shank")) for name in PAPER21.bone_names])


@pytest.fixture(scope="module")
def simulation():
    scene = demo_scene(seconds=1.0)
    return scene.subset(cameras=[scene.rig.names[k] for k in (0, 2)], imu_bones=())


def turned_about(theta):
    turned = theta.copy()
    turned[3:6] = (
        Rotation.from_rotvec([0, np.pi, 0]) * Rotation.from_rotvec(theta[3:6])
    ).as_rotvec()
    return turned


def turned_once(monkeypatch, simulation, frame):
    """From a frame on everybody is posed the wrong way round, as after an occlusion."""
    follow, done = Estimator.follow, set()
    at_ns = simulation.detections[frame].timestamp_ns

    def spoiled(self, track_id, observation, *rest):
        name, known = self.model.name, self._solution
        if observation.timestamp_ns == at_ns and known is not None and name not in done:
            done.add(name)
            theta = turned_about(known.theta)
            position, rotation = self.solver.posed(theta)
            self._solution = replace(
                known, theta=theta, position_in_world_m=position, rotation_in_world=rotation
            )
            self._begin_motion()
        return follow(self, track_id, observation, *rest)

    monkeypatch.setattr(Estimator, "follow", spoiled)


def worst_limb_deg(simulation):
    """Of the first subject's worst limb [deg], its estimator, and when poses were replaced."""
    pipeline = Pipeline(setup_of_simulation(simulation))
    name = simulation.subjects[0].name
    errors, replaced = [], []
    for t, detections in enumerate(simulation.detections):
        step = pipeline.step(detections, {})
        replaced += [(t, step.found_anew[name])] if name in step.found_anew else []
        for estimate in step.estimates:
            if estimate.name == name:
                true = from_wxyz(simulation.truth.bone_rotation_in_world_wxyz[0, t])
                ours = Rotation.from_matrix(estimate.bone_rotation_in_world)
                errors.append(
                    np.degrees((ours.inv() * true).magnitude()).max(initial=0.0, where=LIMBS)
                )
    return np.array(errors), pipeline.estimator(name), replaced


def test_somebody_turned_about_is_found_anew_within_half_a_second(simulation, monkeypatch):
    turned_once(monkeypatch, simulation, 20)
    errors, found, replaced = worst_limb_deg(simulation)
    assert found.found_anew == len(replaced) == 1
    at, since_ns = replaced[0]
    assert (simulation.detections[at].timestamp_ns - since_ns) * 1e-9 < 0.6
    assert errors[-5:].mean() < 25.0
    monkeypatch.setattr(watchdog, "POOR", np.inf)
    turned_once(monkeypatch, simulation, 20)
    without, found, _ = worst_limb_deg(simulation)
    assert found.found_anew == 0 and without[-5:].mean() > 45.0


def test_right_poses_are_let_be(simulation):
    _, found, replaced = worst_limb_deg(simulation)
    assert found.found_anew == 0 and not replaced


def test_a_take_is_right_from_where_the_pose_went_wrong_and_says_so(simulation, monkeypatch):
    right = score_take(solve_simulation(simulation).take, simulation.truth)
    turned_once(monkeypatch, simulation, 20)
    solved = solve_simulation(simulation)
    score = score_take(solved.take, simulation.truth)
    assert score.position_error_mm.mean < 1.1 * right.position_error_mm.mean
    assert score.orientation_error_deg.mean < 1.1 * right.orientation_error_deg.mean
    assert sum(told["found_anew"] for told in solved.report.subjects.values()) >= 1
    assert any("found anew, at 0." in note for note in solved.report.notes)


def test_what_does_not_fit_better_replaces_nothing_and_is_tried_ever_more_rarely():
    dog, trials = Watchdog(), []
    for t in range(1200):
        if dog.doubts(2.0 * POOR * 25, 25, t * FRAME_NS):
            trials.append(t)
            assert dog.tried(False, t * FRAME_NS) is None
    apart = np.diff(trials) / 60.0
    assert np.allclose(apart[:5], [0.25, 0.5, 1.0, 2.0, 4.0], atol=0.05)
    assert apart.max() < 4.1 and 0 < FITS < 1


def test_a_moment_of_bad_keypoints_and_none_at_all_is_no_doubt():
    dog = Watchdog()
    costs = [(0.015, 25)] * 60 + [(9.0, 25)] + [(0.015, 25)] * 60 + [(5.0, 0)] * 60
    assert not any(
        dog.doubts(cost * max(seen, 1), seen, t * FRAME_NS) for t, (cost, seen) in enumerate(costs)
    )


def test_one_cost_that_is_no_number_blinds_nobody():
    dog = Watchdog()
    costs = [(0.015, 25)] * 60 + [(np.nan, 25)] + [(0.015, 25)] * 60
    assert not any(
        dog.doubts(cost * seen, seen, t * FRAME_NS) for t, (cost, seen) in enumerate(costs)
    )
    assert any(dog.doubts(4.0 * POOR * 25, 25, t * FRAME_NS) for t in range(121, 181))


def test_a_trial_comes_as_soon_before_time_zero_as_after_and_is_told_from_there():
    def trials(start_ns):
        dog, found = Watchdog(), []
        for t in range(60):
            if dog.doubts((4.0 if t > 30 else 0.1) * POOR * 25, 25, start_ns + t * FRAME_NS):
                found.append((t, dog.tried(True, start_ns + t * FRAME_NS) - start_ns))
        return found

    assert trials(-(10**12)) == trials(-30 * FRAME_NS) == trials(-31 * FRAME_NS) == trials(10**12)
    assert trials(0)


@pytest.mark.parametrize("off_px", [14.0, 20.0])
def test_a_pose_that_fits_badly_is_not_replaced_by_itself(off_px):
    """As with a bad calibration: every keypoint lies somewhere else, always by the same."""
    simulation = demo_scene(seconds=1.0)
    simulation = simulation.subset(cameras=simulation.rig.names[:1], imu_bones=())
    setup = setup_of_simulation(simulation)
    estimator = make_estimator(setup, setup.subjects[0])
    off = np.random.default_rng(3).normal(size=(1, 25, 2))
    off *= off_px / np.linalg.norm(off, axis=2, keepdims=True)
    costs = []
    for t, detections in enumerate(simulation.detections):
        row = int(np.flatnonzero(simulation.detected_person[t][0] == 0)[0])
        keypoints = detections.people[0][row][None].copy()
        keypoints[..., :2] += off
        seen = Observation(timestamp_ns=detections.timestamp_ns, keypoints=keypoints)
        estimate = estimator.follow(0, seen)
        costs.append(estimate.cost / np.count_nonzero(keypoints[:, :, 2]))
    assert np.mean(costs[20:]) > POOR
    assert estimator.found_anew == 0
