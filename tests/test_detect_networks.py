"""Runtimes and layouts, on networks of a few operations with known outputs."""

from __future__ import annotations

import os
import sys
from dataclasses import replace

import numpy as np
import pytest

from fusecap.body.landmarks import LANDMARK_SETS
from fusecap.detect.build import build_detector
from fusecap.detect.detector import REVISION, DetectorOptions
from fusecap.detect.images import IMAGENET_BGR, IMAGENET_RGB, RAW_BGR, letterbox
from fusecap.detect.one_stage import OneStageDetector
from fusecap.detect.people import bounds, distinct, similarity, suppressed
from fusecap.detect.person import PersonDetector
from fusecap.detect.pose import PoseNetwork, from_heatmaps, from_simcc
from fusecap.detect.runtimes.choice import open_network
from fusecap.errors import InputError
from tiny_networks import constant_network, fails_on_batches, red_blob_network

BOTH = pytest.mark.parametrize("runtime", ["onnxruntime", "openvino"])
GREY_640 = np.full((640, 320, 3), 90, np.uint8)


def test_onnx_runtime_tells_nobody_what_is_run(tmp_path, monkeypatch):
    path = constant_network(tmp_path / "n.onnx", ("n", 3, 8, 8), {"a": np.zeros((1, 1))})
    monkeypatch.delenv("ORT_DISABLE_TELEMETRY", raising=False)
    open_network(path, "onnxruntime")
    assert os.environ["ORT_DISABLE_TELEMETRY"] == "1"


@BOTH
def test_outputs_come_by_name_for_each_image(tmp_path, runtime):
    values = {"a": np.arange(6.0).reshape(1, 2, 3), "b": np.array([[7.0]])}
    path = constant_network(tmp_path / "n.onnx", ("n", 3, 8, 8), values, plus_image=1.0)
    network = open_network(path, runtime, threads=2)
    batch = np.zeros((5, 3, 8, 8), np.float32) + np.arange(5, dtype=np.float32)[:, None, None, None]
    result = network.run(batch)
    np.testing.assert_allclose(result["a"], values["a"] + np.arange(5)[:, None, None], atol=1e-5)
    np.testing.assert_allclose(result["b"][:, 0], 7.0 + np.arange(5), atol=1e-5)
    assert network.input.shape == (None, 3, 8, 8)
    assert runtime in network.identity and "n.onnx" in network.identity


@BOTH
def test_network_for_one_image_takes_batches_too(tmp_path, runtime):
    path = constant_network(
        tmp_path / "n.onnx", (1, 3, 8, 8), {"a": np.zeros((1, 2))}, plus_image=1.0
    )
    batch = np.zeros((3, 3, 8, 8), np.float32) + np.arange(3, dtype=np.float32)[:, None, None, None]
    result = open_network(path, runtime).run(batch)
    np.testing.assert_allclose(result["a"], np.arange(3)[:, None] * np.ones(2), atol=1e-5)


def test_batch_that_a_graph_cannot_take_is_run_one_by_one(tmp_path):
    network = open_network(fails_on_batches(tmp_path / "n.onnx"), "onnxruntime")
    batch = np.ones((3, 3, 8, 8), np.float32) * np.array([1, 2, 3], np.float32)[:, None, None, None]
    np.testing.assert_allclose(network.run(batch)["out"], [[1], [2], [3]], rtol=1e-6)


@pytest.mark.parametrize(
    ("runtime", "extra"), [("onnxruntime", "detect"), ("openvino", "openvino")]
)
def test_missing_runtime_names_the_extra(tmp_path, monkeypatch, runtime, extra):
    path = constant_network(tmp_path / "n.onnx", (1, 3, 8, 8), {"a": np.zeros((1, 2))})
    monkeypatch.setitem(sys.modules, runtime, None)
    with pytest.raises(InputError, match=rf"extra '{extra}'.*pip install '{runtime}>="):
        open_network(path, runtime)


