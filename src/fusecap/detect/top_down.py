"""People's boxes first, then the keypoints of each: the detector for a few people in many views.

Running the person detector on every view is what costs most, and it is hardly ever needed: where
people are is known from where they were. So boxes come from the keypoints expected in each view
(projected from predicted skeletons, and those of the instant before), and the person detector runs
every `person_every` instants, and soon in a view where someone expected was not found. Where it
then finds nobody new either, as with people behind a wall, the view's next extra run waits 2, 4,
... instants, at most `person_every`.

All views are searched at the first instant, then in turn, so that instants take about equally long:
of four views with `person_every` 10 one 3 instants later, the others 5, 8 and 10. Extra runs are
one per instant, and only where no view has its turn.

All crops of all views of an instant go through the pose network as one batch. A crop of one of two
people who overlap may show both, and the network then may answer with the other one: of sets of
keypoints that are alike (`fusecap.detect.people.similarity`) only the most confident stays.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float, UInt8

from fusecap.body.landmarks import LandmarkSet
from fusecap.detect.detector import REVISION
from fusecap.detect.people import (
    areas,
    bounds,
    distinct,
    overlaps,
    similarity,
    within,
)

SAME_BOX = 0.5
"""Overlap of boxes about one person."""
SAME_CROP = 0.8
"""Overlap of boxes whose crops would show the same; of a box found and one expected that differ by
more both are tried, for a box found about two people must not replace those of either."""
_LEAST_BOX_PX = 8.0
_PART_IN_VIEW = 0.3
"""Of an expected person's box: less of it in the image, and nobody misses them."""
_ELSEWHERE = 0.1
"""Overlap of boxes below which they are not about one person, however fast it moved."""
_SAME_EXPECTED = 0.5
"""Similarity of an expected person to the one of the instant before, when they are one."""


@runtime_checkable
class PersonFinder(Protocol):
    """Boxes of people in whole images."""

    @property
    def identity(self) -> str:
        """Networks and options."""
        ...

    def find(
        self, images: Sequence[UInt8[np.ndarray, "_ _ 3"]]
    ) -> tuple[Float[np.ndarray, "_ 5"], ...]:
        """Per image x0, y0, x1, y1 [px] and score."""
        ...


@runtime_checkable
class KeypointFinder(Protocol):
    """Keypoints of the person in each box."""

    @property
    def landmarks(self) -> LandmarkSet:
        """What the keypoints are."""
        ...

    @property
    def identity(self) -> str:
        """Network and options."""
        ...

    def keypoints(
        self,
        images: Sequence[UInt8[np.ndarray, "_ _ 3"]],
        boxes: Sequence[Float[np.ndarray, "_ 4"]],
    ) -> tuple[Float[np.ndarray, "_ k 3"], ...]:
        """Per image x, y [px] and confidence 0-1."""
        ...


