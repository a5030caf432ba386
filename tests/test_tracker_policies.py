"""What the tracker decides on purpose where the detections alone would leave it open."""

from __future__ import annotations

import numpy as np
import pytest

from fusecap.associate.options import TrackerOptions
from fusecap.associate.subjects import Subject
from fusecap.associate.tracker import Tracker
from fusecap.types import Detections, TrackState, TrackUpdate
from people_scene import BODY25, RATE_HZ, ring_of_cameras, straight, walker

RIG = ring_of_cameras(4)
SOMEBODY = walker(straight((0.0, 0.0), (0.0, 0.0)), np.zeros(1))[0]
"""Landmarks (k, 3) of a person who stands in the middle."""


BESIDE = np.array([np.sin(0.3 + np.pi / 4), np.cos(0.3 + np.pi / 4)])
"""A direction on the floor between those of two cameras: every view tells who stands there."""


def aside(x_m: float, z_m: float = 0.0) -> np.ndarray:
    return SOMEBODY + [x_m, 0.0, z_m]


def of_size(factor: float) -> np.ndarray:
    return SOMEBODY * factor


class Stage:
    """Shows a tracker, instant by instant, exact detections of whoever is there."""

    def __init__(self, tracker: Tracker, rig=RIG) -> None:
        self.tracker = tracker
        self._rig = rig
        self._frame = 0

    def show(
        self,
        *bodies: np.ndarray,
        mirrored: tuple[np.ndarray, ...] = (),
        predicted=None,
        unseen_by: tuple[int, ...] = (),
        left: int | None = None,
        lone: np.ndarray | None = None,
    ) -> list[TrackUpdate]:
        """One instant; the people seen with left and right exchanged come last in every view.

        Cameras that they are `unseen_by` look and detect nobody; where one camera is `left`, the
        others do not even look. `lone` is something that the first camera alone detects.
        """
        everyone = [*bodies, *(body[BODY25.mirror] for body in mirrored)]
        views = []
        for c, camera in enumerate(self._rig.cameras):
            keypoints = np.ones((len(everyone), len(SOMEBODY), 3))
            for n, body in enumerate(everyone):
                keypoints[n, :, :2] = camera.project(body)
            shown = keypoints[:0] if c in unseen_by or left not in (None, c) else keypoints
            if lone is not None and c == 0:
                pixels = np.column_stack([camera.project(lone), np.ones(len(lone))])
                shown = np.concatenate([shown, pixels[None]])
            views.append(shown)
        now_ns = round(self._frame * 1e9 / RATE_HZ)
        self._frame += 1
        looked = tuple(left in (None, c) for c in range(len(views)))
        detections = Detections(timestamp_ns=now_ns, people=tuple(views), looked=looked)
        return self.tracker.update(detections, predicted or {}, now_ns)

    def hold(self, seconds: float, *bodies: np.ndarray) -> list[TrackUpdate]:
        """The same for a while; what is reported at its end."""
        updates = []
        for _ in range(round(seconds * RATE_HZ)):
            updates = self.show(*bodies)
        return updates


def subjects_of(updates: list[TrackUpdate]) -> dict[str, int]:
    return {u.name: u.track_id for u in updates if u.state is not TrackState.TENTATIVE}


# --------------------------------------------------------------------------------------- mirrored


def test_plain_detection_goes_before_a_nearer_one_with_left_and_right_exchanged():
    stage = Stage(Tracker(RIG, BODY25))
    stage.hold(0.5, SOMEBODY)
    # A detector sees the person twice: 5 cm off the right way round, and exactly, but mirrored.
    (update,) = stage.show(aside(0.05), mirrored=(SOMEBODY,), predicted={0: SOMEBODY})
    np.testing.assert_array_equal(update.person, 0)


def test_exchanged_detection_on_the_spot_goes_before_a_plain_one_farther_off():
    rig = ring_of_cameras(1)
    stage = Stage(Tracker(rig, BODY25, subjects=[Subject(name="ann")]), rig)
    stage.show(SOMEBODY)
    (update,) = stage.show(aside(0.2), mirrored=(SOMEBODY,), predicted={0: SOMEBODY})
    np.testing.assert_array_equal(update.person, 1)


# ---------------------------------------------------------------------------------------- doubled