@BOTH
def test_broken_file_is_one_error(tmp_path, runtime):
    path = tmp_path / "broken.onnx"
    path.write_bytes(b"not a network")
    with pytest.raises(InputError, match="download it again"):
        open_network(path, runtime)


def test_misuse_is_named(tmp_path):
    (tmp_path / "n.xml").write_text("<net/>")
    with pytest.raises(InputError, match=r"weights n\.bin are not beside it"):
        open_network(tmp_path / "n.xml")
    with pytest.raises(InputError, match="set runtime openvino"):
        open_network(tmp_path / "n.xml", "onnxruntime")
    with pytest.raises(InputError, match="no such file"):
        open_network(tmp_path / "none.onnx")
    with pytest.raises(InputError, match="did you mean 'openvino'"):
        open_network(tmp_path / "n.xml", "opnvino")


@pytest.mark.parametrize("pixels", [RAW_BGR, IMAGENET_BGR, IMAGENET_RGB])
def test_pixels_are_normalised_in_the_networks_order(rng, pixels):
    image = rng.integers(0, 256, (4, 5, 3), dtype=np.uint8)
    channels = image[:, :, ::-1] if pixels.rgb else image
    expected = (channels - np.array(pixels.mean)) / np.array(pixels.std)
    np.testing.assert_allclose(
        pixels.batch([image])[0], expected.transpose(2, 0, 1), rtol=1e-6, atol=1e-6
    )


def test_letterbox_keeps_points(rng):
    image = rng.integers(0, 256, (720, 1280, 3), dtype=np.uint8)
    canvas, placement = letterbox(image, (640, 640))
    assert canvas.shape == (640, 640, 3)
    assert placement.size == (640, 360)
    assert np.all(canvas[360:] == 114)
    np.testing.assert_allclose(placement.to_canvas(np.array([639.5, 359.5])), [319.5, 179.5])
    points = rng.uniform(0, 700, (10, 2))
    np.testing.assert_allclose(placement.to_image(placement.to_canvas(points)), points)


@pytest.mark.parametrize("name", ["rtmdet_x.onnx", "yolox_x.onnx"])
def test_list_of_boxes(tmp_path, name):
    """A canvas of 320x320 shows a 320x640 image at half its size."""
    dets = np.array([[[10, 20, 60, 120, 0.9], [0, 0, 40, 40, 0.8], [100, 10, 150, 90, 0.1]]])
    labels = np.array([[0, 3, 0]])
    path = constant_network(tmp_path / name, ("n", 3, 320, 320), {"dets": dets, "labels": labels})
    (boxes,) = PersonDetector(open_network(path)).find([GREY_640])
    corners = np.array([[10, 20], [60, 120]]) * 2 + 0.5  # (c + 1/2) 2 - 1/2
    np.testing.assert_allclose(boxes, [[*corners.ravel(), 0.9]], rtol=1e-6)


def test_list_of_boxes_without_a_name_is_refused(tmp_path):
    values = {"dets": np.zeros((1, 1, 5)), "labels": np.zeros((1, 1), np.int64)}
    path = constant_network(tmp_path / "end2end.onnx", ("n", 3, 320, 320), values)
    with pytest.raises(InputError, match="'rtmdet' or 'yolox'"):
        PersonDetector(open_network(path))
    beside = constant_network(tmp_path / "yolox_tiny" / "end2end.onnx", ("n", 3, 320, 320), values)
    PersonDetector(open_network(beside))


@pytest.mark.parametrize("classes", [1, 80])
def test_raw_yolox(tmp_path, classes):
    """640x640: 80² cells of 8 px, then 40² of 16, then 20² of 32."""
    raw = np.zeros((1, 8400, 5 + classes))
    raw[..., 2:4] = 1.0
    # Cell x 7, y 11 of stride 16: centre (7.25, 11.5) * 16, size 64 x 160.
    raw[0, 6400 + 11 * 40 + 7, :6] = [0.25, 0.5, np.log(4.0), np.log(10.0), 0.9, 0.8]
    # The same person once more, less sure.
    raw[0, 6400 + 11 * 40 + 8, :6] = [-0.7, 0.5, np.log(4.0), np.log(10.0), 0.9, 0.7]
    path = constant_network(tmp_path / "n.onnx", (1, 3, 640, 640), {"output": raw})
    image = np.zeros((640, 640, 3), np.uint8)
    (boxes,) = PersonDetector(open_network(path)).find([image])
    np.testing.assert_allclose(boxes, [[84.0, 104.0, 148.0, 264.0, 0.72]], rtol=1e-5)


