"""What is no person, or not the person one thinks. Built input, simulated; no solver."""

from __future__ import annotations

from collections import Counter

import numpy as np
import pytest

from fusecap.associate.options import TrackerOptions
from fusecap.associate.subjects import Subject
from fusecap.associate.tracker import Tracker
from fusecap.body.skeleton import PAPER21
from fusecap.types import ImuReading, TrackState
from people_scene import (
    BODY25,
    RATE_HZ,
    circle,
    observe,
    ring_of_cameras,
    run,
    straight,
    walker,
    walker_with_turns,
)

WORN = ("hips", "left_forearm", "right_forearm", "left_shank", "right_shank", "head")
RIG = ring_of_cameras(4)
AWAY = slice(90, 180)
"""Longer than a track lasts unseen."""


def times_s(seconds: float) -> np.ndarray:
    return np.arange(round(seconds * RATE_HZ)) / RATE_HZ


def readings_of(turns: np.ndarray, frame: int) -> ImuReading:
    bones = [PAPER21.bone(name) for name in WORN]
    return ImuReading(
        bone_rotation_in_world=turns[frame, bones], accel_in_world_m_s2=np.zeros((len(WORN), 3))
    )


def names_of(tracker, scene, readings=lambda frame: {}):
    """Per instant, by name, who most of a subject's detections show; and all notes."""
    history, notes = [], []
    for frame, (detections, owner) in enumerate(zip(scene.detections, scene.owner, strict=True)):
        tracker.hear(readings(frame))
        here = {}
        for update in tracker.update(detections, {}, detections.timestamp_ns):
            shown = [int(owner[c][n]) for c, n in enumerate(update.person) if n >= 0]
            if update.state is not TrackState.TENTATIVE and shown:
                here[update.name] = Counter(shown).most_common(1)[0][0]
        history.append(here)
        notes += tracker.notes
    return history, notes


def wearers(*names: str) -> list[Subject]:
    return [Subject(name=name, sensors=WORN) for name in names]


def test_two_who_exchange_sensors_in_a_break_exchange_names(rng):
    """Both leave; anna's sensors come back on ben's body: who wears them is anna from then on."""
    t = times_s(10.0)
    people = [walker_with_turns(circle(1.2, phase, 0.6), t, 1.75) for phase in (0.0, np.pi)]
    away = lambda person, camera, frame: AWAY.start <= frame < AWAY.stop  # noqa: E731
    scene = observe(RIG, [landmarks for landmarks, _ in people], rng, hidden=away)

    def readings(frame: int) -> dict[str, ImuReading]:
        worn_by = (0, 1) if frame < AWAY.start else (1, 0)
        return {
            name: readings_of(people[person][1], frame)
            for name, person in zip(("anna", "ben"), worn_by, strict=True)
        }

    history, _ = names_of(Tracker(RIG, BODY25, None, wearers("anna", "ben")), scene, readings)
    assert history[AWAY.start - 1] == {"anna": 0, "ben": 1}
    assert all(here == {"anna": 1, "ben": 0} for here in history[AWAY.stop + 60 :])


@pytest.mark.parametrize("order", [(0, 1, 2), (2, 0, 1), (1, 2, 0)])
def test_all_who_leave_and_return_in_another_order_keep_the_names_of_their_sensors(order):
    """Out by one side, back by others, one after the other; alike in size."""
    t = times_s(9.0)
    people = [walker_with_turns(circle(1.2, 2.1 * k, 0.6), t, 1.7) for k in range(3)]

    def hidden(person, camera, frame):
        return AWAY.start <= frame < AWAY.stop + 20 * order.index(person)

    scene = observe(RIG, [p for p, _ in people], np.random.default_rng(3), hidden=hidden)
    names = ("anna", "ben", "cy")

    def readings(frame):
        return {name: readings_of(p[1], frame) for name, p in zip(names, people, strict=True)}

    history, _ = names_of(Tracker(RIG, BODY25, None, wearers(*names)), scene, readings)
    truth = dict(zip(names, range(3), strict=True))
    assert all(here.items() <= truth.items() for here in history)
    assert history[AWAY.start - 1] == history[-1] == truth


def standing(place=(1.5, 1.0)) -> np.ndarray:
    """A mannequin: one pose, one place."""
    t = times_s(6.0)
    return np.repeat(walker(straight(place, (0.0, 0.0)), t[:1]), len(t), axis=0)


