"""What a live run sends: poses as solved, as they have settled, or newest, ahead of pictures."""

from itertools import pairwise

import numpy as np
import pytest

from fusecap.engine.engine import Engine
from fusecap.errors import InputError, SessionError
from fusecap.pipeline import Step
from fusecap.types import CameraSample, ImuReading, Observation, Tick
from live_events import same_bits, steps_of
from live_scene import Phase, capture, fastest, samples_of, score, simulated_setup, ticks_of

SECONDS = 3.0
FAST = {"root_m_s": 16.0, "bone_rad_s": 53.0, "joint_m_s": 30.0}
"""Between two instants, as in test_engine.py."""
PICTURES_S, SENSORS_S = 0.06, 0.005
"""From exposure to arrival."""
WHOLE = [Phase(1.0, (0, 1, 2, 3), True, "all")]


@pytest.fixture(scope="module")
def simulation():
    return capture(SECONDS)


def setup_with(simulation, folder, live):
    return simulated_setup(simulation, folder, lambda text: f"{text}\n[live]\n{live}\n")


def events_of(simulation, ahead=True):
    """As they come: pictures late, sensors soon, and an instant solved when pictures are there."""
    due = []
    for sample in samples_of(simulation):
        late_s = PICTURES_S if isinstance(sample, CameraSample) else SENSORS_S
        due.append((sample.timestamp_ns + round(late_s * 1e9), 0, sample))
    for tick in ticks_of(simulation):
        due.append((tick.timestamp_ns + round(1.5 * PICTURES_S * 1e9), 1, tick))
        if ahead:
            soon = Tick(timestamp_ns=tick.timestamp_ns, ahead=True)
            due.append((tick.timestamp_ns + 20_000_000, 2, soon))
    return [event for *_, event in sorted(due, key=lambda item: item[:2])]


def run(simulation, folder, live, ahead=False):
    engine = Engine(setup_with(simulation, folder, live))
    return engine, list(steps_of(engine, events_of(simulation, ahead)))


@pytest.mark.slow
def test_poses_ahead_of_pictures_are_nearly_as_good_and_never_jump(simulation, tmp_path):
    _, solved = run(simulation, tmp_path / "solved", "hold_s = 10.0")
    _, ahead = run(simulation, tmp_path / "ahead", 'poses = "ahead"', ahead=True)
    by_time = {step.timestamp_ns: step for step in ahead}
    newest = [by_time.get(step.timestamp_ns, ahead[0]) for step in solved]
    late_ns = round(1.5 * PICTURES_S * 1e9) - 20_000_000
    shown = [solved[max(row - round(late_ns * 60e-9), 0)] for row in range(len(solved))]
    exact, early, held = (score(simulation, some, WHOLE)[0] for some in (solved, newest, shown))
    assert early.sent_share == 1.0
    assert early.error_mm < exact.error_mm + 8.0
    assert early.error_mm < 0.8 * held.error_mm, "better than the last that pictures reached"
    for name in ("anna", "ben"):
        speed = fastest(ahead, name)
        assert all(getattr(speed, what) < limit for what, limit in FAST.items()), speed


@pytest.mark.slow
def test_looking_ahead_changes_nothing_that_is_solved(simulation, tmp_path):
    plain, _ = run(simulation, tmp_path / "plain", "hold_s = 10.0")
    looking, _ = run(simulation, tmp_path / "ahead", 'poses = "ahead"', ahead=True)
    for ours, theirs in zip(plain._step.estimates, looking._step.estimates, strict=True):
        assert np.array_equal(ours.theta, theirs.theta)
        assert np.array_equal(ours.bone_sigma_deg, theirs.bone_sigma_deg)


@pytest.mark.slow
def test_events_decide_poses_ahead_to_the_bit(simulation, tmp_path):
    setup = setup_with(simulation, tmp_path, 'poses = "ahead"')
    events = events_of(simulation)[:4000]
    first, second = (list(steps_of(Engine(setup), events)) for _ in range(2))
    assert len(first) == len(second) > 30
    assert all(same_bits(a, b) for a, b in zip(first, second, strict=True))


@pytest.mark.slow
def test_settled_poses_are_smoother_and_carry_their_own_time(simulation, tmp_path):
    _, solved = run(simulation, tmp_path / "solved", "hold_s = 10.0")
    _, settled = run(simulation, tmp_path / "late", 'poses = "settled"\nsettle_s = 0.1')
    times = [step.timestamp_ns for step in settled]
    assert all(b > a for a, b in pairwise(times))
    last = settled[-1]
    assert last.timestamp_ns == solved[-7].timestamp_ns, "six instants at 60 Hz are 0.1 s"
    assert all(one.timestamp_ns == last.timestamp_ns for one in last.people.values())
    by_time = {step.timestamp_ns: step for step in settled}
    both = [step for step in solved if step.timestamp_ns in by_time][60:]

    def roughness(steps):
        wrist = np.array([s.people["anna"].bone_position_in_world_m[-1] for s in steps])
        return np.abs(np.diff(wrist, n=3, axis=0)).mean()

    assert roughness([by_time[s.timestamp_ns] for s in both]) < 0.7 * roughness(both)


