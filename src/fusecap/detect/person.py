"""Networks that find people's boxes in whole images.

The layout is told from the outputs:

| layout | outputs | image | boxes |
|---|---|---|---|
| list | `dets` (n, N, 5), `labels` (n, N) | letterboxed | on the canvas, already suppressed |
| YOLOX raw | (n, A, 5 + C) | letterboxed | centre in cells, log size; strides 8 16 32 |
| PicoDet | (n, A, 4) and (n, C, A) | stretched | on the canvas; strides 8 16 32 64 |

RTMDet and YOLOX both come as lists but differ in pixels; the file's name decides.

A counts the cells of all strides. Only class 0 is used: a person in COCO, and in every one-class
detector. Sources: mmdeploy's exports of mmdet for the list, Megvii's `demo/ONNXRuntime` for YOLOX
raw, PaddleDetection's `deploy/third_engine` for PicoDet.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, UInt8

from fusecap.detect.images import (
    IMAGENET_BGR,
    IMAGENET_RGB,
    RAW_BGR,
    Pixels,
    Placement,
    draw,
    letterbox,
)
from fusecap.detect.people import suppressed
from fusecap.detect.runtimes.network import Network
from fusecap.errors import InputError

LEAST_SCORE = 0.25
"""Of a box; whether somebody is in it, the pose network says."""
MOST_OVERLAP = 0.65
"""Of two boxes that both stay."""
LONG_SIDE_PX = 640
"""Canvas of networks that take any size; small or tilted people are missed at 320."""

_STRIDE = 32
_YOLOX_STRIDES = (8, 16, 32)
_PICODET_STRIDES = (8, 16, 32, 64)

Decode = Callable[[dict[str, np.ndarray], tuple[int, int]], list[np.ndarray]]
"""Outputs and canvas size (w, h) to boxes x0, y0, x1, y1, score on the canvas, per image."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Layout:
    """How a detector wants its images and gives its boxes."""

    pixels: Pixels
    letterboxed: bool
    """Proportions kept, the rest grey; else stretched."""
    decode: Decode


class PersonDetector:
    """Boxes of the people in each image."""

    def __init__(self, network: Network) -> None:
        self._network = network
        self._layout = _layout(network)

    @property
    def identity(self) -> str:
        """The network's, and the thresholds."""
        return f"{self._network.identity} score {LEAST_SCORE} overlap {MOST_OVERLAP}"

    def canvas_size(self, image_size: tuple[int, int]) -> tuple[int, int]:
        """Width and height of the network's input for an image (w, h)."""
        return canvas_size(self._network, image_size)

    def find(
        self, images: Sequence[UInt8[np.ndarray, "_ _ 3"]]
    ) -> tuple[Float[np.ndarray, "_ 5"], ...]:
        """Per BGR image x0, y0, x1, y1 [px] and score 0-1, best first."""
        found: list[np.ndarray] = [np.empty((0, 5))] * len(images)
        sizes = [self.canvas_size((image.shape[1], image.shape[0])) for image in images]
        for size in dict.fromkeys(sizes):
            chosen = [i for i, other in enumerate(sizes) if other == size]
            placed = [self._placed(images[i], size) for i in chosen]
            outputs = self._network.run(self._layout.pixels.batch([canvas for canvas, _ in placed]))
            decoded = self._layout.decode(outputs, size)
            for i, boxes, (_, placement) in zip(chosen, decoded, placed, strict=True):
                found[i] = _in_image(boxes, placement, images[i])
        return tuple(found)

    def _placed(self, image: np.ndarray, size: tuple[int, int]) -> tuple[np.ndarray, Placement]:
        if self._layout.letterboxed:
            return letterbox(image, size)
        height, width = image.shape[:2]
        stretched = Placement(scale=(size[0] / width, size[1] / height), start=(0, 0), size=size)
        canvas = np.empty((size[1], size[0], 3), dtype=np.uint8)
        draw(canvas, image, stretched)
        return canvas, stretched


