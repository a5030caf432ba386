"""The top-down detector with a person detector and a pose network that know the truth."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest

from fusecap.body.landmarks import LANDMARK_SETS, LandmarkSet
from fusecap.detect.people import bounds, overlaps
from fusecap.detect.top_down import TopDownDetector

COCO = LANDMARK_SETS["coco17"]
NOBODY = np.empty((0, 17, 3))
PERSON = np.array(
    [[0.0, -0.45], [0.02, -0.47], [-0.02, -0.47], [0.04, -0.46], [-0.04, -0.46]]
    + [[0.12, -0.32], [-0.12, -0.32], [0.16, -0.13], [-0.16, -0.13], [0.17, 0.02], [-0.17, 0.02]]
    + [[0.08, 0.0], [-0.08, 0.0], [0.09, 0.22], [-0.09, 0.22], [0.08, 0.46], [-0.08, 0.46]]
)


def person(x: float, y: float = 500.0, height: float = 400.0) -> np.ndarray:
    return np.concatenate([PERSON * height + [x, y], np.full((17, 1), 0.9)], axis=1)


class World:
    """Views of 1000 x 1000 px, named by their first pixel; both networks look the answer up."""

    def __init__(self, views: int) -> None:
        self.people: list[list[np.ndarray]] = [[] for _ in range(views)]
        self.hidden_from_boxes: set[int] = set()
        self.searched: list[int] = []
        self.crops: list[int] = []

    @property
    def landmarks(self) -> LandmarkSet:
        return COCO

    @property
    def identity(self) -> str:
        return "truth"

    def images(self) -> list[np.ndarray]:
        images = [np.zeros((1000, 1000, 3), np.uint8) for _ in self.people]
        for view, image in enumerate(images):
            image[0, 0, 0] = view
        return images

    def find(self, images: Sequence[np.ndarray]) -> tuple[np.ndarray, ...]:
        found = []
        for image in images:
            view = int(image[0, 0, 0])
            self.searched.append(view)
            seen = [p for i, p in enumerate(self.people[view]) if i not in self.hidden_from_boxes]
            boxes = bounds(np.stack(seen)) if seen else np.empty((0, 4))
            found.append(np.concatenate([boxes, np.full((len(boxes), 1), 0.9)], axis=1))
        return tuple(found)

    def keypoints(
        self, images: Sequence[np.ndarray], boxes: Sequence[np.ndarray]
    ) -> tuple[np.ndarray, ...]:
        self.crops.append(sum(map(len, boxes)))
        result = []
        for image, those in zip(images, boxes, strict=True):
            everyone = self.people[int(image[0, 0, 0])]
            rows = []
            for box in those:
                shared = overlaps(box[None], bounds(np.stack(everyone)))[0] if everyone else [0.0]
                best = int(np.argmax(shared))
                ghost = person(float(box[[0, 2]].mean())) * [1.0, 1.0, 0.1]
                rows.append(everyone[best] if shared[best] > 0.3 else ghost)
            result.append(np.array(rows).reshape(-1, 17, 3))
        return tuple(result)


def run(detector: TopDownDetector, world: World, predicted=None) -> tuple[np.ndarray, ...]:
    return detector.detect(world.images(), predicted or [NOBODY] * len(world.people))


def test_views_are_searched_every_so_many_instants_in_turn():
    world = World(2)
    detector = TopDownDetector(world, world, person_every=5)
    searched = []
    for instant in range(12):
        world.people = [[person(300.0 + 5 * instant)], [person(600.0), person(200.0)]]
        found = run(detector, world)
        assert [len(people) for people in found] == [1, 2]
        np.testing.assert_array_equal(found[0][0], world.people[0][0])
        searched.append(world.searched.copy())
        world.searched.clear()
    assert searched == [[0, 1], [], [], [1], [], [0], [], [], [1], [], [0], []]
    assert world.crops == [3] * 12


def test_view_without_an_image_at_its_turn_is_searched_at_its_next_image():
    world = World(2)
    world.people = [[person(300.0)], [person(600.0)]]
    detector = TopDownDetector(world, world, person_every=4)
    searched = []
    for shown in ([0], [0], [0], [0, 1], [0, 1], [0], [0], [0, 1]):
        images = [image if view in shown else None for view, image in enumerate(world.images())]
        detector.detect(images, [NOBODY] * 2)
        searched.append(world.searched.copy())
        world.searched.clear()
    assert searched == [[0], [], [], [1], [0], [], [], [1]]


def test_everyone_goes_through_in_one_batch_and_a_missing_image_is_nobody():
    world = World(3)
    world.people = [[person(300.0)], [person(400.0)], [person(500.0)]]
    detector = TopDownDetector(world, world)
    images: list[np.ndarray | None] = list(world.images())
    images[1] = None
    found = detector.detect(images, [NOBODY] * 3)
    assert [len(people) for people in found] == [1, 0, 1]
    assert world.crops == [2]


def test_missing_person_is_looked_for_at_once_and_then_with_patience():
    world = World(1)
    world.people = [[person(300.0), person(700.0)]]
    detector = TopDownDetector(world, world, person_every=100)
    run(detector, world)
    expected = np.stack(world.people[0])
    world.people = [[person(300.0)]]
    world.searched.clear()
    when = []
    for instant in range(20):
        before = len(world.searched)
        assert len(run(detector, world, [expected])[0]) == 1
        when += [instant] * (len(world.searched) - before)
    assert when == [0, 3, 8, 17]


def test_person_who_jumped_is_found_again_in_the_same_instant():
    world = World(1)
    world.people = [[person(200.0)]]
    detector = TopDownDetector(world, world, person_every=100)
    run(detector, world)
    world.people = [[person(800.0)]]
    (found,) = run(detector, world)
    np.testing.assert_array_equal(found, [person(800.0)])


def test_person_who_left_the_image_is_not_missed():
    world = World(1)
    world.people = [[person(500.0)]]
    detector = TopDownDetector(world, world, person_every=100)
    run(detector, world)
    world.searched.clear()
    world.people = [[]]
    assert len(run(detector, world, [np.stack([person(1300.0)])])[0]) == 0
    assert world.searched == [0]  # for the one of the instant before
    for _ in range(5):
        run(detector, world, [np.stack([person(1300.0)])])
    assert world.searched == [0]


def test_prediction_finds_people_the_person_detector_never_boxed():
    world = World(1)
    world.people = [[person(300.0), person(345.0, 520.0)]]
    world.hidden_from_boxes = {1}
    detector = TopDownDetector(world, world, person_every=1)
    assert len(run(detector, world)[0]) == 1
    (found,) = run(detector, world, [np.stack([person(300.0), person(350.0, 515.0)])])
    assert len(found) == 2


@pytest.mark.parametrize("predict", [True, False])
def test_people_who_cross_both_stay(predict):
    world = World(1)
    detector = TopDownDetector(world, world, person_every=4)
    for instant in range(40):
        a = person(300.0 + 10.0 * instant)
        b = person(700.0 - 10.0 * instant, 530.0, 440.0)[COCO.mirror]  # walks the other way
        world.people = [[a, b]]
        predicted = [np.stack([a, b]) + [3.0, -2.0, 0.0]] if predict else None
        assert len(run(detector, world, predicted)[0]) == 2, instant


def test_nobody_known_by_prediction_is_followed_from_the_instant_before():
    world = World(1)
    detector = TopDownDetector(world, world, person_every=50)
    for instant in range(20):
        world.people = [[person(200.0 + 10 * instant), person(800.0)]]
        (found,) = run(detector, world, [np.stack([person(800.0)])])
        assert len(found) == 2
    assert world.searched == [0]


def test_keypoints_outside_the_image_are_missing():
    world = World(1)
    world.people = [[person(500.0, 850.0)]]
    (found,) = run(TopDownDetector(world, world), world)
    np.testing.assert_array_equal(np.isnan(found[0, :, 0]), found[0, :, 2] == 0.0)
    assert list(np.flatnonzero(found[0, :, 2] == 0.0)) == [15, 16]


def test_reset_forgets():
    world = World(1)
    world.people = [[person(500.0)]]
    detector = TopDownDetector(world, world, person_every=100)
    first = run(detector, world)
    run(detector, world)
    detector.reset()
    again = run(detector, world)
    assert world.searched == [0, 0]
    np.testing.assert_array_equal(first[0], again[0])
