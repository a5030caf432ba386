"""Small live pictures: what a camera saw, what was detected in it, and who was solved there.

A picture waits until its own instant has been solved, so that all three belong together. Cameras
that deliver keypoints alone are drawn on grey.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from fusecap.body.landmarks import LandmarkSet
from fusecap.engine.engine import LiveStep
from fusecap.exports.overlay import draw_limbs, draw_solved
from fusecap.exports.stick_figures import StickFigure
from fusecap.geometry.camera import Camera, Rig
from fusecap.types import CameraImage, CameraSample
from fusecap.viewer.figure import Pose, pose_of
from fusecap.viewer.palette import Rgb

WIDTH_PX = 320
RATE_HZ = 5.0
_DETECTED_RGB = (255, 255, 255)
_EMPTY_GREY = 70

Picture = UInt8[np.ndarray, "h w 3"]


class Pictures:
    """The newest of each camera; `offer` and `sample` come from other threads than `ready`."""

    def __init__(self, rig: Rig, landmarks: LandmarkSet) -> None:
        self._rig = rig
        self._landmarks = landmarks
        self._waiting: list[CameraImage | None] = [None] * len(rig)
        self._samples: list[CameraSample | None] = [None] * len(rig)
        self._shown_ns = [-(1 << 62)] * len(rig)
        self.drawn: list[Picture] = [_empty(camera) for camera in rig.cameras]
        """RGB, 320 px wide."""

    def offer(self, image: CameraImage) -> None:
        """Kept where it is time for another one and none is waiting."""
        if self._waiting[image.camera] is None and self._due(image.camera, image.timestamp_ns):
            self._waiting[image.camera] = image

    def sample(self, sample: CameraSample) -> None:
        """What was found in the waiting picture; without pictures it waits like one."""
        image = self._waiting[sample.camera]
        if image is None:
            free = self._samples[sample.camera] is None
            wanted = free and self._due(sample.camera, sample.timestamp_ns)
        else:
            wanted = image.timestamp_ns == sample.timestamp_ns
        if wanted:
            self._samples[sample.camera] = sample

    def ready(self, step: LiveStep, colours: Mapping[str, Rgb]) -> list[int]:
        """Draws what the last solved instant has reached; which cameras have a new picture.

        With the people as sent, or as solved where those sent are of another instant.
        """
        new, seen_ns = [], step.detections.timestamp_ns
        people = step.people.values()
        if step.timestamp_ns != seen_ns:
            people = step.step.estimates
        poses = {one.name: pose_of(one) for one in people if one is not None}
        for row in range(len(self._rig)):
            image, sample = self._waiting[row], self._samples[row]
            exposed = image or sample
            if exposed is None or exposed.timestamp_ns > seen_ns:
                continue
            self._shown_ns[row] = exposed.timestamp_ns
            belongs = sample is not None and sample.timestamp_ns == exposed.timestamp_ns
            self.draw(row, image, sample.people if sample and belongs else None, poses, colours)
            self._waiting[row] = self._samples[row] = None
            new.append(row)
        return new

    def draw(
        self,
        row: int,
        image: CameraImage | None,
        found: Float[np.ndarray, "n k 3"] | None,
        poses: Mapping[str, Pose],
        colours: Mapping[str, Rgb],
    ) -> None:
        """One camera's picture anew."""
        camera = self._rig.cameras[row]
        picture = _empty(camera) if image is None else _small(image)
        if found is not None:
            self._draw_found(picture, found * [_shrink(camera), _shrink(camera), 1.0])
        for name, pose in poses.items():
            figure = StickFigure(pose.shape.skeleton)
            sticks = figure.sticks(pose.shape, pose.position_m, pose.rotation, pose.quality)
            draw_solved(picture, camera, sticks, colours[name], scale=_shrink(camera))
        self.drawn[row] = picture

    def _due(self, camera: int, timestamp_ns: int) -> bool:
        return timestamp_ns - self._shown_ns[camera] >= 1e9 / RATE_HZ

    def _draw_found(self, picture: Picture, people: Float[np.ndarray, "n k 3"]) -> None:
        for person in people:
            draw_limbs(picture, person, self._landmarks, _DETECTED_RGB, 1)


def mosaic(pictures: Sequence[Picture], names: Sequence[str]) -> Picture:
    """Two in a row, each with its name."""
    columns = min(2, len(pictures))
    height = max(len(picture) for picture in pictures)
    rows = -(-len(pictures) // columns)
    whole = np.full((rows * height, columns * WIDTH_PX, 3), 255, dtype=np.uint8)
    for place, (picture, name) in enumerate(zip(pictures, names, strict=True)):
        top, left = place // columns * height, place % columns * WIDTH_PX
        whole[top : top + len(picture), left : left + WIDTH_PX] = picture
        for colour, width in (((0, 0, 0), 3), ((255, 255, 255), 1)):
            cv2.putText(
                whole,
                name.encode("ascii", "replace").decode(),
                (left + 6, top + 18),
                cv2.FONT_HERSHEY_SIMPLEX,
                0.5,
                colour,
                width,
                cv2.LINE_AA,
            )
    return whole


def _shrink(camera: Camera) -> float:
    return WIDTH_PX / camera.size_px[0]


def _empty(camera: Camera) -> Picture:
    height = max(round(camera.size_px[1] * _shrink(camera)), 1)
    return np.full((height, WIDTH_PX, 3), _EMPTY_GREY, dtype=np.uint8)


def _small(image: CameraImage) -> Picture:
    height, width = image.image.shape[:2]
    size = WIDTH_PX, max(round(height * WIDTH_PX / width), 1)
    small = cv2.resize(image.image, size, interpolation=cv2.INTER_AREA)
    return cv2.cvtColor(small, cv2.COLOR_BGR2RGB)