def canvas_size(network: Network, image_size: tuple[int, int]) -> tuple[int, int]:
    """The input (w, h) that a whole-image network declares, or one that fits the image."""
    height, width = network.input.shape[2:]
    if height is not None and width is not None:
        return width, height
    ratio = LONG_SIDE_PX / max(image_size)
    fitting = [_STRIDE * math.ceil(round(side * ratio) / _STRIDE) for side in image_size]
    return fitting[0], fitting[1]


def _in_image(boxes: np.ndarray, placement: Placement, image: np.ndarray) -> np.ndarray:
    boxes = suppressed(np.asarray(boxes, dtype=np.float64), LEAST_SCORE, MOST_OVERLAP)
    corners = placement.to_image(boxes[:, :4].reshape(-1, 2, 2))
    limit = np.array([image.shape[1], image.shape[0]]) - 0.5
    boxes[:, :4] = np.clip(corners, -0.5, limit).reshape(-1, 4)
    return boxes[np.all(boxes[:, 2:4] - boxes[:, :2] >= 1.0, axis=1)]


def _layout(network: Network) -> Layout:
    names = [tensor.name for tensor in network.outputs]
    ranks = [len(tensor.shape) for tensor in network.outputs]
    if "dets" in names and "labels" in names:
        return Layout(pixels=_list_pixels(network.path), letterboxed=True, decode=_from_list)
    if ranks == [3]:
        return Layout(pixels=RAW_BGR, letterboxed=True, decode=_from_yolox)
    if ranks == [3, 3]:
        return Layout(pixels=IMAGENET_RGB, letterboxed=False, decode=_from_picodet)
    found = ", ".join(f"{tensor.name} {tensor.shape}" for tensor in network.outputs)
    raise InputError(
        f"{network.path}: not a person detector that is known here (outputs {found}); expected "
        "RTMDet or YOLOX as exported by mmdeploy, raw YOLOX, or PicoDet"
    )


def _list_pixels(path: Path) -> Pixels:
    named = f"{path.parent.name}/{path.name}".lower()
    if "rtmdet" in named:
        return IMAGENET_BGR
    if "yolox" in named:
        return RAW_BGR
    raise InputError(
        f"{path}: RTMDet and YOLOX want different pixels, and the file does not say which it is; "
        "put 'rtmdet' or 'yolox' into the name of the file or its folder"
    )


def _from_list(outputs: dict[str, np.ndarray], size: tuple[int, int]) -> list[np.ndarray]:
    return [
        dets[labels == 0] for dets, labels in zip(outputs["dets"], outputs["labels"], strict=True)
    ]


def _from_yolox(outputs: dict[str, np.ndarray], size: tuple[int, int]) -> list[np.ndarray]:
    (raw,) = outputs.values()
    cells, strides = _cells(size, _YOLOX_STRIDES, raw.shape[1])
    centre = (raw[:, :, :2] + cells) * strides
    half = np.exp(raw[:, :, 2:4]) * strides / 2.0
    score = raw[:, :, 4:5] * raw[:, :, 5:6]
    return list(np.concatenate([centre - half, centre + half, score], axis=2))


def _from_picodet(outputs: dict[str, np.ndarray], size: tuple[int, int]) -> list[np.ndarray]:
    first, second = outputs.values()
    boxes, scores = (first, second) if first.shape[2] == 4 else (second, first)
    _cells(size, _PICODET_STRIDES, boxes.shape[1])
    return list(np.concatenate([boxes, scores[:, 0, :, None]], axis=2))


def _cells(
    size: tuple[int, int], strides: tuple[int, ...], count: int
) -> tuple[np.ndarray, np.ndarray]:
    """Cell indices (A, 2), x first, and strides (A, 1), row by row and fine to coarse."""
    cells, steps = [], []
    for stride in strides:
        columns, rows = math.ceil(size[0] / stride), math.ceil(size[1] / stride)
        x, y = np.meshgrid(np.arange(columns), np.arange(rows))
        cells.append(np.stack([x.ravel(), y.ravel()], axis=1))
        steps.append(np.full((rows * columns, 1), stride))
    if sum(map(len, cells)) != count:
        raise InputError(
            f"the person detector gives {count} candidates, expected {sum(map(len, cells))} for "
            f"{size[0]}x{size[1]} px and strides {strides}; its layout is not known here"
        )
    return np.concatenate(cells), np.concatenate(steps)