def test_of_two_tracks_on_one_body_the_younger_goes_after_a_while():
    stage = Stage(Tracker(RIG, BODY25, TrackerOptions(overlap_s=0.5)))
    old = subjects_of(stage.hold(0.5, SOMEBODY))
    assert len(subjects_of(stage.hold(0.5, SOMEBODY, aside(1.0)))) == 2
    for step in np.linspace(1.0, 0.0, 30):
        stage.show(SOMEBODY, aside(step))
    # Passing through each other is shorter than this.
    assert len(subjects_of(stage.hold(0.2, SOMEBODY, aside(0.01)))) == 2
    assert subjects_of(stage.hold(0.5, SOMEBODY, aside(0.01))) == old


def test_who_parted_in_time_is_not_doubled_when_they_meet_again():
    stage = Stage(Tracker(RIG, BODY25, TrackerOptions(overlap_s=0.5)))
    stage.hold(0.5, SOMEBODY, aside(1.0))
    path = np.concatenate([np.linspace(1.0, 0.0, 30), np.linspace(0.0, 1.0, 30)])
    for _ in range(2):
        for step in path:
            assert len(subjects_of(stage.show(SOMEBODY, aside(step)))) == 2


def test_subject_stays_when_an_older_bystander_stands_in_the_same_place():
    options = TrackerOptions(max_subjects=1, volume_m=(-1.0, 1.0, -1.0, 1.0))
    stage = Stage(Tracker(RIG, BODY25, options))
    stage.hold(0.5, aside(2.0))
    (subject,) = subjects_of(stage.hold(0.5, aside(2.0), SOMEBODY)).values()
    for step in np.linspace(2.0, 0.0, 60):
        stage.show(aside(step), SOMEBODY)
    assert list(subjects_of(stage.hold(1.0, aside(0.01), SOMEBODY)).values()) == [subject]


# ------------------------------------------------------------------------------------------- find


def test_newcomer_is_under_trial_for_two_instants_and_a_subject_in_the_third():
    stage = Stage(Tracker(RIG, BODY25))
    states = [stage.show(SOMEBODY)[0].state for _ in range(3)]
    assert states == [TrackState.TENTATIVE, TrackState.TENTATIVE, TrackState.CONFIRMED]


def test_whom_only_two_of_the_views_detect_becomes_a_subject_after_a_second():
    stage = Stage(Tracker(RIG, BODY25))
    reported = [stage.show(SOMEBODY, unseen_by=(2, 3)) for _ in range(33)]
    assert reported[:30] == [[]] * 30 and len(reported[31]) == 1


def test_newcomer_unseen_for_half_a_second_begins_its_trial_again():
    stage = Stage(Tracker(RIG, BODY25))
    stage.hold(2 / RATE_HZ, SOMEBODY)
    stage.hold(0.6)
    (update,) = stage.show(SOMEBODY)
    assert update.state is TrackState.TENTATIVE


def test_outage_longer_than_the_memory_ends_every_track():
    stage = Stage(Tracker(RIG, BODY25, TrackerOptions(coast_s=1.0, memory_s=1.0)))
    stage.hold(0.5, SOMEBODY)
    reported = [len(stage.show(left=-1)) for _ in range(70)]
    assert reported[:58] == [1] * 58 and reported[-1] == 0


@pytest.mark.parametrize(
    "found", [aside(*0.52 * BESIDE), of_size(0.75) + 0.44 * (aside(*BESIDE) - SOMEBODY)]
)
def test_person_who_jumps_out_of_the_gate_is_found_again_at_once(found):
    stage = Stage(Tracker(RIG, BODY25))
    stage.hold(0.5, SOMEBODY)
    (update,) = stage.show(found)
    assert update.state is TrackState.CONFIRMED and np.all(update.person == 0)


@pytest.mark.parametrize(
    "other", [aside(*1.0 * BESIDE), of_size(0.65) + aside(*0.3 * BESIDE) - SOMEBODY]
)
def test_somebody_too_far_or_of_another_size_does_not_continue_a_track(other):
    stage = Stage(Tracker(RIG, BODY25))
    stage.hold(0.5, SOMEBODY)
    before, newcomer = stage.show(other)
    assert before.state is TrackState.COASTING
    assert newcomer.state is TrackState.TENTATIVE and newcomer.track_id != before.track_id


