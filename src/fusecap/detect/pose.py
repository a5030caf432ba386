"""Networks that find one person's keypoints in a crop.

| layout | outputs | keypoint | confidence |
|---|---|---|---|
| SimCC | (n, k, r w), (n, k, r h) | highest bin of each axis, over r | the lower of the peaks |
| heatmaps | (n, k, h / s, w / s) | the peak, refined | the peak |

r and s follow from the shapes. SimCC as in mmpose's RTMPose (bins rarely carry more than their
maximum: 1/r pixel is the resolution). A heatmap's peak is refined by the Newton step of DARK (Zhang
et al., "Distribution-aware coordinate representation for human pose estimation", 2020, eq. 7): its
logarithm, smoothed by the 3x3 kernel, is a paraboloid about the true place.

A crop is the person's box, made as tall and wide as the network's proportions ask, times 1.25, as
all of these networks are trained. One affine map (scale and shift) leads to the crop and back.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from fusecap.body.landmarks import LANDMARK_SETS, LandmarkSet
from fusecap.detect.images import IMAGENET_RGB
from fusecap.detect.runtimes.network import Network
from fusecap.errors import InputError

PADDING = 1.25
"""Crop over box."""
_BATCH = 32
"""Crops per run; bounds memory where many people are in many views."""

_BY_COUNT = {17: "coco17", 26: "halpe26", 25: "body25", 15: "mpi15"}


def landmarks_for(network: Network, count: int, stated: LandmarkSet | None) -> LandmarkSet:
    """The stated landmarks, or those with this number of keypoints.

    Raises `InputError` where the number fits neither.
    """
    if stated is None:
        if count not in _BY_COUNT:
            known = ", ".join(f"{n} ({name})" for n, name in sorted(_BY_COUNT.items()))
            raise InputError(
                f"{network.path}: the network gives {count} keypoints; known are {known}"
            )
        return LANDMARK_SETS[_BY_COUNT[count]]
    if len(stated.landmark_names) != count:
        raise InputError(
            f"{network.path}: the network gives {count} keypoints, but '{stated.name}' has "
            f"{len(stated.landmark_names)}"
        )
    return stated


class PoseNetwork:
    """Keypoints of the person in each box."""

    def __init__(self, network: Network, landmarks: LandmarkSet | None = None) -> None:
        height, width = network.input.shape[2:]
        if height is None or width is None:
            raise InputError(
                f"{network.path}: the network's input size is open; export it with a fixed one "
                "(as 256x192)"
            )
        self._network = network
        self._size = np.array([width, height], dtype=np.float64)
        self._maps, count = _outputs(network)
        self.landmarks = landmarks_for(network, count, landmarks)

    @property
    def identity(self) -> str:
        """The network's, and the size of crops."""
        return f"{self._network.identity} crop {PADDING}"

    def keypoints(
        self,
        images: Sequence[UInt8[np.ndarray, "_ _ 3"]],
        boxes: Sequence[Float[np.ndarray, "_ 4"]],
    ) -> tuple[Float[np.ndarray, "_ k 3"], ...]:
        """Per image x, y [px] and confidence 0-1 of the person in each box, all crops in one batch.

        Keypoints may lie outside the image.
        """
        crops, scales, starts = [], [], []
        for image, those in zip(images, boxes, strict=True):
            for box in those:
                scale, start = self._map(box)
                crops.append(self._crop(image, scale, start))
                scales.append(scale)
                starts.append(start)
        found = np.empty((len(crops), len(self.landmarks.landmark_names), 3))
        for first in range(0, len(crops), _BATCH):
            batch = IMAGENET_RGB.batch(crops[first : first + _BATCH])
            found[first : first + _BATCH] = self._decode(self._network.run(batch))
        if crops:
            found[:, :, :2] *= np.array(scales)[:, None, None]
            found[:, :, :2] += np.array(starts)[:, None]
        return tuple(np.split(found, np.cumsum([len(those) for those in boxes])[:-1]))

    def _map(self, box: np.ndarray) -> tuple[float, np.ndarray]:
        """Image pixels per crop pixel, and the image point of crop point (0, 0)."""
        centre, size = (box[:2] + box[2:]) / 2.0, box[2:] - box[:2]
        scale = PADDING * float(np.max(size / self._size))
        return scale, centre - scale * self._size / 2.0

    def _crop(self, image: np.ndarray, scale: float, start: np.ndarray) -> np.ndarray:
        image_from_crop = np.array([[scale, 0.0, start[0]], [0.0, scale, start[1]]])
        return cv2.warpAffine(
            image,
            image_from_crop,
            (int(self._size[0]), int(self._size[1])),
            flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
        )

    def _decode(self, outputs: dict[str, np.ndarray]) -> np.ndarray:
        maps = [outputs[name] for name in self._maps]
        if len(maps) == 1:
            return from_heatmaps(maps[0], self._size)
        simcc_x, simcc_y = maps
        return from_simcc(simcc_x, simcc_y, self._size)


