"""Several views in one image, for networks whose cost does not depend on what is in it [1, 3.4].

A whole-image network is as slow on one small view as on a mosaic of eight, so all views of an
instant, or of two, go through it together. Each view is shrunk into its tile; tiles are apart by
`MARGIN_PX` of grey, so that resizing mixes no two views and boxes that reach over an edge can be
told. The price is resolution: four views of 1080x1920 in a canvas of 640x640 are 180x320 each.

What was found goes back exactly (`Placement`). A network may still see one person in two adjacent
tiles, or half of one:

- a box belongs to the tile that holds most of it, is cut at the tile's edge, and is dropped where
  that tile holds less than half;
- a person belongs to the tile that holds most of the confidence, and their keypoints elsewhere are
  missing.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, UInt8

from fusecap.body.landmarks import LandmarkSet
from fusecap.detect.images import GREY, Placement, draw, fitted
from fusecap.detect.one_stage import OneStageDetector
from fusecap.detect.people import areas, distinct, within
from fusecap.detect.person import PersonDetector
from fusecap.errors import InputError

MARGIN_PX = 16
"""Grey between tiles."""
INSTANTS = 2
"""Packed into one image by `PackedDetector.detect_instants` at most [1, 3.4]."""
_LEAST_IN_TILE = 0.5
"""Of a box's area, in its tile."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Packing:
    """Where each image lies on the mosaic."""

    canvas_size: tuple[int, int]
    """Width and height [px]."""
    image_sizes: tuple[tuple[int, int], ...]
    """Width and height of each image [px]."""
    tiles: tuple[Placement, ...]

    def pack(
        self, images: Sequence[UInt8[np.ndarray, "_ _ 3"] | None]
    ) -> UInt8[np.ndarray, "i j 3"]:
        """The mosaic; the tile of a missing image stays grey."""
        width, height = self.canvas_size
        canvas = np.full((height, width, 3), GREY, dtype=np.uint8)
        for image, tile in zip(images, self.tiles, strict=True):
            if image is not None:
                draw(canvas, image, tile)
        return canvas

    def boxes(self, on_canvas: Float[np.ndarray, "n 5"]) -> tuple[Float[np.ndarray, "_ 5"], ...]:
        """Boxes found on the mosaic, per image in its own pixels."""
        corners = self._corners()
        cut = np.concatenate(
            [
                np.maximum(on_canvas[:, None, :2], corners[None, :, :2]),
                np.minimum(on_canvas[:, None, 2:4], corners[None, :, 2:]),
            ],
            axis=2,
        )
        inside = areas(cut.reshape(-1, 4)).reshape(cut.shape[:2])
        owner = inside.argmax(axis=1)
        share = inside.max(axis=1) / np.maximum(areas(on_canvas[:, :4]), 1e-9)
        result = []
        for t, tile in enumerate(self.tiles):
            mine = (owner == t) & (share >= _LEAST_IN_TILE)
            points = tile.to_image(cut[mine, t].reshape(-1, 2, 2)).reshape(-1, 4)
            result.append(np.concatenate([points, on_canvas[mine, 4:5]], axis=1))
        return tuple(result)

    def people(
        self, on_canvas: Float[np.ndarray, "n k 3"]
    ) -> tuple[Float[np.ndarray, "_ k 3"], ...]:
        """People found on the mosaic, per image in its own pixels."""
        corners = self._corners()
        xy = on_canvas[:, None, :, :2]
        with np.errstate(invalid="ignore"):
            inside = np.all(
                (xy >= corners[None, :, None, :2]) & (xy <= corners[None, :, None, 2:]), axis=3
            )
        weight = np.sum(np.where(inside, on_canvas[:, None, :, 2], 0.0), axis=2)
        owner = weight.argmax(axis=1)
        result = []
        for t, (tile, size) in enumerate(zip(self.tiles, self.image_sizes, strict=True)):
            mine = on_canvas[(owner == t) & (weight[:, t] > 0.0)].copy()
            mine[:, :, :2] = tile.to_image(mine[:, :, :2])
            result.append(within(mine, size))
        return tuple(result)

    def _corners(self) -> Float[np.ndarray, "t 4"]:
        """Edges of the tiles on the mosaic."""
        return np.array([(*t.start, *np.add(t.start, t.size)) for t in self.tiles]) - 0.5


