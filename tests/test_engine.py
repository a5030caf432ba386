"""The clock-free engine: what goes in decides what comes out, and sources may come and go."""

import re

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from fusecap.batch.detect import ExpectedPeople
from fusecap.batch.solve import SessionInstants
from fusecap.engine.engine import Engine
from fusecap.evaluate import simulated_session
from fusecap.evaluate.demo_scene import demo_scene
from fusecap.pipeline import Pipeline
from fusecap.setup import setup_of
from fusecap.sources.session_data import open_session
from fusecap.sources.session_file import load_session
from fusecap.types import CameraSample, Command, CommandKind, ImuSample, Tick
from live_events import merged, same_bits, setup_for, steps_of
from live_events import samples_of as session_samples
from live_events import ticks_of as session_ticks
from live_scene import (
    Phase,
    capture,
    fastest,
    kept,
    samples_of,
    score,
    simulated_setup,
    standing,
    ticks_of,
)

ALL = (0, 1, 2, 3)
FAST = {"root_m_s": 16.0, "bone_rad_s": 53.0, "joint_m_s": 30.0}
"""Between two instants: the limits of `fusecap.engine.continuity` with their noise, at 60 Hz."""


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    """A second of the demo as a session, its cameras and sensors on the instants of the solve."""
    folder = tmp_path_factory.mktemp("recorded")
    return open_session(
        load_session(simulated_session.write_session(demo_scene(seconds=1.0), folder))
    )


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    """Ten seconds of cameras that are not synchronised; simulation, setup and samples."""
    simulation = capture(10.0)
    setup = simulated_setup(simulation, tmp_path_factory.mktemp("scene"))
    return simulation, setup, samples_of(simulation)


def run(scene, phases=None, commands=(), seconds=None):
    """The steps of a scene whose sources come and go, with commands [(s, Command)] on the way."""
    simulation, setup, samples = scene
    events = merged(kept(samples, phases) if phases else samples, ticks_of(simulation))
    engine = Engine(setup)
    steps, waiting = [], list(commands)
    for event in events:
        step = engine.take(event)
        if step is not None:
            steps.append(step)
            now_s = step.timestamp_ns * 1e-9
            if seconds is not None and now_s >= seconds:
                break
            while waiting and waiting[0][0] <= now_s:
                engine.take(waiting.pop(0)[1])
    return steps, list(engine.notes)


def assert_even(steps, names=("anna", "ben")):
    for name in names:
        speed = fastest(steps, name)
        assert all(getattr(speed, what) < limit for what, limit in FAST.items()), speed
    for step in steps:
        for estimate in step.people.values():
            if estimate is not None:
                assert np.isfinite(estimate.theta).all()
                assert np.isfinite(estimate.bone_position_in_world_m).all()
                assert np.isfinite(estimate.bone_quality).all()


@pytest.mark.slow
def test_recording_fed_live_gives_the_poses_of_the_first_pass(recorded):
    offline = Pipeline(setup_of(recorded.session, recorded.rig, recorded.landmarks))
    instants = SessionInstants(recorded)
    events = merged(session_samples(recorded), session_ticks(recorded))
    steps = list(steps_of(Engine(setup_for(recorded)), events))
    assert len(steps) == len(instants) > 50
    for instant, step in enumerate(steps):
        expected = offline.step(instants.detections(instant), instants.readings(instant))
        for camera in range(4):  # Nothing is interpolated, so nothing may differ.
            ours, theirs = step.detections.people[camera], instants.detections(instant).people
            assert np.array_equal(ours, theirs[camera], equal_nan=True)
        assert [e.name for e in step.step.estimates] == [e.name for e in expected.estimates]
        for ours, theirs in zip(step.step.estimates, expected.estimates, strict=True):
            away = ours.bone_position_in_world_m - theirs.bone_position_in_world_m
            assert np.abs(away).max() < 1e-6
            assert step.people[ours.name] is ours, "sent as solved, to the bit"


