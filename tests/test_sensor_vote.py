"""Sensors say who is who: at the start, after an exchange, and never without a margin."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
import pytest

from fusecap.associate.admission import Admission
from fusecap.associate.anatomy import Anatomy
from fusecap.associate.options import TrackerOptions
from fusecap.associate.renaming import contradicted, pair_anew
from fusecap.associate.sensor_vote import FITS, SensorVote
from fusecap.associate.subjects import Cast, Subject
from fusecap.associate.track import SURELY_APART, Track
from fusecap.batch.solve import solve_instants
from fusecap.body.landmarks import landmark_set_named
from fusecap.evaluate.imu_noise import IMUS_6
from fusecap.evaluate.simulated_solve import setup_of_simulation
from fusecap.evaluate.simulator import Simulation
from fusecap.pipeline import Pipeline
from fusecap.solve.options import SolverOptions
from fusecap.types import ImuReading
from live_scene import capture

RATE_HZ = 60


@pytest.fixture(scope="module")
def simulation() -> Simulation:
    """Two subjects with 13 sensors each, and a bystander."""
    return capture(5.0, synchronous=True)


def pipeline_of(simulation: Simulation, *, backwards: bool = False) -> Pipeline:
    """Without start positions, subjects in either order."""
    setup = setup_of_simulation(simulation, options=SolverOptions(window=1))
    subjects = [replace(model, start_m=None) for model in setup.subjects]
    return Pipeline(replace(setup, subjects=tuple(subjects[::-1] if backwards else subjects)))


def wrong_names(simulation, pipeline, instants, change=lambda instant, readings: readings):
    """Instants and names of people who were solved where somebody else stands; notes."""
    wrong, notes, seen = [], [], {}
    truth = simulation.truth
    for instant in instants:
        readings = {name: rows[instant] for name, rows in simulation.imu_readings.items()}
        step = pipeline.step(simulation.detections[instant], change(instant, readings))
        notes += step.notes
        for estimate in step.estimates:
            true_m = truth.bone_position_in_world_m[:, instant, 0]
            away_m = np.linalg.norm(true_m - estimate.bone_position_in_world_m[0], axis=1)
            seen.setdefault(estimate.name, instant)
            if truth.subject_names[int(np.argmin(away_m))] != estimate.name or away_m.min() > 0.3:
                wrong.append((instant, estimate.name))
    return wrong, notes, seen


@pytest.mark.slow
@pytest.mark.parametrize("backwards", [False, True])
@pytest.mark.parametrize("bones", [None, IMUS_6])
def test_sensors_find_their_wearers_within_a_second_of_being_seen(simulation, backwards, bones):
    worn = simulation if bones is None else simulation.subset(imu_bones=bones)
    pipeline = pipeline_of(worn, backwards=backwards)
    wrong, notes, seen = wrong_names(worn, pipeline, range(90))
    assert not wrong and not notes
    assert set(seen) == {"anna", "ben"} and max(seen.values()) <= RATE_HZ


@pytest.mark.slow
def test_people_who_exchange_their_sensors_exchange_their_names_with_a_note(simulation):
    def change(instant, readings):
        if instant < 120:
            return readings
        return {"anna": readings["ben"], "ben": readings["anna"]}

    pipeline = pipeline_of(simulation)
    wrong, notes, _ = wrong_names(simulation, pipeline, range(240), change)
    exchanged = {instant for instant, _ in wrong}
    assert set(range(120 + RATE_HZ, 240)) <= exchanged, "within a second anna is ben"
    assert not exchanged & set(range(120))
    assert len(notes) == 2 and all("sensors say so" in note for note in notes)


class LateSensors:
    """A simulation whose sensors speak from an instant on, as recorded measurements."""

    def __init__(self, simulation: Simulation, first: int) -> None:
        self._simulation, self._first = simulation, first

    def __len__(self) -> int:
        return 200

    def detections(self, instant):
        return self._simulation.detections[instant]

    def readings(self, instant):
        if instant < self._first:
            return {}
        return {name: rows[instant] for name, rows in self._simulation.imu_readings.items()}


@pytest.mark.slow
@pytest.mark.parametrize("backwards", [False, True])
def test_a_take_is_right_from_the_start_though_sensors_told_late(simulation, backwards):
    setup = setup_of_simulation(simulation, options=SolverOptions(window=1))
    subjects = [replace(model, start_m=None) for model in setup.subjects]
    setup = replace(setup, subjects=tuple(subjects[::-1] if backwards else subjects))
    solved = solve_instants(setup, LateSensors(simulation, 120))
    take, truth = solved.take, simulation.truth
    for row, name in enumerate(take.subject_names):
        true_m = truth.bone_position_in_world_m[truth.subject_names.index(name), :200, 0]
        away_m = np.linalg.norm(take.bone_position_in_world_m[row, :, 0] - true_m, axis=1)
        assert take.tracked[row].mean() > 0.95
        assert np.nanmax(away_m) < 0.3


@pytest.mark.slow
def test_a_take_is_right_from_the_start_though_a_bystander_was_followed(simulation):
    setup = setup_of_simulation(simulation)
    subjects = tuple(replace(m, start_m=None) for m in setup.subjects if m.name == "anna")
    solved = solve_instants(replace(setup, subjects=subjects), LateSensors(simulation, 120))
    take, truth = solved.take, simulation.truth
    true_m = truth.bone_position_in_world_m[truth.subject_names.index("anna"), :200, 0]
    away_m = np.linalg.norm(take.bone_position_in_world_m[0, :, 0] - true_m, axis=1)
    assert any("somebody else than was followed" in note for note in solved.report.notes)
    assert take.tracked[0].mean() > 0.95
    assert np.nanmax(away_m) < 0.1


@pytest.mark.slow
def test_sensors_that_nobody_wears_keep_nobody_out_for_ever(simulation):
    rng = np.random.default_rng(0)

    def change(instant, readings):
        turns = np.linalg.qr(rng.standard_normal((13, 3, 3)))[0]
        nonsense = ImuReading(bone_rotation_in_world=turns, accel_in_world_m_s2=np.zeros((13, 3)))
        return dict.fromkeys(readings, nonsense)

    _, notes, seen = wrong_names(simulation, pipeline_of(simulation), range(300), change)
    assert set(seen) == {"anna", "ben"}
    assert sorted(note.split(":")[0] for note in notes) == ["anna", "ben"]
    assert all("sensors and cameras contradict each other" in note for note in notes)


def test_two_who_do_the_same_are_not_told_apart():
    landmarks = landmark_set_named("body25")
    bones = ("hips", "left_forearm", "right_forearm", "left_shank")
    vote = SensorVote(landmarks, {"anna": bones, "ben": bones})
    from fusecap.associate.sensor_vote import _at_rest

    standing = _at_rest(landmarks)
    tracks = [Track(n, standing + [n, 0, 0], standing[0], np.zeros(1), 0) for n in range(2)]
    still = ImuReading(
        bone_rotation_in_world=np.tile(np.eye(3), (4, 1, 1)), accel_in_world_m_s2=np.zeros((4, 3))
    )
    for _ in range(60):
        vote.hear(
            tracks,
            np.stack([t.landmarks for t in tracks]),
            dict.fromkeys(("anna", "ben"), still),
            1 / 60,
        )
    misfits = [vote.misfit(track, name, 0.5) for track in tracks for name in ("anna", "ben")]
    np.testing.assert_allclose(misfits, 0.0, atol=0.05)
    assert max(misfits) < FITS
    assert np.isnan(vote.misfit(tracks[0], "anna", 2.0)), "not heard for so long"


def test_too_few_sensors_have_no_vote():
    vote = SensorVote(landmark_set_named("body25"), {"anna": ("hips", "left_hand", "head")})
    vote.hear([], np.zeros((0, 25, 3)), {}, 0.0)
    assert not vote.heard


class ToldVote(SensorVote):
    """What sensors say, by track and wearer."""

    def __init__(self, told):
        super().__init__(landmark_set_named("body25"), {})
        self.told = told
        self.heard = frozenset(name for _, name in told)

    def misfit(self, track, name, least_s):
        return self.told.get((track.track_id, name), np.nan)


def cast_of(simulation, *names, **options):
    """A cast, and who admits to it."""
    anatomy, options = Anatomy(simulation.landmark_set), TrackerOptions(**options)
    subjects = [Subject(name=name) for name in names]
    cast = Cast(subjects, simulation.rig, anatomy, options, itertools.count(100))
    return cast, Admission(cast, simulation.rig, anatomy, options)


def standing_at(simulation, number, x_m, born_s, seen_s):
    landmarks = np.tile([x_m, 1.0, 0.0], (25, 1))
    anatomy = Anatomy(simulation.landmark_set)
    lengths = np.full(anatomy.limb_count, 0.4)
    track = Track(number, landmarks, landmarks[0], lengths, round(born_s * 1e9))
    track.frames = track.strong_frames = 100
    track.seen_ns = track.triangulated_ns = track.time_ns = round(seen_s * 1e9)
    return track


@pytest.mark.parametrize("apart", [True, False])
def test_who_walked_beside_a_wearer_does_not_become_the_wearer_who_leaves(simulation, apart):
    cast, door = cast_of(simulation, "x", max_subjects=1)
    wearer = standing_at(simulation, 1, 0.0, 0.0, 0.0)
    other = standing_at(simulation, 2, 2.0, 0.0, 0.0)
    door.admit([wearer], 0, ToldVote({(1, "x"): 0.05}))
    assert cast.ids() == {1}
    if apart:
        wearer.beside[other] = other.beside[wearer] = SURELY_APART
    minute_ns, now_ns = 60 * 10**9, 61 * 10**9
    wearer.seen_ns = wearer.triangulated_ns = minute_ns
    other.seen_ns = other.triangulated_ns = now_ns
    cast.forget([other], now_ns)
    door.admit([other], now_ns, ToldVote({(2, "x"): 0.05}))
    assert cast.returned == ({} if apart else {2: (1, minute_ns)})


def test_whom_sensors_did_not_fit_is_no_evidence_against_who_wears_them(simulation):
    cast, door = cast_of(simulation, "x", max_subjects=1)
    mistaken = standing_at(simulation, 1, 0.0, 0.0, 0.0)
    wearer = standing_at(simulation, 2, 2.0, 0.0, 1.0)
    door.admit([mistaken], 0, ToldVote({(1, "x"): 0.05}))
    contradicted(cast, ToldVote({(1, "x"): 0.9}), 0, TrackerOptions())
    mistaken.beside[wearer] = wearer.beside[mistaken] = SURELY_APART
    cast.forget([wearer], 10**9)
    door.admit([wearer], 10**9, ToldVote({(2, "x"): 0.05}))
    assert cast.returned == {2: (1, 0)}


@pytest.mark.parametrize(("misfit", "admitted_as"), [(0.9, "y"), (np.nan, None), (0.05, "x")])
def test_a_missing_wearer_holds_back_those_who_may_be_it_and_nobody_else(
    simulation, misfit, admitted_as
):
    cast, door = cast_of(simulation, "x", "y", max_subjects=2)
    wearer = standing_at(simulation, 1, 0.0, 0.0, 0.0)
    door.admit([wearer], 0, ToldVote({(1, "x"): 0.05}))
    now_ns = 10 * 10**9
    newcomer = standing_at(simulation, 3, 0.1, 9.5, 10.0)
    beside = standing_at(simulation, 4, 3.0, 9.9, 9.9)
    cast.forget([newcomer, beside], now_ns)
    door.admit([newcomer, beside], now_ns, ToldVote({(3, "x"): misfit}))
    followed = dict(cast.followed())
    assert followed == ({admitted_as: newcomer} if admitted_as else {})


def test_whoever_is_followed_under_another_wearers_name_gets_its_own_and_the_name_waits(simulation):
    cast, door = cast_of(simulation, "x", "y", max_subjects=2)
    body = standing_at(simulation, 1, 0.0, 0.0, 1.0)
    door.admit([body], 10**9, ToldVote({(1, "x"): 0.05, (1, "y"): 0.6}))
    told = ToldVote({(1, "x"): 0.6, (1, "y"): 0.05})
    renumbered = pair_anew(cast, [body], told, 10**9)
    assert dict(cast.followed()) == {"y": body} and renumbered == {1: body.track_id}
    assert body.track_id != 1, "x keeps its identity"
    wearer = standing_at(simulation, 7, 2.0, 0.5, 1.0)
    door.admit([body, wearer], 10**9, ToldVote({(7, "x"): 0.05, (7, "y"): 0.6}))
    assert dict(cast.followed()) == {"x": wearer, "y": body} and wearer.track_id == 1


@pytest.mark.parametrize("misfit", [0.05, 0.9])
def test_sensors_name_whom_only_two_views_see_at_once(simulation, misfit):
    cast, door = cast_of(simulation, "x", max_subjects=1)
    newcomer = standing_at(simulation, 1, 0.0, 0.0, 0.3)
    newcomer.frames, newcomer.strong_frames = 18, 0
    beside = standing_at(simulation, 2, 3.0, 0.0, 0.3)
    told = ToldVote({(1, "x"): misfit, (2, "x"): 0.9})
    door.admit([newcomer, beside], 300_000_000, told)
    assert dict(cast.followed()) == ({"x": newcomer} if misfit < FITS else {})


def test_who_was_out_of_sight_is_heard_anew():
    landmarks, bones = landmark_set_named("body25"), IMUS_6
    vote = SensorVote(landmarks, {"anna": bones})
    from fusecap.associate.sensor_vote import _at_rest

    standing = _at_rest(landmarks)
    track = Track(0, standing, standing[0], np.zeros(1), 0)
    reading = ImuReading(
        bone_rotation_in_world=np.tile(np.eye(3), (len(bones), 1, 1)),
        accel_in_world_m_s2=np.zeros((len(bones), 3)),
    )
    unseen, lying = np.full_like(standing, np.nan), standing[:, [1, 0, 2]]
    for seen, seconds in ((lying, 1.0), (unseen, 0.3), (standing, 0.5)):
        for _ in range(round(seconds * 60)):
            vote.hear([track], seen[None], {"anna": reading}, 1 / 60)
    assert vote.misfit(track, "anna", 0.25) < 0.05


@pytest.mark.parametrize("also_fits", [False, True])
def test_a_wearer_who_was_taken_for_somebody_without_sensors_gets_the_own_name(
    simulation, also_fits
):
    cast, door = cast_of(simulation, "x", max_subjects=3)
    first, second = (standing_at(simulation, n, 2.0 * n, 0.0, 5.0) for n in range(2))
    door.admit([first, second], 5 * 10**9, ToldVote({}))
    assert [name for name, _ in cast.followed()] == ["x", "person1"]
    told = ToldVote({(0, "x"): 0.7, (1, "x"): 0.05})
    assert pair_anew(cast, [first, second], told, 5 * 10**9) == {0: 1, 1: 0}
    assert dict(cast.followed()) == {"x": second, "person1": first}
    cast.forget([first], 6 * 10**9)
    told = ToldVote({(1, "x"): 0.05, (5, "x"): 0.1 if also_fits else 0.9})
    third = standing_at(simulation, 5, 9.0, 0.0, 6.0)
    assert bool(pair_anew(cast, [first, third], told, 6 * 10**9)) != also_fits
    followed = {"person1": first} if also_fits else {"x": first}
    assert dict(cast.followed()) == followed


@pytest.mark.parametrize(
    ("born_s", "x_m", "found"),
    [(0.0, 1.5, False), (0.8, 1.5, True), (0.8, 2.5, False), (1.9, 3.5, True), (9.0, 1.5, False)],
)
def test_whoever_is_found_late_may_have_walked_away_from_the_start(simulation, born_s, x_m, found):
    anatomy, ids = Anatomy(simulation.landmark_set), itertools.count(100)
    subjects = [Subject(name="x", start_m=(0.0, 0.0))]
    options = TrackerOptions(max_subjects=1)
    cast = Cast(subjects, simulation.rig, anatomy, options, ids)
    door = Admission(cast, simulation.rig, anatomy, options)
    door.admit([], 0, ToldVote({}))
    newcomer = standing_at(simulation, 1, x_m, born_s, born_s + 2.0)
    door.admit([newcomer], newcomer.seen_ns, ToldVote({}))
    assert bool(cast.followed()) == found


def test_of_two_wearers_whom_nobody_follows_neither_takes_a_track_that_fits_both(simulation):
    cast, door = cast_of(simulation, "x", "y", max_subjects=3)
    body = standing_at(simulation, 1, 0.0, 0.0, 1.0)
    cast.add("z")
    door.admit([body], 10**9, ToldVote({(1, "z"): 0.05, (1, "x"): 0.9, (1, "y"): 0.9}))
    assert dict(cast.followed()) == {"z": body}
    told = ToldVote({(1, "x"): 0.10, (1, "y"): 0.11})
    assert not pair_anew(cast, [body], told, 10**9)
    assert pair_anew(cast, [body], ToldVote({(1, "x"): 0.10, (1, "y"): 0.5}), 10**9)
    assert dict(cast.followed()) == {"x": body}


def test_a_name_of_which_nothing_else_is_known_waits_for_those_who_are_known(simulation):
    cast, door = cast_of(simulation, "bob", "x", max_subjects=2)
    bob, other = (standing_at(simulation, n, 3.0 * n, 0.0, 1.0) for n in range(2))
    door.admit([bob, other], 10**9, ToldVote({}))
    pair_anew(cast, [bob, other], ToldVote({(1, "x"): 0.9, (0, "x"): 0.05}), 10**9)
    assert dict(cast.followed()) == {"bob": other, "x": bob}


def test_a_lost_packet_lets_nobody_else_decide():
    landmarks, bones = landmark_set_named("body25"), IMUS_6
    vote = SensorVote(landmarks, {"anna": bones})
    reading = ImuReading(
        bone_rotation_in_world=np.tile(np.eye(3), (len(bones), 1, 1)),
        accel_in_world_m_s2=np.zeros((len(bones), 3)),
    )
    nobody = np.zeros((0, 25, 3))
    assert not vote.lately
    vote.hear([], nobody, {"anna": reading}, 0.1)
    vote.hear([], nobody, {}, 0.1)
    assert not vote.heard and vote.lately == {"anna"}
    for _ in range(30):
        vote.hear([], nobody, {}, 0.1)
    assert not vote.lately