def test_raw_yolox_of_another_grid_is_refused(tmp_path):
    path = constant_network(tmp_path / "n.onnx", (1, 3, 640, 640), {"output": np.zeros((1, 99, 6))})
    detector = PersonDetector(open_network(path))
    with pytest.raises(InputError, match="99 candidates, expected 8400"):
        detector.find([GREY_640])


def test_picodet_stretches_the_image(tmp_path):
    boxes = np.zeros((1, 2125, 4))
    scores = np.zeros((1, 1, 2125))
    boxes[0, 5], scores[0, 0, 5] = [32.0, 64.0, 96.0, 160.0], 0.7
    path = constant_network(
        tmp_path / "n.onnx", (1, 3, 320, 320), {"boxes": boxes, "scores": scores}
    )
    (found,) = PersonDetector(open_network(path)).find([GREY_640])
    np.testing.assert_allclose(found, [[32.0, 128.5, 96.0, 320.5, 0.7]], rtol=1e-6)


def test_unknown_outputs_are_listed(tmp_path):
    path = constant_network(tmp_path / "n.onnx", (1, 3, 32, 32), {"out": np.zeros((1, 7))})
    network = open_network(path)
    with pytest.raises(InputError, match=r"not a person detector .*out \(1, 7\)"):
        PersonDetector(network)
    with pytest.raises(InputError, match=r"not a pose network .*out \(1, 7\)"):
        PoseNetwork(network)


@pytest.mark.parametrize("names", [("simcc_x", "simcc_y"), ("second", "first")])
def test_simcc_network(tmp_path, names):
    """Bins of half a pixel; a 96x128 box at twice the crop's size over 1.25."""
    x, y = np.zeros((1, 26, 384)), np.zeros((1, 26, 512))
    x[0, :, 100], y[0, :, 301] = 0.8, 0.6
    outputs = {names[0]: x, names[1]: y}
    path = constant_network(tmp_path / "n.onnx", ("n", 3, 256, 192), outputs)
    pose = PoseNetwork(open_network(path))
    assert pose.landmarks.name == "halpe26"
    box = np.array([[100.0, 50.0, 100.0 + 384.0 / 1.25, 50.0 + 512.0 / 1.25]])
    (people,) = pose.keypoints([np.zeros((700, 700, 3), np.uint8)], [box])
    start = box[0, :2] - 0.125 * np.array([384.0, 512.0]) / 1.25
    np.testing.assert_allclose(people[0, :, :2], np.tile(start + [100.0, 301.0], (26, 1)))
    np.testing.assert_allclose(people[0, :, 2], 0.6, rtol=1e-6)


def test_simcc_confidence_is_at_most_one_and_ratio_follows_the_shape():
    x, y = np.zeros((1, 1, 576)), np.zeros((1, 1, 768))
    x[0, 0, 30], y[0, 0, 33] = 3.0, 2.0
    np.testing.assert_allclose(from_simcc(x, y, np.array([192.0, 256.0])), [[[10.0, 11.0, 1.0]]])


@pytest.mark.parametrize("centre", [(20.0, 30.0), (20.3, 30.45), (19.6, 29.8), (2.2, 3.3)])
def test_gaussian_heatmap_is_decoded_between_its_cells(centre):
    y, x = np.mgrid[:64, :48]
    heatmap = 0.8 * np.exp(-((x - centre[0]) ** 2 + (y - centre[1]) ** 2) / (2 * 2.0**2))
    found = from_heatmaps(heatmap[None, None], np.array([192.0, 256.0]))
    np.testing.assert_allclose(found[0, 0, :2], 4 * np.array(centre), atol=0.02)
    assert 0.75 < found[0, 0, 2] <= 0.8


