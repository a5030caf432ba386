"""Bodies of another size are told apart after an overlap; of one size nobody is moved."""

from __future__ import annotations

import numpy as np
import pytest

from fusecap.associate import sizes
from fusecap.associate.looks import CLOTHES, looks
from fusecap.associate.track import Track
from fusecap.associate.traits import DOUBT_S, NEAR_M, doubt, exchange, exchanged

LIMBS = np.array([0.35, 0.25, 0.5, 0.3, 0.28, 0.42, 0.4])
INSTANT_NS = 40_000_000


class Scene:
    """Two people who are measured, overlap, and are measured again."""

    def __init__(self, *lengths_m):
        self.lengths_m = [np.array(some) for some in lengths_m]
        self.tracks = [Track(n, np.zeros((25, 3)), np.zeros(3), LIMBS, 0) for n in range(2)]
        self.now_ns = 0
        self.rng = np.random.default_rng(3)

    def go_on(self, instants, *, apart_m=3.0, crossed=False, views=3):
        centre_m = np.array([[0.0, 0.0, 0.0], [apart_m, 0.0, 0.0]])
        order = (1, 0) if crossed else (0, 1)
        for _ in range(instants):
            self.now_ns += INSTANT_NS
            for track in self.tracks:
                track.triangulated_ns = self.now_ns
            measured = np.array([self.lengths_m[body] for body in order])
            measured += 0.02 * self.rng.standard_normal(measured.shape)
            doubt(self.tracks, centre_m, self.now_ns)
            sizes.learn(self.tracks, measured, np.array([views, views]), 3, self.now_ns)

    def moves(self):
        return exchanged(sizes.SIZES, self.tracks, self.now_ns)


def test_two_who_came_out_of_an_overlap_exchanged_are_found_out_once():
    scene = Scene(LIMBS, 1.09 * LIMBS)
    scene.go_on(60)
    scene.go_on(10, apart_m=0.5 * NEAR_M)
    scene.go_on(20, crossed=True)
    assert not scene.moves(), "too few instants"
    scene.go_on(20, crossed=True)
    first, second = scene.tracks
    assert scene.moves() == {first: second, second: first}
    exchange(scene.moves())
    assert not scene.moves()
    scene.go_on(round(2 * DOUBT_S * 25), crossed=True)
    assert not scene.moves()


@pytest.mark.parametrize(
    ("other", "crossed", "views"),
    [(1.09, False, 3), (1.0, True, 3), (1.02, True, 3), (1.09, True, 2)],
    ids=["not exchanged", "one size", "nearly one size", "two views"],
)
def test_nobody_is_moved_without_evidence(other, crossed, views):
    scene = Scene(LIMBS, other * LIMBS)
    scene.go_on(60, views=views)
    scene.go_on(10, apart_m=0.5 * NEAR_M, views=views)
    scene.go_on(100, crossed=crossed, views=views)
    assert not scene.moves()


def test_a_third_body_is_not_made_one_of_the_two():
    scene = Scene(LIMBS, 1.09 * LIMBS)
    scene.go_on(60)
    scene.go_on(10, apart_m=0.5 * NEAR_M)
    scene.lengths_m = [1.3 * LIMBS, LIMBS]
    scene.go_on(60)
    assert not scene.moves()


def test_two_who_return_under_each_others_names_have_done_so_since_they_returned():
    scene = Scene(LIMBS, 1.09 * LIMBS)
    scene.go_on(60)
    before = [track.traits for track in scene.tracks]
    scene.now_ns += 10**10
    scene.tracks = [Track(n, np.zeros((25, 3)), np.zeros(3), LIMBS, scene.now_ns) for n in (3, 4)]
    returned_ns = scene.now_ns
    scene.go_on(10, crossed=True)
    for track, known in zip(scene.tracks, before, strict=True):
        track.continues(known, returned_ns)
    scene.go_on(10, crossed=True)
    assert not scene.moves()
    scene.go_on(20, crossed=True)
    first, second = scene.tracks
    assert scene.moves() == {first: second, second: first}
    assert {track.traits[sizes.NAME].alone_ns for track in scene.tracks} == {returned_ns}


def test_sizes_move_nobody_whose_clothes_are_as_before():
    scene = Scene(LIMBS, 1.09 * LIMBS)
    red, blue = np.zeros((2, *looks(1).known.shape))
    red[..., [0, -1]], blue[..., [5, -1]] = 1.0, 1.0

    def wear():
        for track, colour in zip(scene.tracks, (red, blue), strict=True):
            for _ in range(30):
                track.traits[CLOTHES.name].learn(colour)

    for track in scene.tracks:
        track.traits[CLOTHES.name] = looks(1)
    scene.go_on(60)
    wear()
    scene.go_on(10, apart_m=0.5 * NEAR_M)
    scene.go_on(40, crossed=True)
    wear()
    assert not exchanged(CLOTHES, scene.tracks, scene.now_ns)
    assert not scene.moves()


def test_what_was_not_in_doubt_does_not_move_with_the_names():
    scene = Scene(LIMBS, 1.09 * LIMBS)
    scene.go_on(60)
    first, second = scene.tracks
    known = first.traits[sizes.NAME].known.copy()
    exchange({first: second, second: first})
    assert np.array_equal(first.traits[sizes.NAME].known, known)
