import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from fusecap.sources.frame_sets import clock_times_ns, every_frame, frame_sets, nearest_frames
from fusecap.sources.video import Video
from video_files import number_of, write_video

MS = 1_000_000


def times(count, rate_hz, start_s=0.0):
    return np.round((start_s + np.arange(count) / rate_hz) * 1e9).astype(np.int64)


def test_nearest_frame_of_each_camera_within_half_its_period():
    own = [times(4, 30), times(8, 60, 0.003), times(2, 30, 0.040)]
    plan = nearest_frames(own, own[0])
    assert plan.timestamps_ns.tolist() == own[0].tolist()
    assert plan.frame.tolist() == [[0, 0, -1], [1, 2, 0], [2, 4, 1], [3, 6, -1]]


def test_slow_camera_serves_the_instants_near_its_frames():
    plan = nearest_frames([times(3, 10)], times(30, 100))
    assert plan.frame[:, 0].tolist()[:7] == [0, 0, 0, 0, 0, 0, 1]
    assert plan.frame[-1, 0] == -1


def test_cameras_that_start_together_are_seen_together():
    plan = every_frame([times(3, 60), times(3, 60, 0.004), times(2, 30)])
    assert plan.frame.tolist() == [[0, 0, 0], [1, 1, -1], [2, 2, 1]]
    assert plan.timestamps_ns.tolist() == times(3, 60).tolist()


def test_empty_and_single_frame_cameras():
    assert len(every_frame([])) == 0
    assert every_frame([times(1, 60), times(0, 60)]).frame.tolist() == [[0, -1]]
    assert nearest_frames([times(1, 60)], times(3, 60)).frame.tolist() == [[0], [-1], [-1]]


@given(
    st.lists(
        st.tuples(st.lists(st.integers(1, 90), min_size=1, max_size=30), st.integers(0, 500)),
        min_size=1,
        max_size=4,
    )
)
def test_every_frame_comes_exactly_once_and_time_does_not_go_back(cameras):
    own = [(start + np.cumsum(steps)) * MS for steps, start in cameras]
    plan = every_frame(own)
    for camera, stamps in enumerate(own):
        column = plan.frame[:, camera]
        assert column[column >= 0].tolist() == list(range(len(stamps)))
        rows = np.flatnonzero(column >= 0)
        assert np.all(stamps >= plan.timestamps_ns[rows])
    assert np.all(np.diff(plan.timestamps_ns) >= 0)


def test_pictures_of_an_instant_are_those_of_its_plan(tmp_path):
    videos = [
        Video(write_video(tmp_path / "a.mp4", 12, rate_hz=30)),
        Video(write_video(tmp_path / "b.mp4", 40, rate_hz=60)),
    ]
    own = [clock_times_ns(videos[0]), clock_times_ns(videos[1], offset_s=-0.1)]
    plan = nearest_frames(own, own[0])
    shown = [
        [None if frame is None else number_of(frame.image) for frame in frames.frames]
        for frames in frame_sets(videos, plan)
    ]
    assert shown == [[n, 2 * n + 6] for n in range(12)]


def test_frame_that_serves_twice_and_one_that_is_skipped(tmp_path):
    video = Video(write_video(tmp_path / "a.mp4", 12, rate_hz=30))
    plan = nearest_frames([clock_times_ns(video)], np.array([0, 5, 100, 110, 200, 900]) * MS)
    shown = [frames.frames[0] for frames in frame_sets([video], plan)]
    assert [frame and frame.number for frame in shown] == [0, 0, 3, 3, 6, None]