def test_peak_in_a_corner_and_flat_map_stay_finite():
    heatmaps = np.zeros((1, 2, 32, 24))
    heatmaps[0, 0, 31, 23] = 0.5
    found = from_heatmaps(heatmaps, np.array([96.0, 128.0]))
    np.testing.assert_allclose(found[0], [[92.0, 124.0, 0.5], [0.0, 0.0, 0.0]])


@BOTH
def test_crops_lead_to_the_image_and_back(tmp_path, runtime):
    """A red spot is found where it was drawn, whatever the box; RGB, affine and decoding."""
    path = red_blob_network(tmp_path / "n.onnx", (192, 256), 17)
    pose = PoseNetwork(open_network(path, runtime, threads=2))
    y, x = np.mgrid[:480, :640]
    images, boxes, places = [], [], []
    for place, size in (((200.3, 150.7), 90.0), ((400.0, 300.0), 140.0)):
        spot = np.exp(-((x - place[0]) ** 2 + (y - place[1]) ** 2) / (2 * (size / 14) ** 2))
        image = np.zeros((480, 640, 3), np.uint8)
        image[:, :, 2] = np.round(250 * spot)
        image[:, :, 0] = 255
        images.append(image)
        boxes.append(
            np.array([[place[0] - size / 3, place[1] - size, place[0] + size / 2, place[1] + size]])
        )
        places.append(place)
    for people, place in zip(pose.keypoints(images, boxes), places, strict=True):
        np.testing.assert_allclose(people[0, :, :2], np.tile(place, (17, 1)), atol=0.25)
        assert np.all(people[0, :, 2] > 0.9)


def test_number_of_keypoints_must_be_known(tmp_path):
    path = constant_network(
        tmp_path / "n.onnx", ("n", 3, 64, 48), {"h": np.zeros((1, 133, 16, 12))}
    )
    with pytest.raises(InputError, match="133 keypoints; known are"):
        PoseNetwork(open_network(path))
    with pytest.raises(InputError, match="133 keypoints, but 'coco17' has 17"):
        PoseNetwork(open_network(path), LANDMARK_SETS["coco17"])


def test_one_stage_network(tmp_path):
    people = np.zeros((1, 3, 17, 3))
    people[0, :, :, 0] = np.linspace(10, 60, 17)
    people[0, :, :, 1] = np.linspace(20, 120, 17)
    people[0, 1] += [200.0, 0.0, 0.0]
    people[0, :, :, 2] = np.array([0.9, 0.8, 0.7])[:, None]
    people[0, 0, 3, :2] = [10.0, 400.0]  # below the image
    dets = np.array([[[0, 0, 9, 9, 0.9], [0, 0, 9, 9, 0.8], [0, 0, 9, 9, 0.1]]])
    path = constant_network(
        tmp_path / "n.onnx", (1, 3, 640, 640), {"dets": dets, "keypoints": people}
    )
    detector = build_detector(DetectorOptions(model=str(path)))
    assert isinstance(detector, OneStageDetector)
    image = np.zeros((180, 320, 3), np.uint8)
    found, nothing = detector.detect([image, None], [np.empty((0, 17, 3))] * 2)
    assert found.shape == (2, 17, 3) and nothing.shape == (0, 17, 3)
    np.testing.assert_allclose(found[1, :, :2], (people[0, 1, :, :2] + 0.5) / 2 - 0.5)
    assert np.isnan(found[0, 3, 0]) and found[0, 3, 2] == 0.0


def two_stages(tmp_path) -> DetectorOptions:
    """A box at (100, 80)-(196, 208) of every image, and 26 keypoints with bins 100 and 301."""
    x, y = np.zeros((1, 26, 384)), np.zeros((1, 26, 512))
    x[0, :, 100], y[0, :, 301] = 0.8, 0.8
    pose = constant_network(
        tmp_path / "pose.onnx", ("n", 3, 256, 192), {"simcc_x": x, "simcc_y": y}
    )
    values = {
        "dets": np.array([[[100.5, 80.5, 196.5, 208.5, 0.9]]]),
        "labels": np.zeros((1, 1), np.int64),
    }
    person = constant_network(tmp_path / "rtmdet.onnx", (1, 3, 640, 640), values)
    return DetectorOptions(model=str(pose), person_model=str(person))


