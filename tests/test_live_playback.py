"""Recorded sessions delivered as if live, and faults on the way; time passes where one waits."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pytest
from live_faults import Fault, FaultKind, FaultyDetector, FaultySource

from fusecap.body.landmarks import LANDMARK_SETS
from fusecap.errors import InputError, SessionError
from fusecap.live.devices.playback_sources import PlaybackOptions, Stall, playback_sources
from fusecap.live.devices.source import Delivery, SessionClock, Source, SourceCounts, SourceLost
from fusecap.sources.session_data import open_session
from fusecap.sources.session_file import load_session
from fusecap.types import CameraImage, CameraSample, ImuSample
from session_files import calibration_toml, edit, imu_csv, ring, write_session
from video_files import number_of, write_video

START_NS = 5_000_000_000


class Clock(SessionClock):
    """Time passes where somebody waits."""

    def __init__(self) -> None:
        self.ns = START_NS

    def now_ns(self) -> int:
        return self.ns


class Stopping(threading.Event):
    """Waiting takes no time on the wall, and ends the run at `until_s` after the start."""

    def __init__(self, clock: Clock, until_s: float = 1e9) -> None:
        super().__init__()
        self._clock = clock
        self._until_ns = START_NS + round(until_s * 1e9)

    def wait(self, timeout: float | None = None) -> bool:
        assert timeout is not None
        self._clock.ns += round(timeout * 1e9)
        if self._clock.ns >= self._until_ns:
            self.set()
        return self.is_set()


def played(
    source: Source,
    clock: Clock,
    until_s: float = 1e9,
    meanwhile: Callable[[], None] = lambda: None,
) -> list[tuple[Delivery, float]]:
    """What a source delivers, and when after the start [s]."""
    items: list[tuple[Delivery, float]] = []

    def deliver(item: Delivery) -> None:
        items.append((item, (clock.ns - START_NS) * 1e-9))
        meanwhile()

    source.run(deliver, Stopping(clock, until_s))
    return items


def sources_of(
    path: Path, options: PlaybackOptions | None = None
) -> tuple[dict[str, Source], Clock]:
    clock = Clock()
    sources = playback_sources(load_session(path), clock, options)
    return {source.name: source for source in sources}, clock


def stamps_s(items: Sequence[tuple[Delivery, float]]) -> np.ndarray:
    return np.array([item.timestamp_ns - START_NS for item, _ in items]) * 1e-9


def image(item: Delivery) -> np.ndarray:
    assert isinstance(item, CameraImage)
    return item.image


def people(item: Delivery) -> np.ndarray:
    assert isinstance(item, CameraSample)
    return item.people


@pytest.fixture
def session_path(tmp_path) -> Path:
    """Four cameras at 30 Hz for 2 s; cam1 is 10 ms behind."""
    path = write_session(tmp_path)
    edit(path, 'name = "cam1"\n', 'name = "cam1"\noffset_s = 0.01\n')
    return path


def add_sensors(path: Path) -> None:
    """Two sensors at 50 Hz; the second starts 0.05 s later and its clock is 0.1 s behind."""
    times_s = np.arange(40) / 50
    for bone, first in (("head", 0), ("hips", 1)):
        quaternions = np.tile([1.0, 0.0, 0.0, 0.0], (40, 1))
        quaternions[:, 1] = 0.01 * np.arange(40)
        quaternions /= np.linalg.norm(quaternions, axis=1, keepdims=True)
        text = imu_csv(times_s + 0.05 * first, quaternions)
        (path.parent / f"{bone}.csv").write_text(text)
    with path.open("a") as file:
        file.write('\n[[subject]]\nname = "anna"\n')
        for bone in ("head", "hips"):
            file.write(
                f'\n[[subject.imu]]\nbone = "{bone}"\nfile = "{bone}.csv"\n'
                "bone_from_imu_wxyz = [1, 0, 0, 0]\n"
            )
    (path.parent / "sync.toml").write_text(
        'format = "fusecap sync 1"\n[subject.anna.hips]\noffset_s = 0.1\n'
    )
    edit(path, "rate_hz = 30\n", 'rate_hz = 30\nsync = "sync.toml"\n')


def test_every_frame_comes_once_at_its_time_as_recorded(session_path):
    sources, clock = sources_of(session_path)
    assert list(sources) == [f"camera 'cam{i}'" for i in range(4)]
    items = played(sources["camera 'cam0'"], clock)
    recorded = open_session(load_session(session_path)).keypoints[0]
    np.testing.assert_allclose(stamps_s(items), np.arange(60) / 30, atol=1e-8)
    np.testing.assert_allclose([when for _, when in items], np.arange(60) / 30, atol=1e-8)
    for (item, _), expected in zip(items, recorded.people, strict=True):
        np.testing.assert_array_equal(people(item), expected)
    assert sources["camera 'cam0'"].counts.received == 60


def test_cameras_keep_their_offsets_and_share_one_start(session_path):
    sources, clock = sources_of(session_path)
    played(sources["camera 'cam0'"], clock)
    clock.ns = START_NS
    items = played(sources["camera 'cam1'"], clock)
    np.testing.assert_allclose(stamps_s(items), 0.01 + np.arange(60) / 30, atol=1e-8)


def test_sensors_of_a_subject_come_merged_on_the_clocks_of_the_sync_file(session_path):
    add_sensors(session_path)
    sources, clock = sources_of(session_path)
    items = played(sources["imus of 'anna'"], clock)
    stamps = stamps_s(items)
    assert np.all(np.diff(stamps) >= 0)
    by_bone: dict[str, list[float]] = {"head": [], "hips": []}
    for (item, _), stamp in zip(items, stamps, strict=True):
        assert isinstance(item, ImuSample) and item.subject == "anna"
        by_bone[item.bone].append(stamp)
        number = len(by_bone[item.bone]) - 1
        assert item.orientation_wxyz[1] / item.orientation_wxyz[0] == pytest.approx(0.01 * number)
    np.testing.assert_allclose(by_bone["head"], np.arange(40) / 50, atol=1e-8)
    np.testing.assert_allclose(by_bone["hips"], np.arange(40) / 50 + 0.15, atol=1e-8)


def test_loop_starts_again_without_a_jump_in_time(session_path):
    sources, clock = sources_of(session_path, PlaybackOptions(loop=True))
    items = played(sources["camera 'cam0'"], clock, until_s=4.5)
    steps = np.diff(stamps_s(items))
    assert len(items) > 120
    # The slowest camera's period separates the last sample of all from the next round's first.
    assert steps[59] == pytest.approx(1 / 30 + 0.01) and steps.max() == steps[59]
    np.testing.assert_array_equal(people(items[60][0]), people(items[0][0]))


def test_there_and_back_nobody_jumps_and_all_sources_turn_together(session_path):
    options = PlaybackOptions(there_and_back=True)
    sources, clock = sources_of(session_path, options)
    mirror_s = []
    for name in ("camera 'cam0'", "camera 'cam1'"):
        clock.ns = START_NS
        items = played(sources[name], clock, until_s=9.0)
        shown = [people(item) for item, _ in items]
        np.testing.assert_array_equal(shown[60:120], shown[:60][::-1])
        np.testing.assert_array_equal(shown[120:180], shown[:60])
        stamps = stamps_s(items)
        mirror_s.append(stamps[:60] + stamps[60:120][::-1])
    np.testing.assert_allclose(mirror_s, mirror_s[0][0], atol=1e-8)


def test_run_again_goes_on_with_the_present(session_path):
    sources, clock = sources_of(session_path)
    source = sources["camera 'cam0'"]
    assert len(played(source, clock, until_s=0.5)) == 15
    clock.ns = START_NS + 1_000_000_000
    items = played(source, clock)
    np.testing.assert_allclose(stamps_s(items), np.arange(30, 60) / 30, atol=1e-8)


def test_jitter_delays_and_never_reorders(session_path):
    options = PlaybackOptions(delay_s=0.02, jitter_ms=50.0, seed=3)
    sources, clock = sources_of(session_path, options)
    items = played(sources["camera 'cam0'"], clock)
    arrivals = np.array([when for _, when in items])
    late = arrivals - stamps_s(items)
    assert late.min() >= 0.02 and late.max() <= 0.07 and np.ptp(late) > 0.03
    assert np.all(np.diff(arrivals) >= 0) and len(items) == 60


def test_stalled_camera_is_silent_for_a_while(session_path):
    stall = Stall(source="cam0", start_s=5.5, length_s=0.5)  # the run's clock shows 5 s at first
    sources, clock = sources_of(session_path, PlaybackOptions(stalls=(stall,)))
    stamps = stamps_s(played(sources["camera 'cam0'"], clock))
    assert not np.any((stamps > 0.5) & (stamps < 0.999)) and len(stamps) == 45
    clock.ns = START_NS
    assert len(played(sources["camera 'cam1'"], clock)) == 60


def test_lost_samples_are_about_the_share_asked_for_and_the_same_again(session_path):
    add_sensors(session_path)
    runs = []
    for _ in range(2):
        sources, clock = sources_of(session_path, PlaybackOptions(loss=0.25, seed=1))
        runs.append(stamps_s(played(sources["imus of 'anna'"], clock)))
    np.testing.assert_array_equal(runs[0], runs[1])
    assert 45 <= len(runs[0]) <= 72


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (PlaybackOptions(stalls=(Stall(source="cam9", start_s=0, length_s=1),)), "cam9"),
        (PlaybackOptions(loss=2), "expected a share"),
        (PlaybackOptions(jitter_ms=-1), "zero or more"),
        (PlaybackOptions(image_rate_hz=0), "above zero"),
    ],
)
def test_impossible_options_are_refused(session_path, options, message):
    with pytest.raises(InputError, match=message):
        sources_of(session_path, options)


def test_live_camera_cannot_be_played_back(session_path):
    edit(session_path, 'keypoints = "keypoints/cam2"', 'live = "webcam:0"')
    with pytest.raises(SessionError, match="'cam2' is live only"):
        sources_of(session_path)


@pytest.fixture
def video_session(tmp_path) -> Path:
    """One camera, 20 numbered pictures at 30 Hz."""
    write_video(tmp_path / "left.mp4", 20)
    rig = ring(1)
    (tmp_path / "calibration.toml").write_text(calibration_toml(rig))
    path = tmp_path / "session.toml"
    path.write_text(
        '[session]\nname = "video"\ncalibration = "calibration.toml"\n'
        '\n[[camera]]\nname = "cam0"\nvideo = "left.mp4"\n'
    )
    return path


@pytest.mark.parametrize("in_memory", [False, True])
def test_pictures_come_at_their_time(video_session, in_memory):
    options = PlaybackOptions(in_memory=in_memory, loop=True)
    sources, clock = sources_of(video_session, options)
    items = played(sources["camera 'cam0'"], clock, until_s=0.99)
    assert [number_of(image(item)) for item, _ in items] == [*range(20), *range(10)]
    np.testing.assert_allclose(stamps_s(items), np.arange(30) / 30, atol=1e-7)


@pytest.mark.parametrize("in_memory", [False, True])
def test_pictures_beyond_the_wanted_rate_are_left_out(video_session, in_memory):
    options = PlaybackOptions(in_memory=in_memory, image_rate_hz=15.0)
    sources, clock = sources_of(video_session, options)
    items = played(sources["camera 'cam0'"], clock)
    assert [number_of(image(item)) for item, _ in items] == list(range(0, 20, 2))
    assert sources["camera 'cam0'"].counts.dropped == 0


def test_pictures_that_cannot_keep_up_are_skipped_and_counted(video_session):
    sources, clock = sources_of(video_session)
    source = sources["camera 'cam0'"]

    def hold_up() -> None:
        if source.counts.received == 3:
            clock.ns += 300_000_000

    items = played(source, clock, meanwhile=hold_up)
    shown = [number_of(image(item)) for item, _ in items]
    assert shown[:4] == [0, 1, 2, 8] and shown[-1] == 19
    assert source.counts.dropped == 20 - len(shown) and "decoded" in source.counts.note


def test_pictures_are_played_backwards_from_memory_only(video_session):
    options = PlaybackOptions(there_and_back=True, in_memory=True)
    sources, clock = sources_of(video_session, options)
    items = played(sources["camera 'cam0'"], clock, until_s=1.19)
    assert [number_of(image(i)) for i, _ in items] == [*range(20), *range(19, 3, -1)]
    with pytest.raises(InputError, match="backwards only from memory"):
        sources_of(video_session, PlaybackOptions(there_and_back=True))


class Ticking:
    """A source with a sample of one sensor every 0.1 s, numbered by their first acceleration."""

    name = "ticking"

    def __init__(self, clock: Clock) -> None:
        self.counts = SourceCounts()
        self._clock = clock

    def run(self, deliver: Callable[[Delivery], None], stopping: threading.Event) -> None:
        while not stopping.wait(0.1):
            deliver(
                ImuSample(
                    subject="anna",
                    bone="head",
                    timestamp_ns=self._clock.ns,
                    orientation_wxyz=np.array([1.0, 0.0, 0.0, 0.0]),
                    accel_m_s2=np.array([round((self._clock.ns - START_NS) / 1e8), 0.0, 0.0]),
                )
            )


def faulty(kind: FaultKind, **fault: float | str) -> tuple[FaultySource, Clock]:
    """With a fault from 1.05 to 2.05 s after the start."""
    clock = Clock()
    where = {"start_s": 6.05, "length_s": 1.0} | fault
    return FaultySource(Ticking(clock), [Fault(kind=kind, **where)], clock, seed=2), clock  # type: ignore[arg-type]


def numbers(items: Sequence[tuple[Delivery, float]]) -> list[int]:
    return [int(item.accel_m_s2[0]) for item, _ in items if isinstance(item, ImuSample)]


def test_death_ends_the_source_and_lets_it_come_back():
    source, clock = faulty(FaultKind.DEATH, where="ticking")
    seen: list[Delivery] = []
    for _ in range(2):
        with pytest.raises(SourceLost, match="ticking"):
            source.run(seen.append, Stopping(clock))
    assert len(seen) == 10
    clock.ns = START_NS + 2_500_000_000
    assert numbers(played(source, clock, until_s=3.0)) == [26, 27, 28, 29]


def test_doubled_samples_come_twice_and_lost_ones_never():
    source, clock = faulty(FaultKind.DOUBLE)
    doubled = numbers(played(source, clock, until_s=3.05))
    assert doubled == sorted([*range(1, 31), *range(11, 21)])
    source, clock = faulty(FaultKind.LOSS, amount=0.5)
    lost = set(range(1, 31)) - set(numbers(played(source, clock, until_s=3.05)))
    assert 2 <= len(lost) <= 8 and lost <= set(range(11, 21))


def test_disordered_samples_come_all_but_not_in_order():
    source, clock = faulty(FaultKind.DISORDER, amount=0.5)
    order = numbers(played(source, clock, until_s=3.05))
    assert sorted(order) == list(range(1, 31)) and order != sorted(order)
    assert order[:10] == list(range(1, 11)) and order[21:] == list(range(22, 31))


@pytest.mark.parametrize("jump_s", [3.0, -2.0])
def test_jumped_clock_is_off_for_a_while(jump_s):
    source, clock = faulty(FaultKind.CLOCK_JUMP, amount=jump_s, where="anna/head")
    items = played(source, clock, until_s=3.05)
    off_s = stamps_s(items) - 0.1 * np.arange(1, 31)
    np.testing.assert_allclose(off_s[10:20], jump_s)
    np.testing.assert_allclose(np.delete(off_s, range(10, 20)), 0.0, atol=1e-9)


def test_other_sensors_are_not_touched():
    source, clock = faulty(FaultKind.STALL, where="anna/hips")
    assert len(played(source, clock, until_s=3.05)) == 30


def test_values_can_be_not_a_number():
    source, clock = faulty(FaultKind.NOT_A_NUMBER)
    broken = [
        np.isnan(item.orientation_wxyz).all()
        for item, _ in played(source, clock, until_s=3.05)
        if isinstance(item, ImuSample)
    ]
    assert np.flatnonzero(broken).tolist() == list(range(10, 20))


class Blind:
    """A detector that finds nobody."""

    landmarks = LANDMARK_SETS["coco17"]
    identity = "blind"

    def detect(
        self, images: Sequence[np.ndarray | None], predicted: Sequence[np.ndarray]
    ) -> tuple[np.ndarray, ...]:
        return tuple(np.empty((0, 17, 3)) for _ in images)

    def reset(self) -> None:
        pass


def test_detector_raises_or_is_slow_for_a_while():
    clock, slept = Clock(), list[float]()
    faults = [
        Fault(kind=FaultKind.RAISE, start_s=6.0, length_s=1.0),
        Fault(kind=FaultKind.SLOW, start_s=8.0, length_s=1.0, amount=0.3),
    ]
    detector = FaultyDetector(Blind(), faults, clock, sleep=slept.append)
    assert len(detector.detect([None], [])) == 1
    clock.ns = 6_500_000_000
    with pytest.raises(RuntimeError, match="network failed"):
        detector.detect([None], [])
    clock.ns = 8_500_000_000
    assert len(detector.detect([None], [])) == 1 and slept == [0.3]
