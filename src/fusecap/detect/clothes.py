"""What people wear, out of the pictures in which they were found (`fusecap.appearance`).

Torso: the quadrangle of shoulders and hips, and a band down its middle for who is seen from the
side. Thighs: a band along each, from hip to knee. A part counts where its keypoints are sure, it
lies in the picture and nobody else who was found is near it: what is not surely somebody's own is
left out. What nobody found, a pillar or a table, is not noticed.
"""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from fusecap.appearance import (
    CHROMA_SIZE,
    HUES,
    LIGHTNESSES,
    PART_SIZE,
    unknown,
)
from fusecap.body.landmarks import LandmarkSet

SURE = 0.35
"""Confidence from which a keypoint may bound a part."""
INSET = 0.15
"""Of the quadrangle's and bands' ends: edges are background, arms and other clothes."""
TORSO_BAND, THIGH_BAND = 0.25, 0.22
"""Widths, of the torso's and of the thigh's length."""
MARGIN = 0.05
"""Of others' extent, around them."""
_MOST_SIDE = 32
"""Pixels that a part is looked at with, at most so many across."""
_FEWEST = 24
"""Pixels that say something."""
_MIDDLE_SIDE = 64
"""Pixels across of the picture, for its middle lightness."""
_GREY_BELOW, _COLOURED_FROM = 35.0, 95.0
"""Saturation, of 255, between which a pixel turns from colourless to coloured."""
_STRONG_FROM, _STRONGEST = 90.0, 200.0
_STOPS_APART = 2.0
"""Between the middles of dark, middle and light."""
_BODY = ("left_shoulder", "right_shoulder", "left_hip", "right_hip", "left_knee", "right_knee")


class ClothesReader:
    """Descriptors of people whose keypoints are of one landmark set."""

    def __init__(self, landmarks: LandmarkSet) -> None:
        self._rows = np.array([landmarks.landmark_names.index(name) for name in _BODY])

    def read(
        self, image: UInt8[np.ndarray, "h w 3"], people: Float[np.ndarray, "n k 3"]
    ) -> UInt8[np.ndarray, "n 40"]:
        """Of everybody found in a picture (BGR); zeros for what was not surely seen alone."""
        found = unknown(len(people))
        if not len(people) or not image.size:
            return found
        middle = _middle_lightness(image)
        corners = people[:, self._rows]
        sure = (corners[:, :, 2] >= SURE) & np.isfinite(corners[:, :, 0])
        points = corners[:, :, :2]
        others = [_box(person) for person in people]
        for n in range(len(people)):
            apart = [box for m, box in enumerate(others) if m != n and box is not None]
            torso = self._torso(points[n]) if sure[n, :4].all() else []
            thighs = [
                _band(points[n, hip], points[n, hip + 2], THIGH_BAND)
                for hip in (2, 3)
                if sure[n, hip] and sure[n, hip + 2]
            ]
            found[n] = np.concatenate(
                [_part(image, torso, apart, middle), _part(image, thighs, apart, middle)]
            )
        return found

    @staticmethod
    def _torso(points: np.ndarray) -> list[np.ndarray]:
        ring = points[[0, 1, 3, 2]]
        quadrangle = ring + INSET * (ring.mean(axis=0) - ring)
        neck, hips = points[:2].mean(axis=0), points[2:4].mean(axis=0)
        return [quadrangle, _band(neck, hips, TORSO_BAND)]


def _band(start: np.ndarray, end: np.ndarray, width: float) -> np.ndarray:
    """A rectangle (4, 2) along the middle of a limb, as wide as `width` times its length."""
    along = end - start
    side = 0.5 * width * np.array([-along[1], along[0]])
    first, last = start + INSET * along, end - INSET * along
    return np.stack([first - side, first + side, last + side, last - side])


def _box(person: np.ndarray) -> np.ndarray | None:
    """Where somebody is (x, y; x, y), a little wider; None for nobody."""
    xy = person[person[:, 2] > 0, :2]
    xy = xy[np.isfinite(xy[:, 0])]
    if not len(xy):
        return None
    low, high = xy.min(axis=0), xy.max(axis=0)
    more = MARGIN * float((high - low).max())
    return np.stack([low - more, high + more])


def _part(
    image: np.ndarray, areas: list[np.ndarray], others: list[np.ndarray], middle: float
) -> np.ndarray:
    """One part's numbers (20,), of all its areas together."""
    nothing = np.zeros(PART_SIZE, np.uint8)
    if not areas:
        return nothing
    together = np.concatenate(areas)
    low, high = together.min(axis=0), together.max(axis=0)
    size = np.array([image.shape[1], image.shape[0]])
    if (low < 0).any() or (high > size - 1).any():
        return nothing
    if any((low <= box[1]).all() and (high >= box[0]).all() for box in others):
        return nothing
    x, y = np.floor(low).astype(int)
    right, bottom = np.ceil(high).astype(int) + 1
    step = max(1, int(max(right - x, bottom - y)) // _MOST_SIDE)
    crop = np.ascontiguousarray(image[y:bottom:step, x:right:step])
    mask = np.zeros(crop.shape[:2], np.uint8)
    for area in areas:
        cv2.fillPoly(mask, [np.round((area - [x, y]) / step).astype(np.int32)], 1)
    pixels = crop[mask > 0]
    return _numbers(pixels, middle) if len(pixels) >= _FEWEST else nothing


def _numbers(pixels: np.ndarray, middle: float) -> np.ndarray:
    hue, saturation, lightness = (
        cv2.cvtColor(pixels[None], cv2.COLOR_BGR2HSV)[0].astype(np.float64).T
    )
    coloured = _ramp(saturation, _GREY_BELOW, _COLOURED_FROM) * _ramp(lightness, 10.0, 50.0)
    strong = _ramp(saturation, _STRONG_FROM, _STRONGEST)
    chroma = np.zeros(CHROMA_SIZE)
    place = hue * HUES / 180.0
    first = np.floor(place).astype(int)
    for bin_, share in ((first, 1.0 - (place - first)), (first + 1, place - first)):
        weight = coloured * share
        bins = 2 * (bin_ % HUES)
        chroma += np.bincount(bins, weight * (1.0 - strong), CHROMA_SIZE)
        chroma += np.bincount(bins + 1, weight * strong, CHROMA_SIZE)
    chroma[-1] = (1.0 - coloured).sum()
    stops = np.log2(np.maximum(lightness, 2.0) / middle) / _STOPS_APART + 1.0
    stops = np.clip(stops, 0.0, LIGHTNESSES - 1.0)
    below = np.minimum(stops.astype(int), LIGHTNESSES - 2)
    light = np.bincount(below, 1.0 - (stops - below), LIGHTNESSES)
    light += np.bincount(below + 1, stops - below, LIGHTNESSES)
    rows = np.concatenate([chroma / chroma.sum(), light / light.sum()])
    return np.round(255.0 * rows).astype(np.uint8)


def _ramp(values: np.ndarray, low: float, high: float) -> np.ndarray:
    return np.clip((values - low) / (high - low), 0.0, 1.0)


def _middle_lightness(image: np.ndarray) -> float:
    """Median of a thinned picture's lightness (HSV), 1-255."""
    step = max(1, max(image.shape[:2]) // _MIDDLE_SIDE)
    return max(float(np.median(image[::step, ::step].max(axis=2))), 1.0)