def test_where_pictures_come_as_soon_as_sensors_the_solved_pose_is_sent(simulation, tmp_path):
    engine = Engine(setup_with(simulation, tmp_path, 'poses = "ahead"'))
    sent = 0
    ticks = ticks_of(simulation)[:30]
    samples = samples_of(simulation)
    for tick in ticks:
        while samples[0].timestamp_ns < tick.timestamp_ns + 50_000_000:
            engine.take(samples.pop(0))
        assert engine.take(tick) is None
        step = engine.take(Tick(timestamp_ns=tick.timestamp_ns, ahead=True))
        sent += step is not None and step.timestamp_ns == tick.timestamp_ns
        assert engine.take(Tick(timestamp_ns=tick.timestamp_ns, ahead=True)) is None, "once"
    assert sent == len(ticks)


@pytest.mark.slow
def test_settled_poses_are_held_while_nothing_measures(simulation, tmp_path):
    engine = Engine(setup_with(simulation, tmp_path, 'poses = "settled"'))
    silent = range(1_200_000_000, 1_800_000_000)
    events = [
        e
        for e in events_of(simulation, ahead=False)
        if isinstance(e, Tick) or e.timestamp_ns not in silent
    ]
    steps = list(steps_of(engine, events))
    apart = np.diff([step.timestamp_ns for step in steps])
    assert apart.max() < 18_000_000, "sent at every instant"
    assert all(step.people["anna"] is not None for step in steps[40:])


@pytest.mark.slow
def test_nonsense_ahead_is_refused_and_changes_nothing(simulation, tmp_path):
    setup = setup_with(simulation, tmp_path, 'poses = "ahead"')
    plain, tried = Engine(setup), Engine(setup)
    for event in events_of(simulation, ahead=False)[:3000]:
        plain.take(event)
        tried.take(event)
        for estimate in tried._step.estimates if isinstance(event, Tick) else ():
            estimator = tried._pipeline.estimator(estimate.name)
            keypoints = np.zeros((4, 25, 3))
            reading = ImuReading(
                bone_rotation_in_world=np.zeros((2, 3, 3)), accel_in_world_m_s2=np.zeros((2, 3))
            )
            later = event.timestamp_ns + 16_666_667
            for bad in (
                Observation(timestamp_ns=later, keypoints=keypoints, imu=reading),
                Observation(timestamp_ns=later, keypoints=keypoints[:2]),
                Observation(timestamp_ns=event.timestamp_ns, keypoints=keypoints),
            ):
                with pytest.raises(InputError):
                    estimator.ahead(bad)
    for ours, theirs in zip(plain._step.estimates, tried._step.estimates, strict=True):
        assert np.array_equal(ours.theta, theirs.theta)


def test_a_tick_ahead_before_anything_was_solved_sends_nothing(simulation, tmp_path):
    engine = Engine(setup_with(simulation, tmp_path, 'poses = "ahead"'))
    assert engine.take(Tick(timestamp_ns=1_000_000_000, ahead=True)) is None


@pytest.mark.parametrize("poses", ["ahead", "settled"])
def test_instants_alone_can_only_be_sent_solved(simulation, tmp_path, poses):
    setup = setup_with(simulation, tmp_path, f'poses = "{poses}"\n[estimator]\nwindow = 1')
    with pytest.raises(SessionError, match="solved together"):
        Engine(setup)


class PipelineOfNobody:
    """Replaces a pose at every instant that is solved."""

    def step(self, detections, readings):
        return Step(updates=(), estimates=(), found_anew={"anna": detections.timestamp_ns})

    def ahead(self, now_ns, readings):
        return []


def test_every_pose_that_is_found_anew_is_told_once(simulation, tmp_path):
    engine = Engine(setup_with(simulation, tmp_path, 'poses = "ahead"'))
    engine._pipeline = PipelineOfNobody()
    times = [(1, False), (2, False), (3, True), (4, True), (3, False), (5, True)]
    events = [Tick(timestamp_ns=10**8 * instant, ahead=ahead) for instant, ahead in times]
    assert [dict(step.found_anew) for step in steps_of(engine, events)] == [
        {"anna": 2},
        {},
        {"anna": 1},
    ]