def mirrored(landmarks: np.ndarray, x_m: float) -> np.ndarray:
    """What a mirror in the plane x = x_m shows, with left and right as a detector calls them."""
    image = landmarks[:, BODY25.mirror].copy()
    image[..., 0] = 2 * x_m - image[..., 0]
    return image


def on_the_wall(landmarks: np.ndarray, z_m: float) -> np.ndarray:
    """A picture of somebody, in a wall's plane."""
    flat = np.repeat(landmarks[:1], len(landmarks), axis=0).copy()
    flat[..., 2] = z_m
    return flat


ODD = {
    "a mannequin": lambda person: standing(),
    "a mirror": lambda person: mirrored(person, 2.0),
    "a picture on the wall": lambda person: on_the_wall(person, 2.4),
}


@pytest.mark.parametrize("odd", ODD)
@pytest.mark.parametrize("first", [False, True])
def test_what_only_looks_like_a_person_never_gets_a_wearers_name(odd, first):
    """Also where it is there first, and alone."""
    t = times_s(6.0)
    landmarks, turns = walker_with_turns(circle(1.0, 0.0, 0.8), t)
    scene = observe(
        RIG,
        [landmarks, ODD[odd](landmarks)],
        np.random.default_rng(5),
        hidden=lambda person, camera, frame: first and person == 0 and frame < 45,
    )
    tracker = Tracker(RIG, BODY25, TrackerOptions(max_subjects=1), wearers("anna"))
    history, _ = names_of(tracker, scene, lambda frame: {"anna": readings_of(turns, frame)})
    late = history[45 + 40 :]
    assert all(here == {"anna": 0} for here in late), Counter(map(str, late))


@pytest.mark.parametrize("odd", ODD)
def test_what_only_looks_like_a_person_stays_outside_the_volume(odd):
    t = times_s(6.0)
    landmarks = walker(circle(0.6, 0.0, 0.8), t)
    scene = observe(RIG, [landmarks, ODD[odd](landmarks)], np.random.default_rng(5))
    tracker = Tracker(RIG, BODY25, TrackerOptions(volume_m=(-1.2, 1.2, -0.9, 0.9)))
    history, _ = names_of(tracker, scene)
    assert {who for here in history for who in here.values()} == {0}


def test_a_person_whom_one_view_shows_twice_is_one(rng):
    """A network's double of everybody in the first camera, a hand's breadth beside."""
    t = times_s(6.0)
    people = [walker(circle(1.0, phase, 0.8), t) for phase in (0.0, np.pi)]
    scene = observe(RIG, people, rng)
    for frame, detections in enumerate(scene.detections):
        doubles = detections.people[0] + np.array([8.0, 5.0, 0.0]) * (detections.people[0] > 0)
        both = np.concatenate([detections.people[0], doubles])
        object.__setattr__(detections, "people", (both, *detections.people[1:]))
        scene.owner[frame][0] = np.tile(scene.owner[frame][0], 2)
    _, score = run(Tracker(RIG, BODY25), scene)
    assert len(score.names) == 2 and score.switches == 0 and score.wrong == 0


def test_who_stands_beside_a_start_is_not_taken_for_who_begins_there_and_is_found_later(rng):
    """The subject is detected half a second after somebody 0.8 m from its start."""
    t = times_s(3.0)
    people = [walker(straight(place, (0.0, 0.0)), t) for place in ((0.0, 0.0), (0.8, 0.0))]
    late = lambda person, camera, frame: person == 0 and frame < 15  # noqa: E731
    scene = observe(RIG, people, rng, hidden=late)
    tracker = Tracker(RIG, BODY25, None, [Subject(name="anna", start_m=(0.0, 0.0))])
    history, _ = names_of(tracker, scene)
    assert {who for here in history for who in here.values()} == {0} and history[30:] == [
        {"anna": 0}
    ] * len(history[30:])


def test_somebody_alone_within_a_metre_of_a_start_begins_there_after_a_second(rng):
    t = times_s(3.0)
    scene = observe(RIG, [walker(straight((0.8, 0.0), (0.0, 0.0)), t)], rng)
    tracker = Tracker(RIG, BODY25, None, [Subject(name="anna", start_m=(0.0, 0.0))])
    history, _ = names_of(tracker, scene)
    assert history[-1] == {"anna": 0}
    assert 0.9 < next(f for f, here in enumerate(history) if here) / RATE_HZ < 1.3
