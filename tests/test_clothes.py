"""What clothes tell: how they are read out of pictures, kept, and when they decide who is who."""

from __future__ import annotations

import json
from queue import Queue

import numpy as np
import pytest

from fusecap.appearance import APPEARANCE_SIZE, by_part, difference, unknown
from fusecap.associate.looks import MARGIN, OTHER, by_looks
from fusecap.associate.looks import looks as nothing_seen
from fusecap.batch.detect import detect_videos, loose_videos
from fusecap.believable import believable_detections
from fusecap.body.landmarks import landmark_set_named
from fusecap.detect.clothes import ClothesReader
from fusecap.errors import InputError
from fusecap.evaluate.clothes_trials import occluder, re_entry, small_ring, stranger
from fusecap.evaluate.painted_people import Clothes, Painter
from fusecap.exports.openpose import write_frame
from fusecap.live.detection import DetectionLoop
from fusecap.live.devices.source import SessionClock
from fusecap.live.health import Incidents
from fusecap.live.latency import LatencyBook
from fusecap.recording.layout import DECODERS, KEYPOINTS, Known, keypoints_message
from fusecap.sources.keypoint_files import read_keypoints
from fusecap.sources.synchronizer import ViewOfPeople, detections_of, seen_amid, seen_at
from fusecap.types import CameraImage, CameraSample, Detections
from people_scene import BODY25, straight, walker
from video_files import write_video

RED_AND_BLACK = Clothes(top=(30.0, 30.0, 200.0), bottom=(25.0, 25.0, 25.0))
BLUE_AND_WHITE = Clothes(top=(200.0, 60.0, 30.0), bottom=(220.0, 220.0, 220.0))
GREY_AND_BLACK = Clothes(top=(120.0, 120.0, 120.0), bottom=(25.0, 25.0, 25.0))
RIG = small_ring(2)
READER = ClothesReader(BODY25)


def standing(x_m: float, z_m: float = 0.0) -> np.ndarray:
    return walker(straight((x_m, z_m), (0.0, 0.0)), np.zeros(1))[0]


def keypoints(camera: int, *bodies: np.ndarray, confidence: float = 0.9) -> np.ndarray:
    pixels = RIG.cameras[camera].project(np.stack(bodies).reshape(-1, 3))
    pixels = pixels.reshape(len(bodies), -1, 2)
    return np.concatenate([pixels, np.full((*pixels.shape[:2], 1), confidence)], axis=2)


def shown(clothes: Clothes, *, seed: int = 1, light: float = 1.0, x_m: float = 0.0) -> np.ndarray:
    """What one picture of somebody standing tells (40,)."""
    painter = Painter(RIG, BODY25, [clothes], seed=seed)
    body = standing(x_m)
    image = painter.picture(0, RIG.cameras[0], body[None], light=light)
    return READER.read(image, keypoints(0, body))[0]


def apart(a: np.ndarray, b: np.ndarray) -> float:
    return float(difference(by_part(a.astype(float)), by_part(b.astype(float))))


# ---------------------------------------------------------------------------------------- pictures


@pytest.mark.parametrize("light", [0.5, 0.7, 1.4, 1.8])
def test_light_of_the_whole_room_changes_little(light):
    red = shown(RED_AND_BLACK)
    assert apart(red, shown(RED_AND_BLACK, light=light)) < 0.25
    assert apart(red, shown(BLUE_AND_WHITE, light=light)) > OTHER
    assert apart(red, shown(GREY_AND_BLACK, light=light)) > 0.3


def test_clothes_do_not_depend_on_where_in_the_picture_somebody_stands():
    assert apart(shown(RED_AND_BLACK, x_m=-0.8), shown(RED_AND_BLACK, x_m=0.7)) < 0.2


def test_white_and_black_without_any_colour_are_nothing_alike():
    white = Clothes(top=(230.0, 230.0, 230.0), bottom=(230.0, 230.0, 230.0))
    black = Clothes(top=(20.0, 20.0, 20.0), bottom=(20.0, 20.0, 20.0))
    assert apart(shown(white), shown(black)) > OTHER


def test_nothing_is_read_of_people_one_before_the_other_or_hardly_found():
    painter = Painter(RIG, BODY25, [RED_AND_BLACK, BLUE_AND_WHITE], seed=1)
    camera = RIG.cameras[0]
    behind = standing(0.1, 0.6)
    pair = np.stack([standing(0.0), behind])
    image = painter.picture(0, camera, pair)
    assert not READER.read(image, keypoints(0, *pair)).any()
    assert not READER.read(image, keypoints(0, pair[0], confidence=0.2)).any()
    assert READER.read(image, keypoints(0, pair[0])).any()


