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


def aside(x_m: float, z_m: float = 0.0) -> np.ndarray:
    return SOMEBODY + [x_m, 0.0, z_m]


def of_size(factor: float) -> np.ndarray:
    return SOMEBODY * factor


class Stage:
    """Shows a tracker, instant by instant, exact detections of whoever is there."""

    def __init__(self, tracker: Tracker, rig=RIG) -> None:
        self._tracker = tracker
        self._rig = rig
        self._frame = 0

    def show(
        self, *bodies: np.ndarray, mirrored: tuple[np.ndarray, ...] = (), predicted=None
    ) -> list[TrackUpdate]:
        """One instant; the people seen with left and right exchanged come last in every view."""
        everyone = [*bodies, *(body[BODY25.mirror] for body in mirrored)]
        views = []
        for camera in self._rig.cameras:
            keypoints = np.ones((len(everyone), len(SOMEBODY), 3))
            for n, body in enumerate(everyone):
                keypoints[n, :, :2] = camera.project(body)
            views.append(keypoints)
        now_ns = round(self._frame * 1e9 / RATE_HZ)
        self._frame += 1
        detections = Detections(timestamp_ns=now_ns, people=tuple(views))
        return self._tracker.update(detections, predicted or {}, now_ns)

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


# ------------------------------------------------------------------------------------------ young


def test_newcomer_under_trial_takes_no_detection_that_a_subject_can_have():
    stage = Stage(Tracker(RIG, BODY25))
    stage.hold(0.5, SOMEBODY)
    # Between the directions of two cameras, so that every view tells the two apart.
    beside = np.array([np.sin(0.3 + np.pi / 4), np.cos(0.3 + np.pi / 4)])
    assert len(stage.show(SOMEBODY, aside(*0.5 * beside))) == 2
    # One person is seen now, nearer to the newcomer.
    subject, newcomer = stage.show(aside(*0.3 * beside))
    assert subject.state is TrackState.CONFIRMED and np.all(subject.person == 0)
    assert newcomer.state is TrackState.TENTATIVE and np.all(newcomer.person == -1)


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