def test_replay_gives_the_same_bits_whatever_the_order_of_arrival(scene):
    simulation, setup, samples = scene
    samples = [s for s in samples if s.timestamp_ns < 900_000_000]
    ticks = [t for t in ticks_of(simulation) if t.timestamp_ns < 700_000_000]
    rng = np.random.default_rng(3)
    delays_ns = {id(s): int(rng.uniform(0, 80e6)) for s in samples}
    runs = [
        list(steps_of(Engine(setup), merged(samples, ticks, delay_s=0.2, arrival_ns=arrival)))
        for arrival in (
            lambda s: s.timestamp_ns,
            lambda s: s.timestamp_ns,
            lambda s: s.timestamp_ns + delays_ns[id(s)],
        )
    ]
    assert len(runs[0]) == len(ticks)
    for other in runs[1:]:
        assert all(same_bits(a, b) for a, b in zip(runs[0], other, strict=True))


@pytest.mark.slow
def test_unsynchronised_cameras_and_sensors_are_brought_together(scene):
    steps, notes = run(scene, seconds=3.0)
    assert notes[:2] == ["anna found", "ben found"]
    errors = [
        np.linalg.norm(
            step.people["anna"].bone_position_in_world_m
            - scene[0].truth.bone_position_in_world_m[0, row],
            axis=1,
        ).mean()
        for row, step in enumerate(steps)
        if row >= 30
    ]
    assert np.mean(errors) < 0.03
    assert list(steps[-1].people) == ["anna", "ben"], "the bystander is nobody"


@pytest.mark.slow
def test_sources_go_one_after_the_other_and_return(scene):
    phases = [
        Phase(0.0, ALL, True, "all"),
        Phase(2.0, (0,), True, "one camera and sensors"),
        Phase(4.0, (), True, "sensors"),
        Phase(5.5, (), False, "nothing"),
        Phase(7.5, ALL, True, "all again"),
    ]
    steps, notes = run(scene, phases)
    assert_even(steps)
    assert all(None not in step.people.values() for step in steps[10:])
    full, one, sensors, nothing, back = score(scene[0], steps, phases)
    assert full.error_mm < 30 and one.error_mm < 120 and back.error_mm < 50
    assert sensors.turn_deg < 15, "orientations go on"
    assert min(full.quality, one.quality, sensors.quality) > 0.5
    assert nothing.quality < 0.1 and back.quality == pytest.approx(full.quality, abs=0.1)
    assert sum("lost" in note for note in notes) == sum("returned" in n for n in notes) == 2


@pytest.mark.slow
def test_identities_survive_two_seconds_in_which_no_camera_sees(scene):
    phases = [Phase(0.0, ALL, False, ""), Phase(4.0, (), False, ""), Phase(6.0, ALL, False, "")]
    steps, _ = run(scene, phases)
    assert_even(steps)
    before, after = steps[235].step.estimates, steps[-1].step.estimates
    assert {e.name: e.track_id for e in before} == {e.name: e.track_id for e in after}
    assert score(scene[0], steps, phases)[2].error_mm < 60


@pytest.mark.slow
def test_one_camera_is_enough_to_go_on(scene):
    phases = [Phase(0.0, ALL, False, ""), Phase(2.0, (2,), False, "")]
    steps, notes = run(scene, phases)
    assert_even(steps)
    assert not any("lost" in note for note in notes)
    names = [{e.name for e in step.step.estimates} for step in steps[10:]]
    assert all(some == {"anna", "ben"} for some in names)
    assert score(scene[0], steps, phases)[1].error_mm < 400


@pytest.mark.slow
def test_sensors_begin_alone_where_no_camera_looks(tmp_path):
    simulation = standing(4.0, x_m=0.7)
    setup = simulated_setup(
        simulation, tmp_path, lambda text: re.sub(r"(?m)^start_m.*\n", "", text)
    )
    phases = [Phase(0.0, (), True, ""), Phase(2.6, ALL, True, "")]
    steps, _ = run((simulation, setup, samples_of(simulation)), phases)
    first = next(k for k, step in enumerate(steps) if step.people["anna"] is not None)
    assert 2.0 <= steps[first].timestamp_ns * 1e-9 < 2.1
    assert_even(steps, ["anna"])
    hips_m = steps[first].people["anna"].theta[:3], steps[-1].people["anna"].theta[:3]
    assert hips_m[0][0] == pytest.approx(0.0, abs=0.1) and hips_m[1][0] == pytest.approx(
        0.7, abs=0.1
    )