def _outputs(network: Network) -> tuple[tuple[str, ...], int]:
    """Names of the maps (SimCC: x, y; one name: heatmaps) and the number of keypoints."""
    by_name = {tensor.name: tensor for tensor in network.outputs}
    heatmaps = [t for t in network.outputs if len(t.shape) == 4 and t.shape[1] is not None]
    if len(heatmaps) == 1:
        return (heatmaps[0].name,), heatmaps[0].shape[1] or 0
    if "simcc_x" in by_name and "simcc_y" in by_name:
        return ("simcc_x", "simcc_y"), _simcc_count(network, by_name["simcc_x"].shape)
    rows = [t for t in network.outputs if len(t.shape) == 3]
    height, width = network.input.shape[2:]
    if len(rows) == 2 and width and height and rows[0].shape[1] == rows[1].shape[1]:
        (a, b), count = rows, _simcc_count(network, rows[0].shape)
        for x, y in ((a, b), (b, a)):
            if x.shape[2] and y.shape[2] and x.shape[2] * height == y.shape[2] * width:
                return (x.name, y.name), count
    found = ", ".join(f"{tensor.name} {tensor.shape}" for tensor in network.outputs)
    raise InputError(
        f"{network.path}: not a pose network that is known here (outputs {found}); expected SimCC "
        "(simcc_x, simcc_y), heatmaps (n, k, h, w), or RTMO (dets, keypoints)"
    )


def _simcc_count(network: Network, shape: tuple[int | None, ...]) -> int:
    if shape[1] is None:
        raise InputError(
            f"{network.path}: the number of keypoints is open; export with a fixed one"
        )
    return shape[1]


def from_simcc(
    simcc_x: Float[np.ndarray, "n k w"],
    simcc_y: Float[np.ndarray, "n k h"],
    size: Float[np.ndarray, "2"],
) -> Float[np.ndarray, "n k 3"]:
    """Keypoints on the crop of this size (w, h) [px]."""
    bins = np.stack([simcc_x.argmax(axis=2), simcc_y.argmax(axis=2)], axis=2)
    split = np.array([simcc_x.shape[2], simcc_y.shape[2]]) / size
    peak = np.minimum(simcc_x.max(axis=2), simcc_y.max(axis=2))
    return np.concatenate([bins / split, np.clip(peak, 0.0, 1.0)[:, :, None]], axis=2)


def from_heatmaps(
    heatmaps: Float[np.ndarray, "n k h w"], size: Float[np.ndarray, "2"]
) -> Float[np.ndarray, "n k 3"]:
    """Keypoints on the crop of this size (w, h) [px]; a peak at an edge is not refined across."""
    n, k, height, width = heatmaps.shape
    flat = heatmaps.reshape(n * k, height * width)
    best = flat.argmax(axis=1)
    peak = flat[np.arange(n * k), best]
    y, x = np.divmod(best, width)
    stride = size / (width, height)
    place = np.stack([x, y], axis=1) + _newton(heatmaps.reshape(n * k, height, width), x, y)
    found = np.concatenate([place * stride, np.clip(peak, 0.0, 1.0)[:, None]], axis=1)
    return found.reshape(n, k, 3)


def _newton(maps: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Step (n, 2) from each map's peak to the top of its log-paraboloid, at most 1 cell."""
    padded = np.pad(maps, ((0, 0), (2, 2), (2, 2)), mode="edge")
    window = np.arange(5)
    rows = np.arange(len(maps))
    patch = padded[
        rows[:, None, None],
        (y[:, None] + window)[:, :, None],
        (x[:, None] + window)[:, None, :],
    ].astype(np.float64)
    wide = patch[:, :, :-2] + 2.0 * patch[:, :, 1:-1] + patch[:, :, 2:]
    smooth = (wide[:, :-2] + 2.0 * wide[:, 1:-1] + wide[:, 2:]) / 16.0
    log = np.log(np.maximum(smooth, 1e-10))
    dx, dy = (log[:, 1, 2] - log[:, 1, 0]) / 2.0, (log[:, 2, 1] - log[:, 0, 1]) / 2.0
    dxx = log[:, 1, 2] - 2.0 * log[:, 1, 1] + log[:, 1, 0]
    dyy = log[:, 2, 1] - 2.0 * log[:, 1, 1] + log[:, 0, 1]
    dxy = (log[:, 2, 2] - log[:, 2, 0] - log[:, 0, 2] + log[:, 0, 0]) / 4.0
    determinant = dxx * dyy - dxy**2
    round_top = (determinant > 1e-9) & (dxx < 0.0)
    safe = np.where(round_top, determinant, 1.0)
    step = np.stack([dxy * dy - dyy * dx, dxy * dx - dxx * dy], axis=1) / safe[:, None]
    step[~round_top] = 0.0
    step[(x == 0) | (x == maps.shape[2] - 1), 0] = 0.0
    step[(y == 0) | (y == maps.shape[1] - 1), 1] = 0.0
    return np.clip(step, -1.0, 1.0)
