"""Several views in one image: exact there and back, nothing mixed, nothing torn."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fusecap.detect.images import GREY
from fusecap.detect.one_stage import OneStageDetector
from fusecap.detect.packing import MARGIN_PX, PackedDetector, PackedPersonDetector, plan
from fusecap.detect.person import PersonDetector
from fusecap.detect.runtimes.choice import open_network
from fusecap.errors import InputError
from tiny_networks import constant_network

sides = st.integers(40, 2000)
sizes = st.lists(st.tuples(sides, sides), min_size=1, max_size=16)


@given(sizes=sizes, canvas=st.tuples(st.integers(300, 900), st.integers(300, 900)))
def test_points_and_boxes_come_back_exactly(sizes, canvas):
    packing = plan(sizes, canvas)
    rng = np.random.default_rng(len(sizes))
    people, boxes = [], []
    for size, tile in zip(sizes, packing.tiles, strict=True):
        points = rng.uniform(0.0, 1.0, (17, 2)) * (np.array(size) - 1.0)
        person = np.concatenate([tile.to_canvas(points), np.full((17, 1), 0.5)], axis=1)
        people.append((person, points))
        low, high = np.sort(points[:2], axis=0)
        boxes.append((np.concatenate([low, high]), tile.to_canvas(np.stack([low, high])).ravel()))
    back = packing.people(np.stack([person for person, _ in people]))
    for found, (_, points) in zip(back, people, strict=True):
        np.testing.assert_allclose(found[0, :, :2], points, atol=1e-8)
        assert len(found) == 1 and np.all(found[0, :, 2] == 0.5)
    back = packing.boxes(np.array([[*on_canvas, 0.9] for _, on_canvas in boxes]))
    for found, (box, _) in zip(back, boxes, strict=True):
        if np.all(box[2:] - box[:2] > 1e-3):
            np.testing.assert_allclose(found, [[*box, 0.9]], atol=1e-8)


@given(sizes=sizes, canvas=st.tuples(st.integers(300, 900), st.integers(300, 900)))
def test_tiles_are_inside_and_apart(sizes, canvas):
    tiles = plan(sizes, canvas).tiles
    rects = np.array([(*t.start, *np.add(t.start, t.size)) for t in tiles])
    assert np.all(rects[:, :2] >= 0) and np.all(rects[:, 2:] <= canvas)
    for i, a in enumerate(rects):
        for b in rects[i + 1 :]:
            gap = np.maximum(b[:2] - a[2:], a[:2] - b[2:])
            assert gap.max() >= MARGIN_PX
    for t, size in zip(tiles, sizes, strict=True):
        assert min(t.size) >= 1
        np.testing.assert_allclose(t.size, np.array(size) * t.scale)


def test_views_do_not_mix():
    values = (10, 60, 200, 250)
    images = [np.full((1080, 1920, 3), value, np.uint8) for value in values]
    packing = plan([(1920, 1080)] * 4, (640, 640))
    mosaic = packing.pack(images)
    assert set(np.unique(mosaic)) == {*values, GREY}
    for value, tile in zip(values, packing.tiles, strict=True):
        (x, y), (w, h) = tile.start, tile.size
        assert np.all(mosaic[y : y + h, x : x + w] == value)
    assert np.all(packing.pack([None] * 4) == GREY)


def test_four_portrait_views_and_two_instants_use_the_canvas():
    four, eight = plan([(1080, 1920)] * 4, (640, 640)), plan([(1080, 1920)] * 8, (640, 640))
    assert four.tiles[0].size == (176, 312) or four.tiles[0].size[1] >= 256
    assert eight.tiles[0].size[1] >= 240


def test_too_many_views_are_refused():
    with pytest.raises(InputError, match="do not fit"):
        plan([(640, 480)] * 1000, (64, 64))


def two_by_two():
    """Four square views of 312 px at scale 1 on 640 px, 16 px apart."""
    return plan([(312, 312)] * 4, (640, 640))


def test_box_over_an_edge_is_cut_and_given_to_the_tile_that_holds_most():
    packing = two_by_two()
    assert packing.tiles[3].start == (328, 328)
    over = np.array([[200.0, 100.0, 360.0, 300.0, 0.9]])
    first, second, third, fourth = packing.boxes(over)
    np.testing.assert_allclose(first, [[200.0, 100.0, 311.5, 300.0, 0.9]])
    assert not len(second) and not len(third) and not len(fourth)


def test_box_across_tiles_without_a_majority_is_dropped():
    assert all(len(b) == 0 for b in two_by_two().boxes(np.array([[200.0, 200.0, 440.0, 440, 0.9]])))
    assert all(len(b) == 0 for b in two_by_two().boxes(np.array([[313.0, 20.0, 327.0, 90.0, 0.9]])))


def test_keypoints_in_another_tile_or_the_margin_are_missing():
    person = np.zeros((1, 17, 3))
    person[0, :, 0] = np.linspace(100.0, 300.0, 17)
    person[0, :, 1], person[0, :, 2] = 150.0, 0.8
    person[0, 15, :2] = [320.0, 150.0]
    person[0, 16, :2] = [340.0, 150.0]
    found = two_by_two().people(person)
    assert [len(people) for people in found] == [1, 0, 0, 0]
    assert list(np.flatnonzero(found[0][0, :, 2] == 0.0)) == [15, 16]
    assert np.isnan(found[0][0, 15:, :2]).all()
    np.testing.assert_allclose(found[0][0, :15], person[0, :15])


def test_packed_one_stage_detector_takes_two_instants_at_once(tmp_path):
    sizes = [(312, 312)] * 4
    tiles = plan(sizes, (640, 640)).tiles
    people = np.zeros((1, 4, 17, 3))
    for i, tile in enumerate(tiles):
        people[0, i, :, 0] = tile.start[0] + np.linspace(100, 180, 17) + i
        people[0, i, :, 1] = tile.start[1] + np.linspace(50, 250, 17)
        people[0, i, :, 2] = 0.9
    dets = np.full((1, 4, 5), 0.9)
    path = constant_network(
        tmp_path / "n.onnx", (1, 3, 640, 640), {"dets": dets, "keypoints": people}
    )
    detector = PackedDetector(OneStageDetector(open_network(path)))
    assert detector.identity.endswith("packed")
    image = np.zeros((312, 312, 3), np.uint8)
    before, after = detector.detect_instants([[image, image], [image, image]])
    for i, (found,) in enumerate((*before, *after)):
        np.testing.assert_allclose(found[:, 0], np.linspace(100, 180, 17) + i, atol=1e-4)
    one = detector.detect([image, None, image, image, image], [np.empty((0, 17, 3))] * 5)
    assert [len(found) for found in one] == [1, 0, 1, 1, 1]
    assert [len(found) for found in detector.detect([None], [np.empty((0, 17, 3))])] == [0]
    with pytest.raises(InputError, match="3 instants"):
        detector.detect_instants([[image]] * 3)


def test_packed_person_detector_gives_boxes_per_view(tmp_path):
    dets = np.array([[[100, 50, 180, 250, 0.9], [428, 378, 508, 578, 0.8]]])
    path = constant_network(
        tmp_path / "rtmdet.onnx",
        ("n", 3, 640, 640),
        {"dets": dets, "labels": np.zeros((1, 2), np.int64)},
    )
    packed = PackedPersonDetector(PersonDetector(open_network(path)))
    image = np.zeros((312, 312, 3), np.uint8)
    found = packed.find([image] * 4)
    assert [len(boxes) for boxes in found] == [1, 0, 0, 1]
    np.testing.assert_allclose(found[3], [[100, 50, 180, 250, 0.8]], atol=1e-4)
    assert packed.find([]) == ()