@pytest.mark.slow
def test_tpose_before_cameras_tells_how_sensors_sit(tmp_path):
    """The session says that she faces +z; the cameras know better."""
    simulation = standing(2.0, facing_rad=0.8)
    setup = simulated_setup(
        simulation, tmp_path, lambda text: re.sub(r"(?m)^bone_from_imu_wxyz.*\n", "", text)
    )
    command = Command(kind=CommandKind.TPOSE, subject="anna")
    before, notes = run((simulation, setup, samples_of(simulation)), commands=[(1.5, command)])
    assert any("T-pose taken by 13 sensors" in note for note in notes)
    assert before[80].readings == {}
    measured = Rotation.from_matrix(before[-1].readings["anna"].bone_rotation_in_world)
    off = measured * Rotation.from_rotvec([0.0, 0.8, 0.0]).inv()
    assert np.degrees(off.magnitude()).max() < 10


@pytest.mark.slow
def test_removed_person_is_not_picked_up_again_until_there_is_room(scene):
    commands = [
        (1.0, Command(kind=CommandKind.REMOVE_SUBJECT, subject="ben")),
        (2.0, Command(kind=CommandKind.ADD_SUBJECT)),
    ]
    steps, notes = run(scene, commands=commands, seconds=3.0)
    assert all(list(step.people) == ["anna"] for step in steps[62:119])
    assert {e.name for e in steps[119].step.estimates} == {"anna"}
    assert list(steps[-1].people) == ["anna", "person1"]
    assert steps[-1].people["person1"] is not None
    assert notes[2:] == ["ben removed", "room for one more person", "person1 found"]


def test_subject_is_found_anew_where_it_stands(scene):
    commands = [(1.0, Command(kind=CommandKind.REINITIALISE, subject="anna"))]
    steps, notes = run(scene, commands=commands, seconds=2.0)
    assert "anna to be found anew" in notes
    assert_even(steps)
    before, after = ({e.name: e.track_id for e in steps[k].step.estimates} for k in (58, -1))
    assert before["anna"] != after["anna"] and before["ben"] == after["ben"]


def test_who_is_not_measured_for_a_second_is_said_to_be_lost(scene):
    phases = [Phase(0.0, ALL, True, ""), Phase(0.5, (), False, "")]
    for seconds, lost in ((1.4, 0), (1.8, 2)):
        _, notes = run(scene, phases, seconds=seconds)
        assert sum("lost: no camera sees them" in note for note in notes) == lost


def test_commands_that_cannot_be_obeyed_are_noted(scene):
    _, setup, _ = scene
    engine = Engine(setup)
    for kind in (CommandKind.REMOVE_SUBJECT, CommandKind.REINITIALISE, CommandKind.TPOSE):
        engine.take(Command(kind=kind, subject="zoe"))
    engine.take(Command(kind=CommandKind.ADD_SUBJECT, subject="anna"))
    engine.take(Command(kind=CommandKind.REMOVE_SUBJECT))
    notes = list(engine.notes)
    assert len(notes) == 5 and all("zoe" in note for note in notes[:3])
    assert "somebody is called 'anna'" in notes[3] and "say whom" in notes[4]


def test_instant_is_ready_once_every_fresh_source_has_passed_it(scene):
    _, setup, samples = scene
    engine = Engine(setup)
    assert not engine.ready(0)
    for sample in samples:
        if sample.timestamp_ns > 1_000_000_000:
            break
        engine.take(sample)
    assert engine.ready(900_000_000) and not engine.ready(1_000_000_001)
    coming = [s for s in samples if 1_000_000_000 < s.timestamp_ns < 1_100_000_000]
    late = [s for s in coming if isinstance(s, CameraSample) and s.camera == 2]
    for sample in coming:
        if not any(sample is one for one in late):
            engine.take(sample)
    assert not engine.ready(1_000_000_001), "one of the cameras has not"
    engine.take(late[0])
    assert engine.ready(1_000_000_001)