@pytest.mark.parametrize("runtime", ["auto", "onnxruntime", "openvino"])
def test_detector_of_two_networks(tmp_path, runtime):
    options = replace(two_stages(tmp_path), runtime=runtime)
    detector = build_detector(options, threads=1)
    assert detector.landmarks.name == "halpe26"
    image = np.zeros((640, 640, 3), np.uint8)
    found = detector.detect([image, None, image], [np.empty((0, 26, 3))] * 3)
    assert [len(people) for people in found] == [1, 0, 1]
    scale = 1.25 * 96 / 192
    start = np.array([148.5, 144.5]) - scale * np.array([96, 128])
    np.testing.assert_allclose(
        found[0][0, :, :2], np.tile(start + scale * np.array([50, 150.5]), (26, 1)), atol=1e-4
    )
    for part in ("pose.onnx sha256:", "rtmdet.onnx sha256:", "every 10", f"revision {REVISION}"):
        assert part in detector.identity


def test_options_change_the_identity(tmp_path):
    options = two_stages(tmp_path)
    names = {
        build_detector(o).identity
        for o in (options, replace(options, person_every=5), replace(options, packed=True))
    }
    assert len(names) == 3
    with pytest.raises(InputError, match="person_every is 0"):
        build_detector(replace(options, person_every=0))


def test_suppression_keeps_the_best_of_a_heap():
    boxes = np.array(
        [[0, 0, 10, 10, 0.5], [1, 0, 11, 10, 0.9], [20, 0, 30, 10, 0.4], [50, 0, 60, 10, 0.1]],
        dtype=float,
    )
    np.testing.assert_array_equal(suppressed(boxes, 0.3, 0.5), boxes[[1, 2]])


def person_at(x: float, y: float, height: float, rng: np.random.Generator) -> np.ndarray:
    """A standing person's 17 keypoints."""
    names = LANDMARK_SETS["coco17"].landmark_names
    level = {"nose": 0.95, "eye": 0.97, "ear": 0.96, "shoulder": 0.82, "elbow": 0.63}
    level |= {"wrist": 0.48, "hip": 0.52, "knee": 0.28, "ankle": 0.04}
    person = np.empty((17, 3))
    for k, name in enumerate(names):
        side, _, part = name.rpartition("_")
        across = {"left": 1, "right": -1}.get(side, 0) * (0.12 if part == "shoulder" else 0.08)
        person[k] = [x + across * height, y - level[part] * height, 0.8]
    person[:, :2] += rng.normal(0, 0.005 * height, (17, 2))
    return person


def test_copies_of_a_person_are_one_and_crossing_people_are_two(rng):
    person = person_at(300.0, 600.0, 500.0, rng)
    copy = person + [4.0, -3.0, -0.1]
    crossing = person_at(360.0, 590.0, 480.0, rng)
    people = np.stack([copy, person, crossing])
    np.testing.assert_array_equal(distinct(people), [1, 2])
    assert similarity(people, people)[0, 1] > 0.95
    nobody = person * [1.0, 1.0, 0.1]
    assert len(distinct(np.stack([nobody]))) == 0


def test_bounds_hold_the_keypoints_seen(rng):
    person = person_at(300.0, 600.0, 500.0, rng)
    person[9] = [2000.0, 2000.0, 0.05]
    (box,) = bounds(person[None])
    seen = person[person[:, 2] > 0.3, :2]
    assert np.all(box[:2] < seen.min(axis=0)) and np.all(box[2:] > seen.max(axis=0))
    assert box[2] < 600.0
    assert np.isnan(bounds(np.full((1, 17, 3), np.nan))).all()