class TopDownDetector:
    """Person detector now and then, pose network always."""

    def __init__(
        self,
        person: PersonFinder,
        pose: KeypointFinder,
        person_every: int = 10,
        *,
        follow_others: bool = True,
    ) -> None:
        """Bystanders cost little without `follow_others`.

        As soon as somebody is predicted in some view, whom nobody predicts is then looked at only
        when the person detector runs.
        """
        self._person = person
        self._pose = pose
        self._person_every = person_every
        self._follow_others = follow_others
        self.reset()

    @property
    def landmarks(self) -> LandmarkSet:
        """What the keypoints are."""
        return self._pose.landmarks

    @property
    def identity(self) -> str:
        """Networks by name and checksum, the options that change results, and the revision."""
        networks = f"{self._pose.identity}; {self._person.identity}"
        return f"{networks}; every {self._person_every}; revision {REVISION}"

    def reset(self) -> None:
        """Forget earlier instants: the next one looks for everyone anew."""
        self._instant = 0
        self._turn: list[int] = []
        self._last: list[np.ndarray] = []
        self._wait: list[int] = []
        self._patience: list[int] = []

    def detect(
        self,
        images: Sequence[UInt8[np.ndarray, "_ _ 3"] | None],
        predicted: Sequence[Float[np.ndarray, "_ k 3"]],
    ) -> tuple[Float[np.ndarray, "_ k 3"], ...]:
        """Per camera the people: x, y [px], confidence 0-1; NaN, NaN, 0 if missing."""
        if len(self._last) != len(images):
            self.reset()
            self._last = [self._nobody()] * len(images)
            self._wait = [0] * len(images)
            self._patience = [1] * len(images)
            self._turn = [-1] * len(images)
        present = [i for i, image in enumerate(images) if image is not None]
        shown = [image for image in images if image is not None]
        others = self._follow_others or not any(len(those) for those in predicted)
        expected = [
            _expected(_known(predicted[i], self._last[i], others=others), image)
            for i, image in zip(present, shown, strict=True)
        ]
        boxes = [expected_boxes for expected_boxes, _ in expected]
        due = [row for row, i in enumerate(present) if self._is_its_turn(i)]
        self._instant += 1
        found = self._person.find([shown[row] for row in due]) if due else ()
        for row, found_boxes in zip(due, found, strict=True):
            boxes[row] = _refreshed(boxes[row], found_boxes[:, :4])
        people = self._poses(shown, boxes)
        missing = (
            row
            for row, (i, (_, count)) in enumerate(zip(present, expected, strict=True))
            if row not in due and len(people[row]) < count and self._may_search(i)
        )
        again = list(itertools.islice(missing, 0 if due else 1))
        if again:
            self._search_again(again, present, shown, people)
        result = [self._nobody()] * len(images)
        for i, those in zip(present, people, strict=True):
            result[i] = those
        self._last = result
        return tuple(result)

    def _is_its_turn(self, view: int) -> bool:
        """Whether `person_every` instants brought the view's next search, which is now taken."""
        ahead = view * self._person_every // len(self._turn)
        turn = (self._instant + ahead) // self._person_every
        is_next = turn > self._turn[view]
        self._turn[view] = turn
        return is_next

    def _search_again(
        self,
        rows: list[int],
        present: list[int],
        images: list[np.ndarray],
        people: list[np.ndarray],
    ) -> None:
        """Look for more people in some of the views, adding to `people`."""
        some = [images[row] for row in rows]
        found = self._person.find(some)
        fresh = [
            _not_among(boxes[:, :4], bounds(people[row]))
            for row, boxes in zip(rows, found, strict=True)
        ]
        for row, more in zip(rows, self._poses(some, fresh), strict=True):
            both = np.concatenate([people[row], more])
            kept = both[distinct(both)]
            view = present[row]
            if len(kept) > len(people[row]):
                self._wait[view], self._patience[view] = 0, 1
            else:
                self._patience[view] = min(2 * self._patience[view], self._person_every)
                self._wait[view] = self._patience[view]
            people[row] = kept

    def _may_search(self, view: int) -> bool:
        self._wait[view] -= 1
        return self._wait[view] < 0

    def _poses(self, images: Sequence[np.ndarray], boxes: list[np.ndarray]) -> list[np.ndarray]:
        people = []
        for image, those in zip(images, self._pose.keypoints(images, boxes), strict=True):
            inside = within(those, (image.shape[1], image.shape[0]))
            people.append(inside[distinct(inside)])
        return people

    def _nobody(self) -> np.ndarray:
        return np.empty((0, len(self.landmarks.landmark_names), 3))


def _known(
    predicted: Float[np.ndarray, "m k 3"], last: Float[np.ndarray, "n k 3"], *, others: bool
) -> Float[np.ndarray, "p k 3"]:
    """The predicted people, and those of the instant before whom nobody predicted.

    Without `others` only those of them who may be a predicted one after all.
    """
    if not len(predicted) or not len(last):
        return last if others and not len(predicted) else predicted
    overlap = overlaps(np.nan_to_num(bounds(last)), np.nan_to_num(bounds(predicted))).max(axis=1)
    known = (similarity(last, predicted).max(axis=1) > _SAME_EXPECTED) | (overlap > SAME_BOX)
    if not others:
        known |= overlap < _ELSEWHERE
    return np.concatenate([predicted, last[~known]])


def _expected(people: np.ndarray, image: np.ndarray) -> tuple[np.ndarray, int]:
    """Boxes of those who show in the image, and how many of them it shows for the most part."""
    boxes = bounds(people)
    boxes = boxes[np.isfinite(boxes).all(axis=1)]
    limit = np.array([image.shape[1], image.shape[0]]) - 0.5
    clipped = np.clip(boxes.reshape(-1, 2, 2), -0.5, limit).reshape(-1, 4)
    share = areas(clipped) / np.maximum(areas(boxes), 1e-9)
    usable = np.all(clipped[:, 2:] - clipped[:, :2] >= _LEAST_BOX_PX, axis=1)
    return clipped[usable], int(np.sum(usable & (share >= _PART_IN_VIEW)))


def _refreshed(
    boxes: Float[np.ndarray, "n 4"], found: Float[np.ndarray, "m 4"]
) -> Float[np.ndarray, "p 4"]:
    """The boxes found, and those expected that show something else."""
    return np.concatenate([found, _not_among(boxes, found, SAME_CROP)])


def _not_among(
    boxes: Float[np.ndarray, "n 4"],
    others: Float[np.ndarray, "m 4"],
    same: float = SAME_BOX,
) -> Float[np.ndarray, "p 4"]:
    if not len(boxes) or not len(others):
        return boxes
    return boxes[np.nan_to_num(overlaps(boxes, others)).max(axis=1) <= same]