def test_people_are_expected_where_the_detector_will_find_them(recorded):
    samples, engine = session_samples(recorded), Engine(setup_for(recorded))
    steps = list(steps_of(engine, merged(samples, session_ticks(recorded)[:50])))
    assert len(steps) == 50
    last = steps[-1]
    expected = engine.expected(last.timestamp_ns)
    for camera, people in enumerate(last.detections.people):
        seen = [u.person[camera] for u in last.step.updates if u.person[camera] >= 0]
        for person in people[seen]:
            away = np.nanmean(
                np.linalg.norm(expected[camera][:, :, :2] - person[None, :, :2], axis=2), axis=1
            )
            assert np.nanmin(away) < 20, "pixels"
        assert len(expected[camera]) <= 2, "a bystander is not looked for once all places are taken"
    offline = ExpectedPeople(
        setup_of(recorded.session, recorded.rig, recorded.landmarks),
        periods_s=[1 / 60] * 4,
        landmark_count=last.detections.people[0].shape[1],
    )
    assert [len(some) for some in offline.at(0)] == [0, 0, 0, 0]


def test_samples_that_come_twice_change_nothing(scene):
    simulation, setup, samples = scene
    ticks = [t for t in ticks_of(simulation) if t.timestamp_ns < 500_000_000]
    samples = [s for s in samples if s.timestamp_ns < 500_000_000]
    once, twice = (
        list(steps_of(Engine(setup), merged(some, ticks)))
        for some in (samples, [s for sample in samples for s in (sample, sample)])
    )
    assert once[-1].people["anna"] is not None
    assert all(same_bits(a, b) for a, b in zip(once, twice, strict=True))


def test_tick_that_does_not_go_forward_gives_nothing(scene):
    engine = Engine(scene[1])
    assert engine.take(Tick(timestamp_ns=10)) is not None
    assert engine.take(Tick(timestamp_ns=10)) is None and engine.take(Tick(timestamp_ns=5)) is None


ACTIONS = st.lists(st.tuples(st.integers(0, 9), st.integers(0, 2**31)), min_size=30, max_size=120)


@settings(max_examples=15, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(ACTIONS)
def test_no_order_of_events_breaks_it(scene, actions):
    """Samples lost, late, double, of garbage, from the past and the future; ticks and commands."""
    _, setup, samples = scene
    engine = Engine(setup)
    now_ns, at = 0, 0
    for kind, seed in actions:
        rng = np.random.default_rng(seed)
        if kind < 4:
            for sample in samples[at : at + 60]:
                if rng.random() < 0.9:
                    engine.take(sample)
            at += 60
            now_ns = samples[min(at, len(samples) - 1)].timestamp_ns
        elif kind < 7:
            step = engine.take(Tick(timestamp_ns=now_ns - int(rng.integers(0, 50_000_000))))
            for estimate in () if step is None else step.people.values():
                if estimate is not None:
                    assert np.isfinite(estimate.theta).all()
                    assert np.isfinite(estimate.bone_position_in_world_m).all()
                    assert ((estimate.bone_quality >= 0) & (estimate.bone_quality <= 1)).all()
        elif kind == 7:
            people = rng.normal(size=(int(rng.integers(0, 4)), 25, 3)) * 10.0 ** rng.integers(-3, 9)
            people[rng.random(people.shape) < 0.2] = [np.nan, np.inf, -np.inf][int(seed % 3)]
            when_ns = now_ns + int(rng.normal() * 10.0 ** rng.integers(6, 12))
            camera = int(rng.integers(-1, 6))
            engine.take(CameraSample(camera=camera, timestamp_ns=when_ns, people=people))
        elif kind == 8:
            engine.take(
                ImuSample(
                    subject="anna",
                    bone=("hips", "head", "tail")[seed % 3],
                    timestamp_ns=now_ns + int(rng.normal() * 10.0 ** rng.integers(6, 12)),
                    orientation_wxyz=rng.normal(size=4) * (np.nan if seed % 5 == 0 else 1.0),
                    accel_m_s2=rng.normal(size=3) * 10.0 ** rng.integers(-3, 200),
                )
            )
        else:
            name = ("", "anna", "ben", "person1", "zoe")[int(rng.integers(5))]
            engine.take(Command(kind=list(CommandKind)[int(rng.integers(4))], subject=name))
