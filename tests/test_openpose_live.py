import json
import os

import numpy as np
import pytest

from fusecap.body.landmarks import landmark_set_named
from fusecap.errors import InputError
from fusecap.sources.openpose_live import LISTING_NS, PATIENCE_NS, OpenPoseFolder

COCO = landmark_set_named("coco17")
MS = 1_000_000


def text(x=100.0, count=17):
    body = np.column_stack([np.full(count, x), np.arange(count) + 1.0, np.full(count, 0.9)])
    return json.dumps({"people": [{"pose_keypoints_2d": body.ravel().tolist()}]})


def put(folder, number, content=None, *, written_s=None):
    folder.mkdir(exist_ok=True)
    path = folder / f"cam_{number:012d}_keypoints.json"
    path.write_text(text(100.0 + number) if content is None else content)
    at_s = 1000.0 + number if written_s is None else written_s
    os.utime(path, (at_s, at_s))
    return path


def numbers(frames):
    return [frame.number for frame in frames]


def test_frames_come_once_in_order_as_they_are_written(tmp_path):
    live = OpenPoseFolder(tmp_path / "cam", COCO)
    assert live.poll(0) == []
    put(tmp_path / "cam", 0)
    put(tmp_path / "cam", 1)
    frames = live.poll(LISTING_NS)
    assert numbers(frames) == [0, 1] and frames[1].people[0, 0, 0] == 101.0
    assert frames[0].read_ns == LISTING_NS
    put(tmp_path / "cam", 2)
    assert numbers(live.poll(LISTING_NS + 1 * MS)) == [2]
    assert live.poll(LISTING_NS + 2 * MS) == []
    assert live.counts.frames == 3 and live.counts.dropped == 0


def test_half_written_file_is_read_once_it_is_whole(tmp_path):
    live = OpenPoseFolder(tmp_path, COCO)
    put(tmp_path, 0)
    put(tmp_path, 1, text()[:50])
    assert numbers(live.poll(0)) == [0]
    assert live.poll(10 * MS) == []
    put(tmp_path, 1)
    assert numbers(live.poll(20 * MS)) == [1]
    assert live.counts.broken == 0


def test_file_that_stays_broken_is_passed_and_counted(tmp_path):
    live = OpenPoseFolder(tmp_path, COCO)
    put(tmp_path, 0)
    put(tmp_path, 1, "{")
    put(tmp_path, 2)
    assert numbers(live.poll(0)) == [0]
    assert numbers(live.poll(PATIENCE_NS)) == [2]
    assert live.counts.broken == 1


def test_gap_holds_up_later_frames_for_a_while_then_counts_as_dropped(tmp_path):
    live = OpenPoseFolder(tmp_path, COCO)
    for number in (5, 6, 9):
        put(tmp_path, number)
    assert numbers(live.poll(0)) == [5, 6]
    assert live.poll(PATIENCE_NS - 1) == []
    assert numbers(live.poll(PATIENCE_NS)) == [9]
    assert live.counts.dropped == 2


def test_another_run_from_frame_0_ignores_what_the_first_left(tmp_path):
    live = OpenPoseFolder(tmp_path, COCO)
    for number in range(6):
        put(tmp_path, number)
    assert numbers(live.poll(0)) == [0, 1, 2, 3, 4, 5]
    put(tmp_path, 0, written_s=2000.0)
    put(tmp_path, 1, written_s=2001.0)
    frames = live.poll(LISTING_NS)
    assert numbers(frames) == [0, 1] and {frame.run for frame in frames} == {1}
    assert live.poll(2 * LISTING_NS) == []
    put(tmp_path, 2, written_s=2002.0)
    assert numbers(live.poll(3 * LISTING_NS)) == [2]
    assert live.counts.restarts == 1 and live.counts.dropped == 0


def test_late_file_of_a_dropped_frame_is_no_restart(tmp_path):
    live = OpenPoseFolder(tmp_path, COCO)
    for number in (0, 1, 3):
        put(tmp_path, number)
    live.poll(0)
    assert numbers(live.poll(PATIENCE_NS)) == [3]
    put(tmp_path, 2, written_s=5000.0)
    assert live.poll(PATIENCE_NS + LISTING_NS) == []
    put(tmp_path, 4, written_s=5001.0)
    assert numbers(live.poll(PATIENCE_NS + 2 * LISTING_NS)) == [4]
    assert live.counts.restarts == 0


def test_files_and_folder_deleted_underneath_are_survived(tmp_path):
    folder = tmp_path / "cam"
    live = OpenPoseFolder(folder, COCO)
    put(folder, 0)
    assert numbers(live.poll(0)) == [0]
    for path in folder.iterdir():
        path.unlink()
    folder.rmdir()
    assert live.poll(LISTING_NS) == []
    put(folder, 1)
    put(folder, 3).unlink()
    assert numbers(live.poll(2 * LISTING_NS)) == [1]
    put(folder, 4)
    assert live.poll(3 * LISTING_NS) == []
    assert numbers(live.poll(3 * LISTING_NS + PATIENCE_NS)) == [4]
    assert live.counts.dropped == 2


def test_frames_from_before_can_be_skipped(tmp_path):
    live = OpenPoseFolder(tmp_path, COCO, skip_existing=True)
    put(tmp_path, 0)
    put(tmp_path, 1)
    assert live.poll(0) == []
    put(tmp_path, 2)
    assert numbers(live.poll(1)) == [2]
    put(tmp_path, 0, written_s=3000.0)
    assert numbers(live.poll(2 * LISTING_NS)) == [0]


def test_other_format_is_refused(tmp_path):
    put(tmp_path, 0, text(count=25))
    with pytest.raises(InputError, match="openpose-body25"):
        OpenPoseFolder(tmp_path, COCO).poll(0)
