"""Images on a network's canvas: resizing, placing, normalising.

Pixel (0, 0) is the centre of the top-left pixel, so an image resized by s that starts at pixel o of
the canvas has its point x at `s (x + 1/2) - 1/2 + o`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float, Float32, UInt8

GREY = 114
"""Canvas around images, as the detectors of YOLOX and RTMDet are trained."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Pixels:
    """How a network wants its pixels: (value - mean) / std, of values 0-255."""

    rgb: bool
    """Channel order; images come as BGR."""
    mean: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """In the network's channel order."""
    std: tuple[float, float, float] = (1.0, 1.0, 1.0)

    def batch(self, images: Sequence[UInt8[np.ndarray, "h w 3"]]) -> Float32[np.ndarray, "n 3 h w"]:
        """Images of one size as a batch."""
        stacked = np.stack(images)
        result = np.empty((len(images), 3, *stacked.shape[1:3]), dtype=np.float32)
        values = np.arange(256, dtype=np.float64)
        for channel in range(3):
            table = ((values - self.mean[channel]) / self.std[channel]).astype(np.float32)
            source = stacked[:, :, :, 2 - channel if self.rgb else channel]
            np.take(table, source, out=result[:, channel])
        return result


RAW_BGR = Pixels(rgb=False)
"""YOLOX and RTMO: plain BGR values (mmdet `yolox_*`, mmpose `rtmo_*` configs: no mean, no std)."""
IMAGENET_BGR = Pixels(rgb=False, mean=(103.53, 116.28, 123.675), std=(57.375, 57.12, 58.395))
"""RTMDet (mmdet `rtmdet_*` configs: `bgr_to_rgb=False`)."""
IMAGENET_RGB = Pixels(rgb=True, mean=(123.675, 116.28, 103.53), std=(58.395, 57.12, 57.375))
"""RTMPose (mmpose configs: `bgr_to_rgb=True`); PicoDet, PP-TinyPose, HRNet (PaddleDetection: the
same numbers over 255)."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Placement:
    """Where an image lies on a canvas."""

    scale: tuple[float, float]
    """Canvas pixels per image pixel, in x and y."""
    start: tuple[int, int]
    """Canvas pixel of the image's top-left pixel."""
    size: tuple[int, int]
    """Width and height on the canvas [px]."""

    def to_canvas(self, points_px: Float[np.ndarray, "*s 2"]) -> Float[np.ndarray, "*s 2"]:
        """Image to canvas."""
        return (points_px + 0.5) * self.scale - 0.5 + self.start

    def to_image(self, points_px: Float[np.ndarray, "*s 2"]) -> Float[np.ndarray, "*s 2"]:
        """Canvas to image."""
        return (points_px - self.start + 0.5) / self.scale - 0.5


def fitted(
    image_size: tuple[int, int], room: tuple[int, int], start: tuple[int, int] = (0, 0)
) -> Placement:
    """The largest placement of an image (w, h) in a room (w, h), proportions kept."""
    ratio = min(room[0] / image_size[0], room[1] / image_size[1])
    size = max(1, round(image_size[0] * ratio)), max(1, round(image_size[1] * ratio))
    return Placement(
        scale=(size[0] / image_size[0], size[1] / image_size[1]), start=start, size=size
    )


def draw(
    canvas: UInt8[np.ndarray, "h w 3"], image: UInt8[np.ndarray, "i j 3"], placement: Placement
) -> None:
    """Resize an image onto its place."""
    (x, y), (width, height) = placement.start, placement.size
    canvas[y : y + height, x : x + width] = cv2.resize(
        image, placement.size, interpolation=cv2.INTER_LINEAR
    )


def letterbox(
    image: UInt8[np.ndarray, "i j 3"], canvas_size: tuple[int, int]
) -> tuple[UInt8[np.ndarray, "h w 3"], Placement]:
    """An image in the top-left of a grey canvas (w, h), proportions kept."""
    placement = fitted((image.shape[1], image.shape[0]), canvas_size)
    canvas = np.full((canvas_size[1], canvas_size[0], 3), GREY, dtype=np.uint8)
    draw(canvas, image, placement)
    return canvas, placement
