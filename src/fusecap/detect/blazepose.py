"""MediaPipe's BlazePose: networks that come with the `mediapipe` wheel and npm's `@mediapipe/pose`.

| network | input | outputs |
|---|---|---|
| people | 224x224, -1 to 1 | (n, 2254, 12) a face's box and four points, (n, 2254, 1) its score |
| keypoints | 256x256, 0 to 1 | (n, 195) 39 points: x, y, z, visibility, presence; (n, 1) anybody |

Crops are square and lie along the body: the middle of the hips in the centre, and a second point
straight above it, so far away that a circle through it holds the whole body. Both are among the 39
points. So every person is looked at twice: the upright crop about the box says where these two are,
the second, turned, gives the keypoints. Layout and numbers are those of MediaPipe's graphs
`pose_detection_cpu` and `pose_landmark_by_roi_cpu`.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from fusecap.body.landmarks import LANDMARK_SETS
from fusecap.detect.images import Pixels, letterbox
from fusecap.detect.people import unsuppressed
from fusecap.detect.runtimes.network import Network

_POINTS = 39
_HIPS, _REACH = 33, 34
"""The two points that a crop is laid by."""
_PADDING = 1.25
"""Crop over the circle, as in training."""
_LEAST_FLAG = 0.1
"""Of an upright crop, below which it is not looked at again."""
_ANCHORS = ((8, 2), (16, 2), (32, 6))
"""Strides, and candidates per cell."""
_SIDE = 224
_LEAST_SCORE = 0.2
_MOST_OVERLAP = 0.3
"""Of two faces."""
_SLIM = 0.5
"""Width of a body over its length."""
_UNIT_RGB = Pixels(rgb=True, std=(255.0, 255.0, 255.0))
_SIGNED_RGB = Pixels(rgb=True, mean=(127.5, 127.5, 127.5), std=(127.5, 127.5, 127.5))


def finds_keypoints(network: Network) -> bool:
    """Whether the outputs are those of BlazePose's second network."""
    return (5 * _POINTS,) in _rows(network)


def finds_people(network: Network) -> bool:
    """Whether the outputs are those of its first."""
    return {(_count(), 12), (_count(), 1)} <= set(_rows(network))


def _rows(network: Network) -> list[tuple[int | None, ...]]:
    return [tensor.shape[1:] for tensor in network.outputs]


