"""Who is who: kernels against slow twins, Algorithm 1, and the tracker on scenes with truth."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from fusecap.associate.anatomy import Anatomy
from fusecap.associate.candidates import CandidateOptions, find_candidates, triangulate_pairs
from fusecap.associate.matching import assign_each_view
from fusecap.associate.options import TrackerOptions
from fusecap.associate.paper import PaperSorter
from fusecap.associate.subjects import Subject
from fusecap.associate.tracker import Tracker
from fusecap.associate.views import Views
from fusecap.errors import SessionError
from fusecap.types import Detections, TrackState
from people_scene import (
    BODY25,
    circle,
    observe,
    ring_of_cameras,
    run,
    straight,
    walker,
)

TIMES_S = np.arange(240) / 30.0
ANN = Subject(name="ann", start_m=(0.0, 0.0))


def two_who_pass(gap_m: float) -> list[np.ndarray]:
    """Towards each other at 0.75 m/s each, `gap_m` apart when they meet."""
    return [
        walker(straight((-3, gap_m / 2), (0.75, 0)), TIMES_S, 1.70),
        walker(straight((3, -gap_m / 2), (-0.75, 0)), TIMES_S, 1.80),
    ]


def six_people() -> list[np.ndarray]:
    """On rings of their own, in turn left and right about."""
    return [
        walker(circle(0.7 + 0.35 * i, 2.0 * i, 0.5 if i % 2 else -0.5), TIMES_S, 1.6 + 0.05 * i)
        for i in range(6)
    ]


# ------------------------------------------------------------------------------------- the kernels


def test_rays_are_undistorted_keypoints(rng):
    rig = ring_of_cameras(3)
    people = tuple(
        np.concatenate([rng.uniform([0, 0], [1920, 1080], (2, 25, 2)), np.ones((2, 25, 1))], axis=2)
        for _ in rig.cameras
    )
    views = Views.of(rig, Detections(timestamp_ns=0, people=people))
    for n, camera in enumerate(views.camera_of):
        pixels = people[camera][n - views.first[camera], :, :2]
        np.testing.assert_allclose(
            views.rays[n, :, :2], rig.cameras[camera].undistort(pixels), atol=1e-7
        )


def test_distance_is_metric_and_robust_like_its_twin(rng):
    rig = ring_of_cameras(3)
    people = [walker(circle(1, i, 0.5), TIMES_S[:2]) for i in range(3)]
    scene = observe(rig, people, rng, spurious=0.0)
    views = Views.of(rig, scene.detections[0])
    skeletons = np.stack([p[1] for p in people])
    skeletons[0, :3] = np.nan
    wanted = np.ones(len(views.rays), dtype=bool)
    wanted[1] = False
    distance = views.distances(skeletons, 0.5, wanted)

    def twin(points, ray, camera):
        in_cam = points @ camera.rotation.T + camera.translation
        offset = in_cam[:, 2:] * ray[:, :2] - in_cam[:, :2]
        distance = np.minimum(np.linalg.norm(offset, axis=1), 0.5)
        known = np.isfinite(points[:, 0]) & (ray[:, 2] > 0)
        return np.average(distance[known], weights=ray[known, 2])

    for t, points in enumerate(skeletons):
        for n, c in enumerate(views.camera_of):
            expected = twin(points, views.rays[n], rig.cameras[c]) if wanted[n] else np.inf
            assert distance[t, n] == pytest.approx(expected, abs=1e-9)


def test_pairs_meet_where_their_rays_do(rng):
    rig = ring_of_cameras(4)
    people = [walker(circle(1, i * 2.0, 0.5), TIMES_S[:1]) for i in range(3)]
    scene = observe(
        rig, people, rng, noise_m=0.0, outlier=0.0, miss=0.0, spurious=0.0, keypoint_miss=0.0
    )
    views = Views.of(rig, scene.detections[0])
    owner = np.concatenate(scene.owner[0])
    pairs = np.array(
        [
            (a, b)
            for a in range(len(owner))
            for b in range(len(owner))
            if views.camera_of[a] < views.camera_of[b] and owner[a] == owner[b]
        ]
    )
    points, error = triangulate_pairs(views, pairs, 28.8)
    assert np.all(error < 0.01)
    for h, (a, _) in enumerate(pairs):
        np.testing.assert_allclose(points[h], people[owner[a]][0], atol=1e-4)


def test_assignment_is_optimal_and_respects_gates():
    distance = np.array([[0.1, 0.2, 0.1], [0.12, 0.9, 0.3]])
    person = np.full((2, 2), -1)
    free = np.ones(3, dtype=bool)
    camera_of = np.array([0, 0, 1])
    assign_each_view(distance, np.full(2, 0.4), camera_of, (0, 2, 3), free, person)
    # Greedy would give track 0 the first detection and leave track 1 with nothing.
    np.testing.assert_array_equal(person, [[1, 2], [0, -1]])
    assert not free.any()


def test_assignment_has_the_least_total_of_all(rng):
    for _ in range(50):
        distance = rng.uniform(0, 1, (3, 4))
        gate = np.full(3, 0.5)
        person = np.full((3, 1), -1)
        free = np.ones(4, dtype=bool)
        assign_each_view(distance, gate, np.zeros(4, dtype=int), (0, 4), free, person)
        cost = np.minimum(distance, 0.5)
        least = min(
            sum(cost[t, n] for t, n in enumerate(order))
            for order in itertools.permutations(range(4), 3)
        )
        total = sum(cost[t, n] if n >= 0 else 0.5 for t, n in enumerate(person[:, 0]))
        assert total == pytest.approx(least)


# -------------------------------------------------------------------------------------- candidates


def candidates_of(scene, rig, frame=0):
    views = Views.of(rig, scene.detections[frame])
    free = np.ones(len(views.rays), dtype=bool)
    found = find_candidates(views, free, Anatomy(BODY25), CandidateOptions())
    owner = np.concatenate(scene.owner[frame])
    return [owner[c.person[c.person >= 0]] for c in found], found


@pytest.mark.parametrize("cameras", [3, 4, 8])
def test_candidates_are_the_people_and_nobody_else(rng, cameras):
    rig = ring_of_cameras(cameras)
    scene = observe(rig, [p[:20] for p in six_people()], rng)
    people = 0
    for frame in range(20):
        owners, _ = candidates_of(scene, rig, frame)
        assert all(len(set(owner)) == 1 for owner in owners)
        people += len({int(owner[0]) for owner in owners})
        assert len(owners) == len({int(owner[0]) for owner in owners})
    assert people >= 0.97 * 20 * 6


def test_half_a_person_in_one_view_is_no_candidate(rng):
    rig = ring_of_cameras(4)
    scene = observe(rig, [six_people()[0][:1]], rng, hidden=lambda p, c, f: c > 0, spurious=1.0)
    assert candidates_of(scene, rig)[1] == []


def test_skeleton_of_impossible_size_is_refused():
    anatomy = Anatomy(BODY25)
    body = six_people()[0][0]
    assert anatomy.possible(body[None])[0]
    assert not anatomy.possible(3 * body[None])[0]
    assert not anatomy.possible(0.3 * body[None])[0]
    body[5:] = np.nan
    assert not anatomy.possible(body[None])[0]


def test_centre_is_that_of_the_torso_or_of_what_is_there():
    body = six_people()[0][0]
    torso = np.isin(BODY25.landmark_names, ["neck", "mid_hip", "left_hip", "right_hip"])
    torso |= np.isin(BODY25.landmark_names, ["left_shoulder", "right_shoulder"])
    anatomy = Anatomy(BODY25)
    np.testing.assert_allclose(anatomy.centre(body), body[torso].mean(axis=0))
    body[torso] = np.nan
    np.testing.assert_allclose(anatomy.centre(body), body[~torso].mean(axis=0))
    assert np.isnan(anatomy.centre(np.full_like(body, np.nan))).all()


# ------------------------------------------------------------------------------------- the tracker


@pytest.mark.parametrize("gap_m", [0.6, 0.4, 0.2])
@pytest.mark.parametrize("cameras", [3, 4, 8])
def test_two_who_pass_closely_keep_their_identities(rng, gap_m, cameras):
    rig = ring_of_cameras(cameras)
    _, score = run(Tracker(rig, BODY25), observe(rig, two_who_pass(gap_m), rng))
    assert sorted(score.person_of.values()) == [0, 1]
    assert score.wrong == 0 and score.switches == 0
    assert score.seen_share > 0.97


def test_overtaking_at_an_arms_length_keeps_identities(rng):
    rig = ring_of_cameras(4)
    people = [
        walker(straight((-2, 0.15), (0.6, 0)), TIMES_S),
        walker(straight((-3, -0.15), (0.9, 0)), TIMES_S),
    ]
    _, score = run(Tracker(rig, BODY25), observe(rig, people, rng))
    assert len(score.person_of) == 2 and score.wrong == 0


def test_six_people_in_eight_views_are_six_tracks(rng):
    rig = ring_of_cameras(8)
    history, score = run(Tracker(rig, BODY25), observe(rig, six_people(), rng))
    assert sorted(score.person_of.values()) == list(range(6))
    assert score.wrong == 0 and score.switches == 0 and score.seen_share > 0.97
    assert score.names == {f"person{i}" for i in range(1, 7)}
    # Tracked from the third instant on, without a gap.
    assert all(len(updates) == 6 for updates in history)
    assert all(u.state is TrackState.CONFIRMED for u in history[2])


def test_mirrored_detections_are_left_out_and_make_no_ghosts(rng):
    rig = ring_of_cameras(8)
    history, score = run(Tracker(rig, BODY25), observe(rig, six_people(), rng, mirrored=0.1))
    assert sorted(score.person_of.values()) == list(range(6))
    assert score.wrong == 0 and all(len(updates) == 6 for updates in history)


def test_landmarks_are_triangulated_from_the_assigned_views(rng):
    rig = ring_of_cameras(4)
    people = [six_people()[0]]
    history, _ = run(Tracker(rig, BODY25), observe(rig, people, rng))
    error = [
        np.linalg.norm(updates[0].landmarks_in_world_m - people[0][f], axis=1)
        for f, updates in enumerate(history)
    ]
    assert np.nanmedian(error) < 0.03


def test_occluded_for_a_second_coasts_and_returns(rng):
    rig = ring_of_cameras(4)
    people = [
        walker(straight((-2, 0.5), (0.6, 0)), TIMES_S),
        walker(circle(1, 0, 0.5), TIMES_S, 1.8),
    ]
    scene = observe(rig, people, rng, hidden=lambda p, c, f: p == 0 and 100 <= f < 130)
    history, score = run(Tracker(rig, BODY25), scene)
    assert sorted(score.person_of.values()) == [0, 1] and score.switches == 0
    during = [u.state for u in history[115]]
    assert sorted(s.value for s in during) == ["coasting", "confirmed"]
    assert all(u.state is TrackState.CONFIRMED for u in history[132])


def test_who_leaves_and_returns_gets_the_identity_back(rng):
    rig = ring_of_cameras(4)
    people = [
        walker(circle(1.2, 0, 0.6), TIMES_S),
        walker(circle(1.2, np.pi, 0.6), TIMES_S, 1.9),
    ]
    scene = observe(rig, people, rng, hidden=lambda p, c, f: p == 0 and 60 <= f < 180)
    subjects = [Subject(name="ann"), Subject(name="bob")]
    history, score = run(Tracker(rig, BODY25, subjects=subjects), scene)
    assert len(score.person_of) == 2 and score.switches == 0 and score.wrong == 0
    assert len(history[150]) == 1  # missing after two seconds
    assert {u.name for u in history[239]} == {"ann", "bob"}


def test_a_bystander_who_was_there_does_not_inherit(rng):
    """Ann leaves; somebody who stood beside her all the time is not Ann."""
    rig = ring_of_cameras(6)
    people = [
        walker(circle(1, 0, 0.6), TIMES_S),
        walker(straight((1.5, -1.5), (0, 0)), TIMES_S),
    ]
    scene = observe(rig, people, rng, hidden=lambda p, c, f: p == 0 and f >= 60)
    ann = Subject(name="ann", start_m=(0.0, 1.0))
    history, score = run(Tracker(rig, BODY25, subjects=[ann]), scene)
    assert score.person_of == {0: 0} and score.wrong == 0
    assert history[-1] == []


def test_bystander_outside_the_volume_is_not_reported(rng):
    rig = ring_of_cameras(6)
    people = [
        walker(circle(1, 0, 0.6), TIMES_S),
        walker(straight((3, 3), (0, 0)), TIMES_S, 1.8),
    ]
    options = TrackerOptions(volume_m=(-2.0, 2.0, -2.0, 2.0))
    history, score = run(Tracker(rig, BODY25, options), observe(rig, people, rng))
    assert set(score.person_of.values()) == {0}
    assert all(len(updates) <= 1 for updates in history)


def test_max_subjects_prefers_the_middle_of_the_volume(rng):
    rig = ring_of_cameras(6)
    people = [
        walker(straight((2, 2), (0, 0)), TIMES_S[:60], 1.8),
        walker(circle(0.3, 0, 0.6), TIMES_S[:60]),
    ]
    scene = observe(rig, people, rng, miss=0.0)
    _, score = run(Tracker(rig, BODY25, TrackerOptions(max_subjects=1)), scene)
    assert set(score.person_of.values()) == {1}


def test_start_positions_name_the_subjects(rng):
    rig = ring_of_cameras(4)
    people = two_who_pass(0.4)
    subjects = [Subject(name="bob", start_m=(3.0, -0.2)), Subject(name="ann", start_m=(-3.0, 0.2))]
    scene = observe(rig, people, rng)
    history, score = run(Tracker(rig, BODY25, subjects=subjects), scene)
    name_of = {u.track_id: u.name for u in history[-1]}
    assert {name_of[t]: p for t, p in score.person_of.items()} == {"ann": 0, "bob": 1}
    assert [u.name for u in history[-1]] == ["bob", "ann"]


def test_prediction_of_the_solver_is_followed(rng):
    """Somebody jumps 0.6 m between two instants: only a prediction can find them at once."""
    rig = ring_of_cameras(4)
    person = walker(straight((0, 0), (0, 0)), TIMES_S[:20])
    person[10:] += [0.6, 0, 0]
    scene = observe(rig, [person], rng, miss=0.0)
    tracker = Tracker(rig, BODY25)
    for frame, detections in enumerate(scene.detections):
        predicted = {0: person[frame]} if frame > 3 else {}
        updates = tracker.update(detections, predicted, detections.timestamp_ns)
        assert np.all(updates[0].person >= 0)
        assert updates[0].track_id == 0


def test_wrong_view_is_left_unassigned():
    """Where two bodies overlap in one view and one is missed there, the other stays whose it is."""
    rng = np.random.default_rng(3)
    rig = ring_of_cameras(4)
    people = two_who_pass(0.3)
    scene = observe(
        rig, people, rng, hidden=lambda p, c, f: p == 0 and c in (1, 2) and 90 < f < 150
    )
    _, score = run(Tracker(rig, BODY25), scene)
    assert len(score.person_of) == 2 and score.wrong == 0


def test_one_camera_follows_its_most_confident_detection(rng):
    rig = ring_of_cameras(1)
    person = walker(straight((-1, 0), (0.3, 0)), TIMES_S[:60])
    scene = observe(rig, [person], rng, miss=0.0, spurious=0.3)
    tracker = Tracker(rig, BODY25, subjects=[Subject(name="ann")])
    for frame, detections in enumerate(scene.detections):
        predicted = {0: person[frame]} if frame else {}
        (update,) = tracker.update(detections, predicted, detections.timestamp_ns)
        assert update.name == "ann" and update.state is TrackState.CONFIRMED
        assert scene.owner[frame][0][update.person[0]] == 0
        assert np.isnan(update.landmarks_in_world_m).all()


def test_nothing_seen_is_ordinary():
    rig = ring_of_cameras(3)
    nobody = tuple(np.zeros((0, 25, 3)) for _ in rig.cameras)
    assert Tracker(rig, BODY25).update(Detections(timestamp_ns=0, people=nobody), {}, 0) == []
    blank = tuple(np.full((2, 25, 3), np.nan) for _ in rig.cameras)
    assert Tracker(rig, BODY25).update(Detections(timestamp_ns=0, people=blank), {}, 0) == []
    alone = Tracker(ring_of_cameras(1), BODY25)
    assert alone.update(Detections(timestamp_ns=0, people=nobody[:1]), {}, 0) == []


def test_same_input_gives_the_same_tracks():
    rig = ring_of_cameras(4)
    scene = observe(rig, six_people(), np.random.default_rng(5))
    first, _ = run(Tracker(rig, BODY25), scene)
    second, _ = run(Tracker(rig, BODY25), scene)
    for a, b in zip(first, second, strict=True):
        assert [u.track_id for u in a] == [u.track_id for u in b]
        for one, other in zip(a, b, strict=True):
            np.testing.assert_array_equal(one.landmarks_in_world_m, other.landmarks_in_world_m)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: TrackerOptions(max_subjects=0), "max_subjects is 0"),
        (lambda: TrackerOptions(volume_m=(1.0, -1.0, 0.0, 2.0)), "capture volume"),
        (
            lambda: Tracker(ring_of_cameras(1), BODY25, TrackerOptions(max_subjects=2)),
            "one camera cannot tell 2 people apart",
        ),
        (
            lambda: Tracker(ring_of_cameras(2), BODY25, subjects=[Subject(name="a")] * 2),
            "two subjects are called a",
        ),
        (
            lambda: PaperSorter(ring_of_cameras(2), BODY25, [Subject(name="a")]),
            "start position for subject 'a'",
        ),
        (
            lambda: PaperSorter(
                ring_of_cameras(1), BODY25, [Subject(name="a", start_m=(0.0, 0.0))]
            ),
            "at least two cameras",
        ),
    ],
)
def test_misuse_says_what_to_do(make, message):
    with pytest.raises(SessionError, match=message):
        make()


# --------------------------------------------------------------------------------- Algorithm 1


def test_algorithm_1_sorts_two_who_keep_apart(rng):
    rig = ring_of_cameras(4)
    ann = Subject(name="ann", start_m=(-3.0, 0.75))
    bob = Subject(name="bob", start_m=(3.0, -0.75))
    scene = observe(rig, two_who_pass(1.5), rng)
    history, score = run(PaperSorter(rig, BODY25, [ann, bob]), scene)
    assert score.person_of == {0: 0, 1: 1}
    assert score.switches == 0 and score.wrong <= 0.01 * score.assigned
    assert score.seen_share > 0.9
    assert [u.name for u in history[0]] == ["ann", "bob"]


def test_algorithm_1_drops_whom_nobody_designated(rng):
    rig = ring_of_cameras(4)
    subjects = [Subject(name="ann", start_m=(-3.0, 0.75))]
    _, score = run(PaperSorter(rig, BODY25, subjects), observe(rig, two_who_pass(1.5), rng))
    assert score.person_of == {0: 0}


def test_algorithm_1_gives_nothing_when_the_closest_is_used(rng):
    """As printed: the second subject does not fall back to another candidate."""
    rig = ring_of_cameras(4)
    people = [
        walker(straight((0, 0), (0, 0)), TIMES_S[:1]),
        walker(straight((1.2, 0), (0, 0)), TIMES_S[:1]),
    ]
    scene = observe(rig, people, rng, miss=0.0, spurious=0.0)
    subjects = [Subject(name="ann", start_m=(0.1, 0.0)), Subject(name="bob", start_m=(0.4, 0.0))]
    updates = PaperSorter(rig, BODY25, subjects).update(scene.detections[0], {}, 0)
    assert [u.name for u in updates] == ["ann"]


def test_algorithm_1_coasts_while_nobody_is_seen(rng):
    rig = ring_of_cameras(4)
    sorter = PaperSorter(rig, BODY25, [Subject(name="ann", start_m=(-3.0, 0.75))])
    scene = observe(rig, two_who_pass(1.5), rng)
    sorter.update(scene.detections[0], {}, 0)
    nobody = Detections(timestamp_ns=1, people=(np.zeros((0, 25, 3)),) * 4)
    (update,) = sorter.update(nobody, {}, 1)
    assert update.state is TrackState.COASTING and np.all(update.person == -1)


def test_algorithm_1_reports_subjects_after_one_who_is_not_there_yet(rng):
    rig = ring_of_cameras(4)
    subjects = [Subject(name="ann", start_m=(9.0, 9.0)), Subject(name="bob", start_m=(3.0, -0.75))]
    scene = observe(rig, two_who_pass(1.5), rng)
    updates = PaperSorter(rig, BODY25, subjects).update(scene.detections[0], {}, 0)
    assert [update.name for update in updates] == ["bob"]