def test_people_at_the_edge_unfound_and_no_picture_at_all_are_no_trouble():
    image = np.zeros((360, 640, 3), np.uint8)
    body = keypoints(0, standing(0.0))
    assert not READER.read(image, body - [600.0, 0.0, 0.0]).any()
    missing = np.full_like(body, np.nan)
    missing[:, :, 2] = 0.0
    assert not READER.read(image, missing).any()
    assert READER.read(image, body[:0]).shape == (0, APPEARANCE_SIZE)
    assert not READER.read(np.zeros((0, 0, 3), np.uint8), body).any()


def test_a_part_that_one_of_two_never_showed_is_not_compared():
    red = shown(RED_AND_BLACK)
    torso_only = red.copy()
    torso_only[APPEARANCE_SIZE // 2 :] = 0
    assert apart(red, torso_only) < 1e-6
    assert np.isnan(apart(red, unknown(1)[0]))


class Standing:
    """Finds the same person in every picture."""

    landmarks = BODY25
    identity = "standing 1"

    def detect(self, images, predicted):
        body = keypoints(0, standing(0.0))
        return tuple(body[:0] if image is None else body for image in images)

    def reset(self):
        pass


def painted() -> np.ndarray:
    painter = Painter(RIG, BODY25, [RED_AND_BLACK], seed=1)
    return painter.picture(0, RIG.cameras[0], standing(0.0)[None])


def test_detected_videos_leave_clothes_beside_keypoints(tmp_path):
    image = painted()
    video = write_video(tmp_path / "a.mp4", 3, picture=lambda n: image)
    [camera] = loose_videos([video], tmp_path / "keypoints")
    detect_videos([camera], Standing())
    track = read_keypoints(camera.folder, name="a", landmarks=BODY25, rate_hz=30.0)
    assert track.appearance is not None
    for looks in track.appearance:
        assert apart(looks[0], shown(RED_AND_BLACK)) < 0.2


def test_live_pictures_leave_clothes_beside_keypoints():
    clock, found = SessionClock(), Queue()
    loop = DetectionLoop(
        Standing(),
        1,
        emit=found.put,
        show=lambda image: None,
        clock=clock,
        latency=LatencyBook(),
        incidents=Incidents(clock),
    )
    loop.start()
    loop.offer(CameraImage(camera=0, timestamp_ns=clock.now_ns(), image=painted()))
    sample = found.get(timeout=20)
    loop.stop()
    assert loop.join(20)
    assert sample.appearance is not None
    assert apart(sample.appearance[0], shown(RED_AND_BLACK)) < 0.2


# ------------------------------------------------------------------------------------------- kept


def test_folder_of_keypoints_gives_back_what_was_read_out_of_pictures(tmp_path):
    looks = np.stack([shown(RED_AND_BLACK), unknown(1)[0], shown(BLUE_AND_WHITE)])
    people = keypoints(0, standing(-1.0), standing(0.0), standing(1.0))
    people[1] = [np.nan, np.nan, 0.0]  # left out when it is read, and its row with it
    write_frame(tmp_path, "cam", 0, people, looks)
    write_frame(tmp_path, "cam", 1, people)
    track = read_keypoints(tmp_path, name="cam", landmarks=BODY25, rate_hz=30.0)
    assert track.appearance is not None
    assert np.array_equal(track.appearance[0], looks[[0, 2]])
    assert not track.appearance[1].any()
    seen = seen_at(track, 0.0)
    assert seen.appearance is not None and np.array_equal(seen.appearance, looks[[0, 2]])


@pytest.mark.parametrize("looks", [None, [], [1] * 39, ["a"] * 40, [300] * 40, [0.5] * 40, {}])
def test_folder_without_believable_clothes_reads_as_before(tmp_path, looks):
    person = {"pose_keypoints_2d": keypoints(0, standing(0.0))[0].ravel().tolist()}
    if looks is not None:
        person["appearance"] = looks
    (tmp_path / "cam_0_keypoints.json").write_text(json.dumps({"people": [person]}))
    track = read_keypoints(tmp_path, name="cam", landmarks=BODY25, rate_hz=30.0)
    assert len(track.people[0]) == 1 and track.appearance is None


def test_recorded_sample_reads_back_with_and_without_clothes():
    known = Known(cameras=1, landmarks=25, sensors=frozenset(), skeleton="paper21")
    looks = np.stack([shown(RED_AND_BLACK)])
    for appearance in (looks, None):
        sample = CameraSample(
            camera=0, timestamp_ns=5, people=keypoints(0, standing(0.0)), appearance=appearance
        )
        read = DECODERS[KEYPOINTS](json.loads(keypoints_message(sample)), known)
        assert np.array_equal(read.people, sample.people)
        assert (read.appearance is None) == (appearance is None)
        assert appearance is None or np.array_equal(read.appearance, appearance)


@pytest.mark.parametrize("looks", [[[1] * 39], [], [[300] * 40], "red"])
def test_recorded_clothes_that_do_not_fit_make_a_broken_message(looks):
    known = Known(cameras=1, landmarks=25, sensors=frozenset(), skeleton="paper21")
    sample = CameraSample(camera=0, timestamp_ns=5, people=keypoints(0, standing(0.0)))
    values = json.loads(keypoints_message(sample)) | {"appearance": looks}
    with pytest.raises((ValueError, OverflowError, TypeError)):
        DECODERS[KEYPOINTS](values, known)


def test_between_two_pictures_clothes_are_those_of_the_nearer_one():
    bodies = keypoints(0, standing(-1.0), standing(1.0))
    first = ViewOfPeople(bodies, np.stack([shown(RED_AND_BLACK), shown(BLUE_AND_WHITE)]))
    second = ViewOfPeople(bodies[::-1] + 1.0, np.stack([shown(GREY_AND_BLACK), unknown(1)[0]]))
    found = seen_amid((0.0, first), (0.1, second), 0.03, period_s=0.1)
    later = seen_amid((0.0, first), (0.1, second), 0.07, period_s=0.1)
    assert found is not None and later is not None
    assert found.appearance is not None and later.appearance is not None
    assert np.array_equal(found.appearance, first.appearance)
    assert not later.appearance[0].any() and later.appearance[1].any()


def test_camera_without_pictures_among_others_shows_no_clothes():
    body = keypoints(0, standing(0.0))
    views = [ViewOfPeople(body, np.stack([shown(RED_AND_BLACK)])), ViewOfPeople(body)]
    found = detections_of(0, views).appearance
    assert found is not None and found[0].any() and not found[1].any()
    assert detections_of(0, [ViewOfPeople(body), ViewOfPeople(body)]).appearance is None


@pytest.mark.parametrize("looks", [(unknown(2),), (unknown(1), unknown(1)), (np.zeros((1, 40)),)])
def test_clothes_of_other_people_than_were_detected_are_refused(looks):
    people = (keypoints(0, standing(0.0)),)
    with pytest.raises(InputError, match="appearance"):
        believable_detections(Detections(timestamp_ns=0, people=people, appearance=looks), 1, 25)


def test_every_landmark_set_can_be_read():
    for name in ("coco17", "halpe26", "mpi15", "blazepose33", "wholebody133"):
        ClothesReader(landmark_set_named(name))


# ---------------------------------------------------------------------------------------- deciding


def test_clothes_decide_by_a_margin_only():
    away = np.array([[0.1, 0.1 + 2 * MARGIN], [0.2, 0.15]])
    assert by_looks(away).tolist() == [[True, False], [True, True]]
    assert by_looks(np.array([[0.2, 0.2 + MARGIN / 2]])).all()
    assert by_looks(np.array([[np.nan, OTHER + 0.01]])).tolist() == [[True, False]]
    assert by_looks(np.array([[np.nan, 0.08]])).tolist() == [[False, True]]


def test_what_is_seen_in_doubt_changes_nothing_known_until_it_is_believed():
    looks = nothing_seen(1)
    red = by_part(shown(RED_AND_BLACK).astype(float))[None]
    blue = by_part(shown(BLUE_AND_WHITE).astype(float))[None]
    for _ in range(20):
        looks.learn(red)
    looks.doubt(5)
    for _ in range(20):
        looks.learn(blue)
    assert np.allclose(looks.known, red) and np.allclose(looks.fresh, blue)
    looks.believe()
    assert np.allclose(looks.known, (red + blue) / 2)


def test_who_returns_after_ten_seconds_is_known_by_clothes():
    assert re_entry(1).right == 3


def test_stranger_does_not_take_the_place_of_who_left():
    assert stranger(1).right == 2


def test_people_in_the_same_clothes_are_not_exchanged_by_them():
    assert occluder(0, alike=True).moved == 0


def test_who_comes_out_of_hiding_exchanged_is_put_right():
    trial = occluder(4)
    assert trial.right == 2 and trial.moved > 0