def plan(
    image_sizes: Sequence[tuple[int, int]], canvas_size: tuple[int, int], margin_px: int = MARGIN_PX
) -> Packing:
    """A grid of equal rooms whose smallest scale is as large as possible.

    Raises `InputError` where the canvas is too small for so many images.
    """
    count = len(image_sizes)
    best: tuple[float, tuple[Placement, ...]] = (0.0, ())
    for columns in range(1, count + 1):
        rows = math.ceil(count / columns)
        room = (
            (canvas_size[0] - (columns - 1) * margin_px) // columns,
            (canvas_size[1] - (rows - 1) * margin_px) // rows,
        )
        if min(room) < 1:
            continue
        tiles = tuple(
            fitted(
                size,
                room,
                (
                    (i % columns) * (room[0] + margin_px),
                    (i // columns) * (room[1] + margin_px),
                ),
            )
            for i, size in enumerate(image_sizes)
        )
        scale = min(min(tile.scale) for tile in tiles)
        if scale > best[0]:
            best = (scale, tiles)
    if not best[1]:
        raise InputError(
            f"{count} views do not fit into one image of {canvas_size[0]}x{canvas_size[1]} px; "
            "detect without packing"
        )
    return Packing(canvas_size=canvas_size, image_sizes=tuple(image_sizes), tiles=best[1])


class _Planner:
    """Packings by the sizes of their images."""

    def __init__(self, canvas_of: Callable[[tuple[int, int]], tuple[int, int]]) -> None:
        self._canvas_of = canvas_of
        self._plans: dict[tuple[tuple[int, int], ...], Packing] = {}

    def plan(self, sizes: tuple[tuple[int, int], ...]) -> Packing:
        if sizes not in self._plans:
            # Networks that take any size get a square: the grid decides the proportions.
            self._plans[sizes] = plan(sizes, self._canvas_of((1, 1)))
        return self._plans[sizes]


class PackedPersonDetector:
    """A person detector that sees all images in one."""

    def __init__(self, person: PersonDetector) -> None:
        self._person = person
        self._planner = _Planner(person.canvas_size)

    @property
    def identity(self) -> str:
        """The detector's, and that it is packed."""
        return f"{self._person.identity} packed"

    def find(
        self, images: Sequence[UInt8[np.ndarray, "_ _ 3"]]
    ) -> tuple[Float[np.ndarray, "_ 5"], ...]:
        """Per BGR image x0, y0, x1, y1 [px] and score 0-1."""
        if not images:
            return ()
        packing = self._planner.plan(_sizes(images))
        (found,) = self._person.find([packing.pack(images)])
        return packing.boxes(found)


class PackedDetector:
    """A one-stage detector that sees all views of one instant, or of two, in one image."""

    def __init__(self, detector: OneStageDetector) -> None:
        self._detector = detector
        self._planner = _Planner(detector.canvas_size)

    @property
    def landmarks(self) -> LandmarkSet:
        """What the keypoints are."""
        return self._detector.landmarks

    @property
    def identity(self) -> str:
        """The detector's, and that it is packed."""
        return f"{self._detector.identity} packed"

    def detect(
        self,
        images: Sequence[UInt8[np.ndarray, "_ _ 3"] | None],
        predicted: Sequence[Float[np.ndarray, "_ k 3"]],
    ) -> tuple[Float[np.ndarray, "_ k 3"], ...]:
        """Per camera everyone in the image; `predicted` is not needed."""
        return self.detect_instants([images])[0]

    def detect_instants(
        self, instants: Sequence[Sequence[UInt8[np.ndarray, "_ _ 3"] | None]]
    ) -> tuple[tuple[Float[np.ndarray, "_ k 3"], ...], ...]:
        """Per instant and camera everyone in the image; one run for at most `INSTANTS` instants."""
        if not 1 <= len(instants) <= INSTANTS:
            raise InputError(f"{len(instants)} instants in one image, expected 1 to {INSTANTS}")
        images = [image for instant in instants for image in instant]
        present = [image for image in images if image is not None]
        nobody = np.empty((0, len(self.landmarks.landmark_names), 3))
        result = [nobody] * len(images)
        if present:
            packing = self._planner.plan(_sizes(present))
            (found,) = self._detector.find([packing.pack(present)])
            where = [i for i, image in enumerate(images) if image is not None]
            for i, people in zip(where, packing.people(found), strict=True):
                result[i] = people[distinct(people)]
        ends = np.cumsum([0] + [len(instant) for instant in instants])
        return tuple(tuple(result[a:b]) for a, b in itertools.pairwise(ends))

    def reset(self) -> None:
        """Nothing to forget."""


def _sizes(images: Sequence[np.ndarray]) -> tuple[tuple[int, int], ...]:
    return tuple((image.shape[1], image.shape[0]) for image in images)