def test_skeleton_within_a_torso_of_a_track_is_nobody_new():
    stage = Stage(Tracker(RIG, BODY25))
    stage.hold(0.5, SOMEBODY)
    assert len(stage.show(SOMEBODY, aside(*0.295 * BESIDE))) == 1


def test_views_that_agree_take_the_only_detection_of_a_track_along():
    rig = ring_of_cameras(3)
    stage = Stage(Tracker(rig, BODY25), rig)
    stage.hold(0.5, SOMEBODY)
    # Away from one camera, which alone sees the person where it was expected.
    (update,) = stage.show(aside(-0.5 * np.sin(0.3), -0.5 * np.cos(0.3)))
    np.testing.assert_array_equal(update.person, 0)


# ------------------------------------------------------------------------------------------ young


def test_newcomer_under_trial_takes_no_detection_that_a_subject_can_have():
    stage = Stage(Tracker(RIG, BODY25))
    stage.hold(0.5, SOMEBODY)
    assert len(stage.show(SOMEBODY, aside(*0.5 * BESIDE))) == 2
    # One person is seen now, nearer to the newcomer.
    subject, newcomer = stage.show(aside(*0.3 * BESIDE))
    assert subject.state is TrackState.CONFIRMED and np.all(subject.person == 0)
    assert newcomer.state is TrackState.TENTATIVE and np.all(newcomer.person == -1)


def test_bystander_keeps_a_detection_that_fits_it_better_than_the_subject():
    stage = Stage(Tracker(RIG, BODY25, TrackerOptions(max_subjects=1)))
    (subject,) = stage.hold(0.5, SOMEBODY)
    stage.hold(0.5, SOMEBODY, aside(*0.5 * BESIDE))
    (update,) = stage.show(aside(*0.3 * BESIDE))
    assert update.track_id == subject.track_id and update.state is TrackState.COASTING


# ------------------------------------------------------------------------------------------- jump


def test_subject_whose_track_jumped_onto_somebody_else_is_who_goes_on_where_it_was():
    stage = Stage(Tracker(RIG, BODY25))
    (before,) = stage.hold(0.5, SOMEBODY)
    beside = aside(*0.45 * BESIDE)
    (jumped,) = stage.hold(0.2, beside)
    assert jumped.track_id == before.track_id
    notes, since_ns = [], None
    for _ in range(15):
        updates = stage.show(SOMEBODY, beside)
        notes += stage.tracker.notes
        since_ns = since_ns or stage.tracker.renumbered_since_ns
    by_id = {update.track_id: update for update in updates}
    np.testing.assert_array_equal(by_id[before.track_id].person, 0)
    assert len(by_id) == 2 and all(u.state is TrackState.CONFIRMED for u in updates)
    assert len(notes) == 1 and "somebody else than was followed" in notes[0]
    assert since_ns == round(0.5 * 1e9), "the first instant of the jump"


def test_subject_who_did_jump_stays_when_somebody_comes_elsewhere():
    stage = Stage(Tracker(RIG, BODY25))
    (before,) = stage.hold(0.5, SOMEBODY)
    stage.hold(0.2, aside(*0.45 * BESIDE))
    updates = stage.hold(0.5, aside(*0.45 * BESIDE), aside(*-0.45 * BESIDE))
    by_id = {update.track_id: update for update in updates}
    np.testing.assert_array_equal(by_id[before.track_id].person, 0)


def test_depth_that_a_solve_guessed_of_one_view_leads_no_track_away():
    stage = Stage(Tracker(RIG, BODY25))
    (before,) = stage.hold(0.5, SOMEBODY)
    stage.show(SOMEBODY, unseen_by=(0, 1, 3))
    astray = {before.track_id: aside(*1.5 * BESIDE)}
    (update,) = stage.show(SOMEBODY, predicted=astray)
    np.testing.assert_array_equal(update.person, 0)


# ------------------------------------------------------------------------------------- one camera


ACROSS = np.array([np.cos(0.3), -np.sin(0.3)])
"""The direction on the floor in which the first and third camera see somebody move sideways."""


