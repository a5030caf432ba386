import tracemalloc

import numpy as np
import pytest

from fusecap.errors import InputError
from fusecap.sources.video import Video, probe, videos_in
from video_files import number_of, stripe, turn_clockwise, write_sound, write_video


def numbers(video, first=0):
    return [(frame.number, number_of(frame.image)) for frame in video.frames(first)]


@pytest.mark.parametrize("suffix", [".mp4", ".mkv", ".avi", ".webm"])
def test_frames_come_in_the_order_shown_with_their_times(tmp_path, suffix):
    video = Video(write_video(tmp_path / f"a{suffix}"))
    assert numbers(video) == [(n, n) for n in range(20)]
    times_ns = [frame.time_ns for frame in video.frames()]
    assert times_ns == video.times_ns.tolist()
    assert times_ns == pytest.approx(np.arange(20) / 30 * 1e9, abs=1e6)
    assert video.info.frames == 20 and not video.info.is_variable_rate
    assert video.info.rate_hz == pytest.approx(30.0, rel=1e-9)
    assert video.info.duration_s == pytest.approx(20 / 30, abs=2e-3)
    assert video.info.size_px == (64, 48) and video.notes == ()


@pytest.mark.parametrize("suffix", [".mp4", ".mkv", ".avi", ".webm"])
@pytest.mark.parametrize("first", [1, 12, 35, 59])
def test_reading_from_a_frame_gives_what_reading_from_the_start_gives(tmp_path, suffix, first):
    video = Video(write_video(tmp_path / f"a{suffix}", 60))
    whole = {frame.number: frame.image for frame in video.frames()}
    rest = list(video.frames(first))
    assert [frame.number for frame in rest] == list(range(first, 60))
    assert all(np.array_equal(frame.image, whole[frame.number]) for frame in rest)
    assert list(video.frames(60)) == []


def test_variable_rate_keeps_each_frames_time(tmp_path):
    times_s = np.cumsum([0.0, 0.033, 0.033, 0.1, 0.033, 0.5, 0.017, 0.033])
    video = Video(write_video(tmp_path / "a.mkv", 8, times_s=times_s))
    assert video.times_ns.tolist() == [round(t * 1000) * 1_000_000 for t in times_s]
    assert video.info.is_variable_rate
    assert video.info.rate_hz == pytest.approx(7 / times_s[-1])


def test_times_start_at_the_first_frame(tmp_path):
    video = Video(write_video(tmp_path / "a.mkv", 5, times_s=2.0 + np.arange(5) / 25))
    assert video.times_ns.tolist() == [0, 40_000_000, 80_000_000, 120_000_000, 160_000_000]
    assert not video.info.is_variable_rate


def test_rate_of_broadcast_video_is_exact(tmp_path):
    assert probe(write_video(tmp_path / "a.mp4", rate_hz=30000 / 1001)).rate_hz == 30000 / 1001


def test_pictures_are_turned_as_the_file_says(tmp_path):
    path = write_video(tmp_path / "a.mp4", 3)
    stored = next(Video(path).frames()).image
    turn_clockwise(path)
    video = Video(path)
    assert video.info.size_px == (48, 64) and video.info.rotation_deg == 270
    shown = next(video.frames()).image
    assert np.array_equal(shown, np.rot90(stored, -1)) and shown.flags.c_contiguous


def test_long_video_takes_no_more_memory(tmp_path):
    video = Video(write_video(tmp_path / "a.mp4", 120, picture=lambda n: stripe(n, (320, 240))))
    frames = video.frames()
    for _ in range(20):
        next(frames)
    tracemalloc.start()
    for frame in frames:
        assert frame.image.shape == (240, 320, 3)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 8 * 320 * 240 * 3


def test_file_cut_in_the_middle_gives_its_frames_and_says_so(tmp_path):
    noise = np.random.default_rng(1).integers(0, 255, (60, 96, 128, 3), dtype=np.uint8)
    path = write_video(tmp_path / "a.avi", 60, picture=lambda n: noise[n])
    path.write_bytes(path.read_bytes()[: path.stat().st_size * 6 // 10])
    video = Video(path)
    assert 20 < len(list(video.frames())) < 50
    assert "cut short" in video.notes[0] and "of 60 frames" in video.notes[0]


def test_broken_picture_is_left_out_and_later_ones_keep_their_numbers(tmp_path):
    noise = np.random.default_rng(1).integers(0, 255, (20, 96, 128, 3), dtype=np.uint8)
    path = write_video(tmp_path / "a.avi", 20, picture=lambda n: noise[n], codec="mjpeg")
    data = bytearray(path.read_bytes())
    start = data.index(b"movi")
    for _ in range(7):
        start = data.index(b"00dc", start + 4)
    size = int.from_bytes(data[start + 4 : start + 8], "little")
    data[start + 8 : start + 8 + size] = bytes(size)
    path.write_bytes(data)
    found = [frame.number for frame in Video(path).frames()]
    assert 6 not in found and found[-1] == 19 and len(found) == 19


def without_index(path):
    data = write_video(path).read_bytes()
    path.write_bytes(data[: data.index(b"moov") - 4])


@pytest.mark.parametrize(
    ("name", "make", "words"),
    [
        ("a.mp4", without_index, "cannot be read as a video.*lacks its index"),
        ("a.mp4", lambda path: path.write_bytes(b""), "an empty file"),
        ("a.mp4", lambda path: path.write_bytes(b"\x07garbage" * 999), "cannot be read as a video"),
        ("a.m4a", write_sound, "no video in this file, found audio"),
        ("a.mp4", lambda path: write_video(path, 0), "no video in this file, found nothing"),
        ("a.mkv", lambda path: write_video(path, 0), "cannot be read as a video"),
        ("a.mp4", lambda path: path.mkdir(), "is a folder"),
        ("a.mp4", lambda path: None, "no such file"),
    ],
)
def test_what_is_no_video_is_refused_in_words(tmp_path, name, make, words):
    make(tmp_path / name)
    with pytest.raises(InputError, match=words):
        Video(tmp_path / name)


def test_videos_of_a_folder_by_name(tmp_path):
    for name in ("b.MP4", "a.mov", "notes.txt", ".hidden.mp4"):
        (tmp_path / name).touch()
    assert [path.name for path in videos_in(tmp_path)] == ["a.mov", "b.MP4"]
    (tmp_path / "empty").mkdir()
    with pytest.raises(InputError, match="no videos"):
        videos_in(tmp_path / "empty")


@pytest.mark.real_data
def test_recorded_videos_open(data_dir):
    found = sorted(data_dir.glob("pose2sim_demo/HEAD_Demo_*/videos/*.mp4"))
    assert len(found) == 8
    for path in found:
        info = probe(path)
        assert (info.frames, info.rate_hz, info.is_variable_rate) == (100, 60.0, False)
