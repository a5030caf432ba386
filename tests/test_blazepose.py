"""BlazePose's layouts on pictures of dots: crops that turn with the body, boxes from faces."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import openvino
import pytest
from openvino import opset13 as ops

from fusecap.detect.blazepose import (
    BlazePersonDetector,
    BlazePose,
    finds_keypoints,
    finds_people,
)
from fusecap.detect.build import build_detector
from fusecap.detect.detector import DetectorOptions
from fusecap.detect.runtimes.choice import open_network
from fusecap.detect.runtimes.network import Tensor
from fusecap.errors import InputError

RED, GREEN, BLUE = (0, 0, 255), (0, 255, 0), (255, 0, 0)


class DotPose:
    """Answers hips where green is, reach where blue is, and every keypoint where red is."""

    path = Path("pose_landmark_dots.tflite")
    identity = "dots"
    input = Tensor(name="input", shape=(None, 3, 256, 256), dtype="f32")
    outputs = (
        Tensor(name="points", shape=(None, 195), dtype="f32"),
        Tensor(name="flag", shape=(None, 1), dtype="f32"),
    )

    def __init__(self, flag: float = 1.0) -> None:
        self.seen: list[np.ndarray] = []
        self._flag = flag

    def run(self, batch: np.ndarray) -> dict[str, np.ndarray]:
        points = np.full((len(batch), 39, 5), 10.0, np.float32)
        for row, image in enumerate(batch):
            self.seen.append(image)
            red, green, blue = (centroid(channel) for channel in image)
            points[row, :, :2] = red
            points[row, 33, :2], points[row, 34, :2] = green, blue
        flags = np.full((len(batch), 1), self._flag, np.float32)
        return {"points": points.reshape(len(batch), 195), "flag": flags}


def centroid(channel: np.ndarray) -> np.ndarray:
    """From the left and upper edge of the picture, as the network counts."""
    y, x = np.nonzero(channel > 0.3)
    return np.array([x.mean(), y.mean()]) + 0.5 if len(x) else np.zeros(2)


def picture(*dots: tuple[tuple[int, int], tuple[int, int, int]]) -> np.ndarray:
    image = np.zeros((480, 640, 3), np.uint8)
    for (x, y), colour in dots:
        image[y - 4 : y + 5, x - 4 : x + 5] = colour
    return image


@pytest.mark.parametrize("reach", [(320, 140), (420, 240), (320, 340), (240, 170)])
def test_a_crop_is_turned_along_the_body_and_its_points_come_back_to_their_place(reach):
    network = DotPose()
    image = picture(((320, 240), GREEN), (reach, BLUE), ((350, 260), RED))
    (people,) = BlazePose(network).keypoints([image], [np.array([[220.0, 140.0, 420.0, 340.0]])])
    assert people.shape == (1, 21, 3)
    assert np.abs(people[0, :, :2] - (350, 260)).max() < 1.0
    assert people[0, :, 2].min() > 0.99
    (_, green, blue) = network.seen[1]
    hips, above = centroid(green), centroid(blue)
    assert np.abs(hips - 128).max() < 2
    assert abs(above[0] - 128) < 2 and above[1] == pytest.approx(128 - 128 / 1.25, abs=2)


def test_nobody_in_a_crop_has_no_confidence_and_is_not_looked_at_again():
    network = DotPose(flag=0.05)
    (people,) = BlazePose(network).keypoints([picture()], [np.array([[0.0, 0.0, 99.0, 99.0]])])
    assert np.all(people[:, :, 2] == 0) and len(network.seen) == 1


def test_pictures_without_boxes_have_nobody():
    nobody, _ = BlazePose(DotPose()).keypoints([picture(), picture()], [np.empty((0, 4))] * 2)
    assert nobody.shape == (0, 21, 3)


class FaceDetector:
    """One candidate, whose face is small and whose body is known by two points."""

    path = Path("pose_detection_dots.tflite")
    identity = "faces"
    input = Tensor(name="input", shape=(None, 3, 224, 224), dtype="f32")
    outputs = (
        Tensor(name="values", shape=(None, 2254, 12), dtype="f32"),
        Tensor(name="scores", shape=(None, 2254, 1), dtype="f32"),
    )

    def __init__(self, hips: tuple[float, float], reach: tuple[float, float]) -> None:
        """Both on the canvas [px]."""
        self._points = np.array([hips, reach])

    def run(self, batch: np.ndarray) -> dict[str, np.ndarray]:
        values = np.zeros((len(batch), 2254, 12), np.float32)
        scores = np.full((len(batch), 2254, 1), -9.0, np.float32)
        cell = 2 * (3 * 28 + 5)  # of the finest grid: column 5 of row 3, twice
        for candidate, score in ((cell, 2.0), (cell + 1, 1.0)):
            values[:, candidate, 2:4] = 10.0
            values[:, candidate, 4:8] = (self._points - (44.0, 28.0)).ravel()
            scores[:, candidate] = score
        return {"values": values, "scores": scores}


@pytest.mark.parametrize(
    ("reach", "box"),
    [
        ((100, 60), (75, 60, 125, 160)),  # upright: half as wide as long
        ((150, 110), (50, 85, 150, 135)),
    ],
)
def test_a_body_is_found_once_from_the_points_of_its_face(reach, box):
    image = np.zeros((560, 560, 3), np.uint8)
    (found,) = BlazePersonDetector(FaceDetector((100, 110), reach)).find([image])
    assert len(found) == 1 and found[0, 4] == pytest.approx(1 / (1 + np.exp(-2.0)))
    assert found[0, :4] == pytest.approx(np.array(box) * 560 / 224 - 0.5)


def test_networks_are_told_by_their_outputs():
    assert finds_keypoints(DotPose()) and not finds_people(DotPose())
    faces = FaceDetector((0, 0), (0, 1))
    assert finds_people(faces) and not finds_keypoints(faces)


def test_a_tensorflow_lite_network_is_read_channels_first_and_without_masks(tmp_path, monkeypatch):
    """Built by OpenVINO: nothing here writes such files."""
    image = ops.parameter([1, 4, 6, 3], np.float32, name="image")
    mean = ops.reduce_mean(image, ops.constant([1, 2], np.int64), keep_dims=False)
    mean.output(0).set_names({"mean"})
    mask = ops.multiply(image, ops.constant(2.0, np.float32))
    mask.output(0).set_names({"mask"})
    made = openvino.Model([mean, mask], [image])
    path = tmp_path / "made.tflite"
    path.write_bytes(b"TFL3")
    monkeypatch.setattr(openvino.Core, "read_model", lambda core, path: made)
    network = open_network(path)
    assert network.input.shape[1:] == (3, 4, 6)
    assert [tensor.name for tensor in network.outputs] == ["mean"]
    batch = np.arange(2 * 3 * 4 * 6, dtype=np.float32).reshape(2, 3, 4, 6)
    assert network.run(batch)["mean"] == pytest.approx(batch.mean(axis=(2, 3)))


def test_a_tensorflow_lite_network_that_is_garbage_is_one_error(tmp_path):
    path = tmp_path / "made.tflite"
    path.write_bytes(b"TFL3 and nothing else")
    with pytest.raises(InputError, match="not a network that OpenVINO can load"):
        open_network(path)
    with pytest.raises(InputError, match="ONNX Runtime cannot read"):
        open_network(path, "onnxruntime")


def test_faces_are_not_looked_for_in_a_mosaic(monkeypatch):
    networks = {"pose": DotPose(), "people": FaceDetector((0, 0), (0, 1))}
    monkeypatch.setattr("fusecap.detect.build._load", lambda model, *_: networks[model])
    options = DetectorOptions(model="pose", person_model="people")
    assert build_detector(options).landmarks.name == "blazepose33"
    with pytest.raises(InputError, match="leave out packed"):
        build_detector(DetectorOptions(model="pose", person_model="people", packed=True))