def test_track_that_one_view_shows_goes_along_sideways():
    stage = Stage(Tracker(RIG, BODY25))
    stage.hold(0.5, SOMEBODY)
    for step in np.linspace(0.0, 1.5, 45):
        upper = aside(*step * ACROSS)
        upper[upper[:, 1] < 1.2] = np.nan
        (update,) = stage.show(upper, unseen_by=(0, 1, 3))
        np.testing.assert_array_equal(update.person, [-1, -1, 0, -1])
    # What that view did not see went along with the rest.
    (update,) = stage.show(aside(*1.5 * ACROSS), unseen_by=(0, 1, 3))
    np.testing.assert_array_equal(update.person, [-1, -1, 0, -1])


def test_only_camera_left_finds_a_subject_again_beyond_the_gate():
    stage = Stage(Tracker(RIG, BODY25))
    (before,) = stage.hold(0.5, SOMEBODY)
    for _ in range(3):
        (update,) = stage.show(aside(*0.5 * ACROSS), left=0)
        assert update.track_id == before.track_id and update.state is TrackState.CONFIRMED
        np.testing.assert_array_equal(update.person, [0, -1, -1, -1])


@pytest.mark.parametrize("place", [0, 1])
def test_one_camera_begins_with_whoever_stands_at_the_start_position(place):
    rig = ring_of_cameras(1)
    bodies = [aside(-2.0), aside(-2.0)]
    bodies[place] = SOMEBODY
    ann = Subject(name="ann", start_m=(0.0, 0.0))
    (update,) = Stage(Tracker(rig, BODY25, subjects=[ann]), rig).show(*bodies)
    assert update.name == "ann" and update.person[0] == place


def test_one_camera_waits_while_nobody_stands_at_the_start_position():
    rig = ring_of_cameras(1)
    ann = Subject(name="ann", start_m=(0.0, 0.0))
    assert Stage(Tracker(rig, BODY25, subjects=[ann]), rig).show(aside(-2.0)) == []


# ------------------------------------------------------------------------------------- hand over


def astray(stage: Stage, seconds: float, *, lone: np.ndarray, body: np.ndarray):
    updates = []
    for _ in range(round(seconds * RATE_HZ)):
        updates = stage.show(body, unseen_by=(0,), lone=lone)
    return updates


@pytest.mark.parametrize("options", [TrackerOptions(), TrackerOptions(max_subjects=1)])
def test_subject_whom_one_view_leads_astray_is_the_newcomer_beside(options):
    stage = Stage(Tracker(RIG, BODY25, options))
    known = subjects_of(stage.hold(1.0, SOMEBODY))
    updates = astray(stage, 1.0, lone=SOMEBODY, body=aside(0.6))
    assert subjects_of(updates) == known
    assert (updates[0].person[1:] >= 0).all(), "three views see the person"


def test_newcomer_far_from_a_subject_whom_one_view_shows_is_somebody_else():
    stage = Stage(Tracker(RIG, BODY25))
    known = subjects_of(stage.hold(1.0, SOMEBODY))
    found = subjects_of(astray(stage, 1.0, lone=SOMEBODY, body=aside(2.5)))
    assert len(found) == 2 and known.items() < found.items()


def test_bystander_measured_beside_a_subject_does_not_take_the_place():
    stage = Stage(Tracker(RIG, BODY25, TrackerOptions(max_subjects=1)))
    known = subjects_of(stage.hold(1.0, SOMEBODY))
    stage.hold(1.0, SOMEBODY, aside(0.7))
    told, updates = [], []
    for _ in range(round(5.0 * RATE_HZ)):
        updates = stage.show(aside(0.7))
        told += stage.tracker.notes
    assert subjects_of(updates) == {}
    assert len(told) == 1 and "left out while a subject is missing" in told[0]
    assert subjects_of(stage.hold(0.5, SOMEBODY, aside(0.7))) == known


def test_two_views_that_put_a_subject_where_nobody_can_have_gone_are_not_believed():
    stage = Stage(Tracker(RIG, BODY25))
    stage.hold(1.0, SOMEBODY)
    (update,) = stage.show(aside(0.9), predicted={0: SOMEBODY}, unseen_by=(2, 3))
    assert (update.person < 0).all()


# ----------------------------------------------------------------------------------------- memory


