"""The tracker while cameras come and go, and when people are added and removed."""

import numpy as np
import pytest

from fusecap.associate.options import TrackerOptions
from fusecap.associate.subjects import Subject
from fusecap.associate.tracker import Tracker
from fusecap.errors import SessionError
from fusecap.types import Detections, TrackState
from people_scene import BODY25, RATE_HZ, observe, ring_of_cameras, straight, walker

ALL = (True, True, True, True)


def clean(seconds, rng):
    """Two people who walk slowly, seen without errors by four cameras."""
    times_s = np.arange(round(seconds * RATE_HZ)) / RATE_HZ
    people = [
        walker(straight((-0.8, 0.0), (0.05, 0.02)), times_s),
        walker(straight((0.8, 0.3), (-0.05, 0.02)), times_s, 1.65),
    ]
    rig = ring_of_cameras(4)
    scene = observe(rig, people, rng, noise_m=0.01, miss=0, keypoint_miss=0, outlier=0, spurious=0)
    return rig, scene.detections


def seen_by(detections, looked):
    people = tuple(p if see else p[:0] for p, see in zip(detections.people, looked, strict=True))
    return Detections(timestamp_ns=detections.timestamp_ns, people=people, looked=looked)


def follow(tracker, detections, looked_at):
    """Names of the subjects at every instant."""
    history = []
    for instant, item in enumerate(detections):
        item = seen_by(item, looked_at(instant / RATE_HZ))
        updates = tracker.update(item, {}, item.timestamp_ns)
        history.append({u.name: u for u in updates if u.state is not TrackState.TENTATIVE})
    return history


def two(rig, **options):
    subjects = [Subject(name="anna"), Subject(name="ben")]
    return Tracker(rig, BODY25, TrackerOptions(**options), subjects)


def test_outage_of_all_cameras_is_no_absence(rng):
    rig, detections = clean(9.0, rng)
    history = follow(two(rig), detections, lambda s: ALL if s < 2 or s > 7 else (False,) * 4)
    assert all(set(names) == {"anna", "ben"} for names in history[10:])
    assert {n: u.track_id for n, u in history[30].items()} == {
        n: u.track_id for n, u in history[-1].items()
    }


def test_cameras_that_look_and_see_nobody_end_a_track(rng):
    rig, detections = clean(5.0, rng)
    tracker = two(rig)
    for item in detections[:60]:
        tracker.update(item, {}, item.timestamp_ns)
    empty = [
        Detections(timestamp_ns=d.timestamp_ns, people=tuple(p[:0] for p in d.people), looked=ALL)
        for d in detections[60:]
    ]
    last = [tracker.update(item, {}, item.timestamp_ns) for item in empty]
    assert len(last[50]) == 2 and last[-1] == []


@pytest.mark.parametrize("left", [0, 2])
def test_one_camera_that_is_left_keeps_everybody(rng, left):
    rig, detections = clean(12.0, rng)
    alone = tuple(c == left for c in range(4))
    history = follow(two(rig), detections, lambda s: ALL if s < 2 else alone)
    assert all(set(names) == {"anna", "ben"} for names in history[10:])
    for update in history[-1].values():
        assert update.person[left] >= 0


def test_one_of_several_views_that_all_look_is_too_little_for_long(rng):
    rig, detections = clean(12.0, rng)
    alone = (True, False, False, False)
    tracker = two(rig)
    names = []
    for instant, item in enumerate(detections):
        if instant > 60:
            item = seen_by(item, alone)
            item = Detections(timestamp_ns=item.timestamp_ns, people=item.people, looked=ALL)
        names.append({u.name for u in tracker.update(item, {}, item.timestamp_ns)})
    assert names[100] == {"anna", "ben"} and names[-1] == set()


def test_subject_that_one_camera_lost_is_found_again_by_it(rng):
    rig, detections = clean(9.0, rng)
    alone = (True, False, False, False)
    hidden = [
        seen_by(d, (False,) * 4 if 3 < k / RATE_HZ < 6 else ALL) for k, d in enumerate(detections)
    ]
    history = follow(two(rig), hidden, lambda s: ALL if s < 2 else alone)
    assert all(set(names) == {"anna", "ben"} for names in history[10:])
    assert all(u.person[0] >= 0 for u in history[-1].values())


def test_two_cameras_that_look_are_enough_for_a_birth(rng):
    rig, detections = clean(1.0, rng)
    pair = (True, True, False, False)
    history = follow(two(rig, two_view_birth_s=30.0), detections, lambda s: pair)
    assert set(history[-1]) == {"anna", "ben"}


def test_removed_subject_stays_a_bystander_until_there_is_room(rng):
    rig, detections = clean(4.0, rng)
    tracker = two(rig)
    follow(tracker, detections[:30], lambda s: ALL)
    tracker.remove_subject("ben")
    assert all(set(some) == {"anna"} for some in follow(tracker, detections[30:60], lambda s: ALL))
    tracker.add_subject("zoe")
    assert set(follow(tracker, detections[60:90], lambda s: ALL)[-1]) == {"anna", "zoe"}


def test_reinitialised_subject_gets_a_new_track_where_it_stands(rng):
    rig, detections = clean(3.0, rng)
    subjects = [Subject(name="anna", start_m=(-0.8, 0.0)), Subject(name="ben", start_m=(0.8, 0.3))]
    tracker = Tracker(rig, BODY25, TrackerOptions(start_radius_m=0.5), subjects)
    before = follow(tracker, detections[:45], lambda s: ALL)[-1]
    tracker.reinitialise("anna")
    after = follow(tracker, detections[45:90], lambda s: ALL)[-1]
    assert after["ben"].track_id == before["ben"].track_id
    assert after["anna"].track_id != before["anna"].track_id
    tracker.reinitialise()
    assert follow(tracker, detections[90:91], lambda s: ALL) == []


def test_single_camera_has_room_for_one(rng):
    rig, _ = clean(0.1, rng)
    tracker = Tracker(rig.subset(["cam0"]), BODY25)
    with pytest.raises(SessionError, match="one camera"):
        tracker.add_subject()
    tracker.remove_subject("nobody")