def _count() -> int:
    return sum(each * (_SIDE // stride) ** 2 for stride, each in _ANCHORS)


class BlazePose:
    """Keypoints of the person in each box."""

    landmarks = LANDMARK_SETS["blazepose33"]

    def __init__(self, network: Network) -> None:
        self._network = network
        self._points, self._flag = (
            next(t.name for t in network.outputs if t.shape[1:] == (size,))
            for size in (5 * _POINTS, 1)
        )
        assert network.input.shape[2] is not None
        self._side = network.input.shape[2]

    @property
    def identity(self) -> str:
        """The network's, and the size of crops."""
        return f"{self._network.identity} crop {_PADDING} turned"

    def keypoints(
        self,
        images: Sequence[UInt8[np.ndarray, "_ _ 3"]],
        boxes: Sequence[Float[np.ndarray, "_ 4"]],
    ) -> tuple[Float[np.ndarray, "_ k 3"], ...]:
        """Per image x, y [px] and confidence 0-1 of the person in each box.

        Keypoints may lie outside the image.
        """
        shown = [image for image, those in zip(images, boxes, strict=True) for _ in those]
        box = np.concatenate([np.empty((0, 4)), *boxes])
        centre, size = (box[:, :2] + box[:, 2:]) / 2.0, box[:, 2:] - box[:, :2]
        first = self._look(
            shown, centre, _PADDING * size.max(axis=1, initial=0.0), 0.0 * centre[:, 0]
        )
        hips, reach = first[:, _HIPS, :2], first[:, _REACH, :2] - first[:, _HIPS, :2]
        side = 2.0 * _PADDING * np.linalg.norm(reach, axis=1)
        again = np.flatnonzero((first[:, 0, 2] >= 0) & (side > 1.0))
        found = np.zeros((len(box), _POINTS, 3))
        found[again] = self._look(
            [shown[i] for i in again],
            hips[again],
            side[again],
            np.arctan2(reach[again, 0], -reach[again, 1]),
        )
        found[:, :, 2] = np.clip(found[:, :, 2], 0.0, 1.0)
        people = self.landmarks.of_keypoints(found[:, : self.landmarks.keypoint_count])
        return tuple(np.split(people, np.cumsum([len(those) for those in boxes])[:-1]))

    def _look(
        self,
        images: Sequence[np.ndarray],
        centre: Float[np.ndarray, "n 2"],
        side: Float[np.ndarray, " n"],
        turn: Float[np.ndarray, " n"],
    ) -> Float[np.ndarray, "n 39 3"]:
        """All points in squares turned clockwise [rad]; confidence -1 where nobody is."""
        if not images:
            return np.empty((0, _POINTS, 3))
        cos, sin = np.cos(turn), np.sin(turn)
        axes = np.array([[cos, -sin], [sin, cos]]).transpose(2, 0, 1)
        image_from_crop = np.empty((len(images), 2, 3))
        image_from_crop[:, :, :2] = axes * (side / self._side)[:, None, None]
        middle = (self._side - 1) / 2.0
        image_from_crop[:, :, 2] = centre - image_from_crop[:, :, :2].sum(axis=2) * middle
        crops = [
            cv2.warpAffine(
                image,
                there,
                (self._side, self._side),
                flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
            )
            for image, there in zip(images, image_from_crop, strict=True)
        ]
        outputs = self._network.run(_UNIT_RGB.batch(crops))
        points = outputs[self._points].reshape(-1, _POINTS, 5).astype(np.float64)
        flag = outputs[self._flag].reshape(-1, 1).astype(np.float64)
        place = points[:, :, :2] - 0.5
        found = np.empty((len(points), _POINTS, 3))
        found[:, :, :2] = place @ image_from_crop[:, :, :2].transpose(0, 2, 1)
        found[:, :, :2] += image_from_crop[:, None, :, 2]
        found[:, :, 2] = np.where(flag >= _LEAST_FLAG, flag * _sigmoid(points[:, :, 3]), -1.0)
        return found


class BlazePersonDetector:
    """Boxes of the people in each image, from their faces: near ones, a few metres away."""

    def __init__(self, network: Network) -> None:
        self._network = network
        self._values, self._scores = (
            next(t.name for t in network.outputs if t.shape[1:] == (_count(), size))
            for size in (12, 1)
        )
        self._centres = np.concatenate([_cells(stride, each) for stride, each in _ANCHORS])

    @property
    def identity(self) -> str:
        """The network's, and the thresholds."""
        return f"{self._network.identity} score {_LEAST_SCORE} overlap {_MOST_OVERLAP}"

    def find(
        self, images: Sequence[UInt8[np.ndarray, "_ _ 3"]]
    ) -> tuple[Float[np.ndarray, "_ 5"], ...]:
        """Per BGR image x0, y0, x1, y1 [px] of whole bodies and score 0-1, best first."""
        if not images:
            return ()
        placed = [letterbox(image, (_SIDE, _SIDE)) for image in images]
        outputs = self._network.run(_SIGNED_RGB.batch([canvas for canvas, _ in placed]))
        found = []
        for values, scores, image, (_, placement) in zip(
            outputs[self._values], outputs[self._scores], images, placed, strict=True
        ):
            bodies = self._bodies(values.astype(np.float64), _sigmoid(scores[:, 0]))
            corners = placement.to_image(bodies[:, :4].reshape(-1, 2, 2))
            limit = np.array([image.shape[1], image.shape[0]]) - 0.5
            bodies[:, :4] = np.clip(corners, -0.5, limit).reshape(-1, 4)
            found.append(bodies[np.all(bodies[:, 2:4] - bodies[:, :2] >= 1.0, axis=1)])
        return tuple(found)

    def _bodies(
        self, values: Float[np.ndarray, "a 12"], scores: Float[np.ndarray, " a"]
    ) -> Float[np.ndarray, "n 5"]:
        """On the canvas; of the candidates about one face the best."""
        centre, size = self._centres + values[:, :2], values[:, 2:4]
        faces = np.concatenate([centre - size / 2, centre + size / 2, scores[:, None]], axis=1)
        kept = unsuppressed(faces, _LEAST_SCORE, _MOST_OVERLAP)
        hips = self._centres[kept] + values[kept, 4:6] - 0.5
        reach = self._centres[kept] + values[kept, 6:8] - 0.5 - hips
        length = np.maximum(np.linalg.norm(reach, axis=1, keepdims=True), 1e-9)
        half = length * (_SLIM + (1.0 - _SLIM) * np.abs(reach) / length)
        return np.concatenate([hips - half, hips + half, scores[kept, None]], axis=1)


def _cells(stride: int, each: int) -> Float[np.ndarray, "n 2"]:
    """Centres of a grid's cells [px], row by row, each so many times."""
    middle = (np.arange(_SIDE // stride) + 0.5) * stride
    y, x = np.meshgrid(middle, middle, indexing="ij")
    return np.repeat(np.stack([x.ravel(), y.ravel()], axis=1), each, axis=0)


def _sigmoid(logits: np.ndarray) -> np.ndarray:
    return 1.0 / (1.0 + np.exp(-np.clip(logits.astype(np.float64), -100.0, 100.0)))