def test_returning_subject_is_measured_by_all_that_was_ever_seen_of_it():
    stage = Stage(Tracker(RIG, BODY25))
    known = subjects_of(stage.hold(3.0, SOMEBODY))
    assert stage.hold(3.0) == []
    # Back for a moment, badly measured, and away again.
    assert subjects_of(stage.hold(0.15, of_size(1.14))) == known
    assert stage.hold(3.0) == []
    assert subjects_of(stage.hold(0.5, of_size(0.92))) == known


def test_somebody_of_another_size_is_a_new_subject_where_there_is_room():
    stage = Stage(Tracker(RIG, BODY25))
    known = subjects_of(stage.hold(3.0, SOMEBODY))
    stage.hold(3.0)
    assert not subjects_of(stage.hold(0.5, of_size(0.8))).items() & known.items()


@pytest.mark.parametrize(("x_m", "same"), [(0.4, True), (1.5, False), (-1.5, False)])
def test_who_comes_back_farther_than_the_missing_can_have_gone_is_a_new_subject(x_m, same):
    middle = aside(0.0, 1.0)
    stage = Stage(Tracker(RIG, BODY25, TrackerOptions(reach_speed_m_s=0.1)))
    known = subjects_of(stage.hold(1.0, middle))
    stage.hold(3.0)
    assert (subjects_of(stage.hold(0.5, middle + [x_m, 0.0, 0.0])) == known) is same


@pytest.mark.parametrize("place", [(1.5, 0.0), (-1.5, 0.0), (0.0, 1.5), (0.0, -1.5)])
def test_nobody_becomes_a_subject_beyond_any_side_of_the_volume(place):
    stage = Stage(Tracker(RIG, BODY25, TrackerOptions(volume_m=(-1.0, 1.0, -1.0, 1.0))))
    assert stage.hold(0.5, aside(*place)) == []


def test_somebody_of_another_size_is_the_missing_subject_where_there_is_no_other_place():
    stage = Stage(Tracker(RIG, BODY25, TrackerOptions(max_subjects=1)))
    known = subjects_of(stage.hold(3.0, SOMEBODY))
    stage.hold(3.0)
    assert subjects_of(stage.hold(0.5, of_size(0.8))) == known


def test_somebody_of_another_size_takes_a_waiting_name_before_a_missing_one():
    stage = Stage(Tracker(RIG, BODY25, subjects=[Subject(name="ann"), Subject(name="bob")]))
    assert set(subjects_of(stage.hold(3.0, SOMEBODY))) == {"ann"}
    stage.hold(3.0)
    assert set(subjects_of(stage.hold(0.5, of_size(0.8)))) == {"bob"}


def test_place_added_without_a_name_is_numbered():
    tracker = Tracker(RIG, BODY25, subjects=[Subject(name="ann")])
    tracker.add_subject()
    assert set(subjects_of(Stage(tracker).hold(0.5, SOMEBODY, aside(1.0)))) == {"ann", "person1"}


@pytest.mark.parametrize(
    ("away_s", "name", "remembered"),
    [(5.0, "", True), (9.0, "", False), (5.0, "ann", True), (9.0, "ann", True)],
)
def test_subject_is_remembered_for_a_while_and_for_good_under_a_name(away_s, name, remembered):
    options = TrackerOptions(memory_s=7.0, coast_s=1.0, max_subjects=2)
    stage = Stage(Tracker(RIG, BODY25, options, [Subject(name=name)] if name else []))
    ((called, track_id),) = subjects_of(stage.hold(1.0, SOMEBODY)).items()
    assert stage.hold(away_s) == []
    ((again, new_id),) = subjects_of(stage.hold(0.5, SOMEBODY)).items()
    assert called == again == (name or "person1")
    assert (new_id == track_id) is remembered


def test_whoever_takes_a_bystanders_place_while_nobody_looks_is_not_held_to_be_the_bystander():
    stage = Stage(Tracker(RIG, BODY25, TrackerOptions(max_subjects=1)))
    stage.hold(1.0, aside(0.0), aside(1.3))
    for _ in range(round(3.5 * RATE_HZ)):
        stage.show(left=len(RIG))
    stage.hold(4.0, aside(1.3))
    (found,) = stage.show(aside(1.3))
    assert (found.name, found.state) == ("person1", TrackState.CONFIRMED)
