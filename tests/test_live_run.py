"""The runtime of a live run: what reaches the engine, what does not wait, what may fail."""

from __future__ import annotations

import os
import threading
import time
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fusecap.errors import InputError, SessionError
from fusecap.live.devices.source import SessionClock, SourceLost
from fusecap.live.health import Incidents, Input, Meter
from fusecap.live.inbox import Inbox
from fusecap.live.latency import Arrivals, Histogram, LatencyBook
from fusecap.live.recorder import RecordSwitch
from fusecap.live.run import SOONEST_NS, LiveOptions, LiveRun
from fusecap.live.status import Light
from fusecap.recording.reader import Recording
from fusecap.streams.output import StreamStatus
from fusecap.types import CameraSample, Command, CommandKind, ImuSample, Tick
from live_fakes import (
    FakeDetector,
    FakeEngine,
    FakeSource,
    Notes,
    camera_sample,
    image,
    imu_sample,
    live_setup,
    steady,
    wait_for,
)
from scenes import ring

FAST = LiveOptions(delay_s=0.02, eager=False)


class Going:
    """A run on a thread of its own, for the length of a `with`."""

    def __init__(self, run: LiveRun, seconds: float | None = None) -> None:
        self.run = run
        self.report = None
        self._seconds = seconds
        self._thread = threading.Thread(target=self._go)

    def _go(self) -> None:
        self.report = self.run.run(self._seconds)

    def __enter__(self) -> Going:
        self._thread.start()
        return self

    def __exit__(self, *exc: object) -> None:
        self.run.stop()
        self._thread.join(10)
        assert not self._thread.is_alive()


def make_run(sources=(), *, cameras=0, detector=None, engine=None, options=FAST, **given):
    return LiveRun(
        live_setup(ring(cameras)),
        sources,
        detector,
        options,
        engine=engine or FakeEngine(cameras),
        **given,
    )


# What reaches the engine


def test_every_sample_reaches_the_engine_in_the_order_of_arrival_and_listeners_hear_the_same():
    done = threading.Event()

    def script(deliver, stopping):
        for number in range(500):
            deliver(imu_sample(number))
        done.set()
        stopping.wait()

    engine, notes = FakeEngine(), Notes()
    run = make_run([FakeSource("imus", script)], engine=engine, listeners=[notes])
    with Going(run):
        assert done.wait(10)
        wait_for(lambda: sum(isinstance(e, ImuSample) for e in engine.taken) == 500)
        wait_for(lambda: len(engine.ticks) > 5)
    samples = [e.timestamp_ns for e in engine.taken if isinstance(e, ImuSample)]
    assert samples == list(range(500))
    assert [event for event, _ in notes.events] == engine.taken
    arrivals = [arrival_ns for event, arrival_ns in notes.events if isinstance(event, ImuSample)]
    assert arrivals == sorted(arrivals)
    assert [step.timestamp_ns for step in notes.steps] == engine.ticks
    assert notes.closed == 1


def test_instants_are_multiples_of_the_period_and_come_the_delay_after_it():
    solved_ns = []
    clock = SessionClock()

    def on_take(event):
        if isinstance(event, Tick):
            solved_ns.append(clock.now_ns())

    engine = FakeEngine(on_take=on_take)
    with Going(make_run(engine=engine, clock=clock)):
        wait_for(lambda: len(engine.ticks) > 20)
    ticks = np.array(engine.ticks)
    assert np.allclose(ticks * 60e-9 % 1.0, np.round(ticks * 60e-9 % 1.0), atol=1e-6)
    assert np.all(np.diff(ticks) > 0)
    assert np.all(np.array(solved_ns) - ticks >= 20_000_000), "never before its delay is over"


def test_eager_solves_as_soon_as_the_samples_are_there():
    clock = SessionClock()
    source = FakeSource("imus", steady(clock, imu_sample, 200.0))
    engine = FakeEngine()
    options = LiveOptions(delay_s=30.0, eager=True)
    with Going(make_run([source], engine=engine, options=options, clock=clock)):
        wait_for(lambda: len(engine.ticks) > 10)
    assert clock.now_ns() < 30e9


def test_without_anything_fresh_eager_waits_for_the_delay():
    engine, clock = FakeEngine(), SessionClock()
    options = LiveOptions(delay_s=0.05, eager=True)
    with Going(make_run(engine=engine, options=options, clock=clock)):
        wait_for(lambda: len(engine.ticks) > 3)
        assert clock.now_ns() - engine.ticks[-1] >= 50_000_000


def test_poses_ahead_leave_at_once_and_pictures_are_solved_when_their_delay_is_over():
    engine, clock = FakeEngine(), SessionClock()
    setup = live_setup(ring(0))
    live = setup.session.live.model_copy(update={"poses": "ahead"})
    setup = replace(setup, session=setup.session.model_copy(update={"live": live}))
    source = FakeSource("imus", steady(clock, imu_sample, 200.0))
    taken_ns = []
    engine = FakeEngine(on_take=lambda event: taken_ns.append((clock.now_ns(), event)))
    options = LiveOptions(delay_s=0.1, eager=False)
    run = LiveRun(setup, [source], None, options, engine=engine, clock=clock)
    with Going(run):
        wait_for(lambda: len(engine.ticks) > 30)
    ticks = [(ns, event) for ns, event in taken_ns if isinstance(event, Tick)]
    seen = [(ns - tick.timestamp_ns, tick.timestamp_ns) for ns, tick in ticks if not tick.ahead]
    ahead = [(ns - tick.timestamp_ns, tick.timestamp_ns) for ns, tick in ticks if tick.ahead]
    assert len(seen) > 3 and len(ahead) > 10
    assert all(late_ns >= 100_000_000 for late_ns, _ in seen)
    assert np.median([late_ns for late_ns, _ in ahead]) < 50_000_000
    for some in (seen, ahead):
        times = [timestamp_ns for _, timestamp_ns in some]
        assert times == sorted(set(times))


def test_poses_ahead_of_pictures_that_are_too_late_are_refused():
    setup = live_setup(ring(0))
    live = setup.session.live.model_copy(update={"poses": "ahead"})
    setup = replace(setup, session=setup.session.model_copy(update={"live": live}))
    with pytest.raises(SessionError, match=r"0\.3 s beyond pictures"):
        LiveRun(setup, [], None, LiveOptions(delay_s=0.4), engine=FakeEngine())


def test_commands_stand_in_their_place_among_the_samples():
    engine = FakeEngine()
    run = make_run(engine=engine)
    command = Command(kind=CommandKind.REINITIALISE)
    with Going(run):
        wait_for(lambda: engine.ticks)
        run.submit(command)
        wait_for(lambda: command in engine.taken)
        after = len(engine.ticks)
        wait_for(lambda: len(engine.ticks) > after)


def test_delay_and_eagerness_follow_the_session_and_whether_a_detector_is_in_the_loop():
    detector = FakeDetector(lambda images: None)
    with_detector = make_run(cameras=1, detector=detector, options=None)
    assert (with_detector.delay_s, with_detector.eager) == (0.2, False)
    without = make_run(options=None)
    assert (without.delay_s, without.eager) == (0.05, True)


# Images


def test_the_newest_image_wins():
    seen, free, looking = [], threading.Event(), threading.Event()
    shown = [image(number) for number in range(20)]

    def on_detect(images):
        seen.append(images[0])
        looking.set()
        assert free.wait(10)

    def script(deliver, stopping):
        deliver(shown[0])
        assert looking.wait(10)
        for one in shown[1:]:
            deliver(one)
        free.set()
        stopping.wait()

    engine, notes = FakeEngine(1), Notes()
    run = make_run(
        [FakeSource("camera 'cam0'", script)],
        cameras=1,
        detector=FakeDetector(on_detect),
        engine=engine,
        listeners=[notes],
    )
    with Going(run) as going:
        wait_for(lambda: sum(isinstance(e, CameraSample) for e in engine.taken) == 2)
    assert seen[0] is shown[0].image
    assert seen[1] is shown[19].image
    assert [one.timestamp_ns for one in notes.images] == [0, 19]
    stamps = [e.timestamp_ns for e in engine.taken if isinstance(e, CameraSample)]
    assert stamps == [0, 19], "detections carry the time of the exposure"
    assert going.report is not None
    assert going.report.inputs[0].dropped == 18
    assert going.report.detections == 2


def test_images_that_come_together_go_to_the_detector_together():
    batches = []

    def script(deliver, stopping):
        stopping.wait(0.1)
        for camera in range(3):
            deliver(image(5, camera))
        stopping.wait()

    detector = FakeDetector(lambda images: batches.append([i is not None for i in images]))
    run = make_run([FakeSource("cameras", script)], cameras=3, detector=detector)
    with Going(run):
        wait_for(lambda: batches)
    assert batches[0] == [True, True, True]


def test_a_slow_detector_does_not_slow_the_solver():
    clock, stuck = SessionClock(), threading.Event()
    engine = FakeEngine(1)
    run = make_run(
        [FakeSource("camera 'cam0'", steady(clock, image))],
        cameras=1,
        detector=FakeDetector(lambda images: stuck.wait(20)),
        engine=engine,
        clock=clock,
    )
    try:
        with Going(run):
            wait_for(lambda: len(engine.ticks) > 60)
            stuck.set()
    finally:
        stuck.set()


def test_a_detector_that_raises_is_started_anew():
    clock, rounds = SessionClock(), []

    def on_detect(images):
        rounds.append(images)
        if len(rounds) < 3:
            raise ValueError("broken image")

    detector, engine = FakeDetector(on_detect), FakeEngine(1)
    run = make_run(
        [FakeSource("camera 'cam0'", steady(clock, image))],
        cameras=1,
        detector=detector,
        engine=engine,
        clock=clock,
    )
    with Going(run) as going:
        wait_for(lambda: any(isinstance(e, CameraSample) for e in engine.taken))
    assert detector.resets == 2
    assert going.report is not None
    assert going.report.detector_failures == 2
    assert [i.what for i in going.report.incidents] == [
        "the detector failed (1 times so far): ValueError: broken image"
    ]


# What may fail


@pytest.mark.parametrize("error", [SourceLost("cable pulled"), RuntimeError("driver bug")])
def test_a_source_that_dies_is_opened_again(error):
    source: FakeSource

    def script(deliver, stopping):
        deliver(imu_sample(source.opened))
        if source.opened == 1:
            raise error
        stopping.wait()

    source = FakeSource("imus", script)
    engine = FakeEngine()
    with Going(make_run([source], engine=engine)) as going:
        wait_for(lambda: sum(isinstance(e, ImuSample) for e in engine.taken) == 2)
    assert going.report is not None
    assert going.report.sources[0].restarts == 1
    first, second = [incident.what for incident in going.report.incidents]
    assert first.startswith("imus failed: ") and str(error) in first
    assert second == "imus is back"


def test_a_source_that_cannot_be_opened_is_one_incident():
    def script(deliver, stopping):
        raise SourceLost("no such device")

    source = FakeSource("camera 'cam0'", script)
    with Going(make_run([source], cameras=1)) as going:
        wait_for(lambda: source.opened > 1)
    assert going.report is not None
    assert len(going.report.incidents) == 1
    assert going.report.sources[0].note == "no such device"


def test_a_broken_listener_is_left_out_and_the_run_goes_on():
    class Broken(Notes):
        def on_step(self, step, now_ns):
            raise ValueError("oops")

    broken, notes, engine = Broken(), Notes(), FakeEngine()
    with Going(make_run(engine=engine, listeners=[broken, notes])) as going:
        wait_for(lambda: len(notes.steps) > 10 and broken.closed)
    assert going.report is not None
    assert [i.what for i in going.report.incidents] == [
        "Broken failed and is left out: ValueError: oops"
    ]
    assert broken.closed == notes.closed == 1


def test_an_event_that_the_engine_raises_on_is_an_incident():
    def on_take(event):
        if isinstance(event, ImuSample):
            raise KeyError("bone")

    def script(deliver, stopping):
        deliver(imu_sample(1))
        deliver(imu_sample(2))
        stopping.wait()

    engine = FakeEngine(on_take=on_take)
    with Going(make_run([FakeSource("imus", script)], engine=engine)) as going:
        wait_for(lambda: len(engine.ticks) > 5)
    assert going.report is not None
    assert len(going.report.incidents) == 1
    assert "internal error: KeyError" in going.report.incidents[0].what


def test_what_the_session_does_not_have_is_refused():
    def script(deliver, stopping):
        deliver(imu_sample(1, bone="left_hand"))
        deliver(camera_sample(1, camera=7))
        deliver(image(1))
        stopping.wait()

    engine, run = FakeEngine(1), None
    run = make_run([FakeSource("odd", script)], cameras=1, engine=engine)
    with Going(run) as going:
        wait_for(lambda: len(engine.ticks) > 3)
    assert going.report is not None
    assert going.report.incident_count == 3
    assert all(isinstance(event, Tick) for event in engine.taken)


def test_what_was_measured_after_it_came_is_left_out_and_told():
    clock, engine = SessionClock(), FakeEngine()

    def script(deliver, stopping):
        for _ in range(5):
            deliver(imu_sample(clock.now_ns() + 2 * SOONEST_NS))
        deliver(imu_sample(clock.now_ns()))
        stopping.wait()

    source = FakeSource("imus", script)
    with Going(make_run([source], engine=engine, clock=clock)) as going:
        wait_for(lambda: any(isinstance(event, ImuSample) for event in engine.taken))
    assert sum(isinstance(event, ImuSample) for event in engine.taken) == 1
    assert source.counts.dropped == 5
    assert going.report is not None
    assert [i.what for i in going.report.incidents if "future" in i.what] == [
        "imus: samples from the future are left out; see its clock and offset_s"
    ]


def test_a_solver_that_falls_behind_leaves_instants_out():
    def on_take(event):
        if isinstance(event, Tick):
            time.sleep(0.1)

    engine, clock = FakeEngine(on_take=on_take), SessionClock()
    with Going(make_run(engine=engine, clock=clock)) as going:
        wait_for(lambda: len(engine.ticks) > 10)
        assert clock.now_ns() - engine.ticks[-1] < 1e9
    assert going.report is not None
    assert going.report.skipped > 10
    assert going.report.late_share > 0.5


# The end


def test_a_run_ends_when_every_source_has_ended_and_its_last_instants_are_solved():
    clock = SessionClock()

    def script(deliver, stopping):
        for _ in range(10):
            stopping.wait(0.01)
            deliver(imu_sample(clock.now_ns()))

    engine = FakeEngine()
    with Going(make_run([FakeSource("imus", script)], engine=engine, clock=clock)) as going:
        wait_for(lambda: going.report is not None)
    last = max(e.timestamp_ns for e in engine.taken if isinstance(e, ImuSample))
    assert engine.ticks[-1] >= last


def test_stop_ends_all_threads():
    before = set(threading.enumerate())
    clock = SessionClock()
    run = make_run(
        [
            FakeSource("camera 'cam0'", steady(clock, image)),
            FakeSource("imus", lambda deliver, stopping: stopping.wait()),
        ],
        cameras=1,
        detector=FakeDetector(lambda images: None),
        clock=clock,
        options=LiveOptions(delay_s=5.0),
    )
    with Going(run) as going:
        wait_for(lambda: run.status().elapsed_s >= 0)
        start_s = time.monotonic()
        run.stop()
        wait_for(lambda: going.report is not None)
        assert time.monotonic() - start_s < 2.0
    assert going.report is not None and going.report.threads_left == ()
    assert set(threading.enumerate()) <= before


def test_a_source_that_does_not_end_is_named_and_not_waited_for():
    free = threading.Event()

    def script(deliver, stopping):
        free.wait(30)

    with Going(make_run([FakeSource("stubborn", script)]), seconds=0.1) as going:
        wait_for(lambda: going.report is not None)
    free.set()
    assert going.report is not None and going.report.threads_left == ("stubborn",)


@pytest.mark.slow
def test_runs_leave_neither_threads_nor_files_behind():
    def once():
        clock = SessionClock()
        sources = [FakeSource("imus", steady(clock, imu_sample, 500.0))]
        make_run(sources, clock=clock).run(0.05)

    def open_files() -> int:
        return len(os.listdir("/proc/self/fd")) if os.path.isdir("/proc/self/fd") else 0

    once()
    threads, files = threading.active_count(), open_files()
    for _ in range(20):
        once()
    assert threading.active_count() == threads
    assert open_files() == files


def test_listeners_come_and_go():
    engine, notes = FakeEngine(), Notes()
    run = make_run(engine=engine)
    with Going(run):
        wait_for(lambda: len(engine.ticks) > 3)
        run.add_listener(notes)
        wait_for(lambda: len(notes.steps) > 3)
        run.remove_listener(notes)
        heard = len(notes.steps)
        assert notes.closed == 1
        after = len(engine.ticks)
        wait_for(lambda: len(engine.ticks) > after + 3)
    assert len(notes.steps) <= heard + 1
    assert notes.closed == 1


def test_recordings_begin_and_end_in_mid_run(tmp_path):
    engine, paths = FakeEngine(), iter([tmp_path / "first.mcap", tmp_path / "second.mcap"])
    run = make_run(engine=engine)
    switch = RecordSwitch(run, lambda: next(paths), images=False)
    switch.begin()
    with Going(run) as going:
        wait_for(lambda: len(engine.ticks) > 3)
        wait_for(lambda: run.status().recording is not None)
        switch.turn(False)
        switch.turn(True)
        after = len(engine.ticks)
        wait_for(lambda: len(engine.ticks) > after + 3)
    first, second = (Recording(tmp_path / f"{name}.mcap") for name in ("first", "second"))
    assert first.from_start and not second.from_start
    assert list(first.items()) and list(second.items())
    assert first.loss.finished and second.loss.finished
    assert going.report is not None
    assert [r.path for r in going.report.recordings] == [str(first.path), str(second.path)]
    assert not any(recording.problem for recording in going.report.recordings)


def test_recordings_of_one_name_get_numbers(tmp_path):
    runs = [make_run(engine=FakeEngine()) for _ in range(3)]
    switches = [RecordSwitch(run, lambda: tmp_path / "a.mcap", images=False) for run in runs]
    paths = [switch.begin() for switch in switches]
    for run in runs:
        run.close()
    assert [path.name for path in paths] == ["a.mcap", "a-2.mcap", "a-3.mcap"]
    with pytest.raises(InputError, match="exists; choose another name"):
        switches[0].begin(paths[0])


def test_status_comes_once_a_second_and_the_report_is_plain():
    clock, notes = SessionClock(), Notes()
    run = make_run(
        [FakeSource("imus", steady(clock, imu_sample))],
        cameras=1,
        clock=clock,
        listeners=[notes],
    )
    with Going(run) as going:
        wait_for(lambda: len(notes.statuses) >= 2)
    camera, sensor = notes.statuses[-1].sources
    assert camera.light is Light.WAITING and sensor.light is Light.FRESH
    assert sensor.rate_hz > 10
    assert notes.statuses[-1].solves_per_s > 10
    assert {stage.stage for stage in notes.statuses[-1].latency} >= {"solve", "exposure to pose"}
    assert going.report is not None
    plain = going.report.as_json()
    assert plain["inputs"][0]["light"] == "waiting"
    assert plain["inputs"][0]["age_s"] is None
    assert plain["subjects"]["anna"]["tracked_share"] == 1.0


def test_packets_are_counted_per_person_and_second_over_the_mean_of_the_streams():
    class Sender(Notes):
        @property
        def poses(self) -> float:
            return len(self.steps)

        def stream_statuses(self) -> tuple[StreamStatus, ...]:
            return (StreamStatus(to="lsl", sent=0, dropped=0, refused=0, failed=0, remark=""),)

    sender = Sender()
    run = make_run(listeners=[sender])
    with Going(run) as going:
        wait_for(lambda: len(sender.statuses) >= 2)
    status = sender.statuses[1]
    assert [stream.to for stream in status.streams] == ["lsl"]
    assert going.report is not None
    for seen in (status, going.report):
        assert seen.packets_per_s == pytest.approx(seen.solves_per_s, rel=0.5)
        assert seen.packets_per_s > 5


# Parts


def test_a_full_inbox_drops_the_oldest_sensor_sample():
    inbox = Inbox(SessionClock(), capacity=4)
    for item in (camera_sample(0), imu_sample(1), imu_sample(2), camera_sample(3), imu_sample(4)):
        inbox.put(item)
    left = [item.timestamp_ns for item, _ in inbox.take_all() if not isinstance(item, Command)]
    assert left == [0, 2, 3, 4]
    assert inbox.dropped == 1


def test_a_full_inbox_without_sensor_samples_drops_the_oldest():
    inbox = Inbox(SessionClock(), capacity=2)
    for number in range(4):
        inbox.put(camera_sample(number))
    left = [item.timestamp_ns for item, _ in inbox.take_all() if not isinstance(item, Command)]
    assert left == [2, 3]
    assert inbox.dropped == 2


@given(st.lists(st.floats(1e-5, 99.0), min_size=1, max_size=200), st.floats(0.01, 1.0))
def test_quantiles_are_within_three_percent(durations, share):
    histogram = Histogram()
    for seconds in durations:
        histogram.add(seconds)
    exact = np.quantile(durations, share, method="inverted_cdf")
    assert histogram.quantile_s(share) == pytest.approx(exact, rel=0.031)


def test_a_window_forgets_and_the_total_does_not():
    book = LatencyBook()
    book.add("solve", 1_000_000)
    book.roll()
    book.add("solve", 3_000_000)
    assert book.window()[0].count == 2
    book.roll()
    assert book.window()[0].count == 1
    assert book.window()[0].p50_ms == pytest.approx(3.0, rel=0.03)
    assert book.total()[0].count == 2


def test_the_time_from_the_last_sample_is_that_of_the_last_one_the_instant_needs():
    arrivals = Arrivals()
    for timestamp_ns, arrival_ns in ((0, 1), (10, 11), (20, 21)):
        arrivals.note(camera_sample(timestamp_ns), arrival_ns)
    arrivals.note(imu_sample(12), 14)
    assert arrivals.instant(8) == (14, {0})
    arrivals.note(imu_sample(16), 18)
    assert arrivals.instant(15) == (21, {0})
    assert arrivals.instant(25) == (None, set()), "it has waited in vain"


def test_incidents_keep_the_first_and_the_last():
    incidents = Incidents(SessionClock(), kept=4)
    for number in range(10):
        incidents.add(str(number))
    assert [incident.what for incident in incidents.all()] == ["0", "1", "8", "9"]
    assert incidents.count == 10


def test_lights():
    second = 1_000_000_000
    one = Input("left", "camera")
    assert one.light(0) is Light.WAITING and one.change(0) == ""
    for number in range(120):
        one.arrived(number * second // 60)
    now = 119 * second // 60
    assert one.light(now + second // 20) is Light.FRESH
    assert one.light(now + second // 5) is Light.LATE
    assert one.change(now + 2 * second) == "nothing for 1 s"
    assert one.change(now + 3 * second) == ""
    one.arrived(now + 3 * second)
    assert one.change(now + 3 * second) == "back"
    one.gone = True
    assert one.light(now + 3 * second) is Light.LOST


def test_a_meter_counts_whole_seconds():
    second, meter = 1_000_000_000, Meter()
    for number in range(300):
        meter.add(number * second // 60)
    assert meter.rate_hz(5 * second) == pytest.approx(60, abs=0.5)
    assert meter.rate_hz(30 * second) == 0.0
    assert meter.total == 300


def test_poses_that_are_held_are_sent_and_not_measured_and_every_replaced_one_counts():
    class Holding(FakeEngine):
        def take(self, event):
            step = super().take(event)
            if step is None:
                return None
            held = {name: replace(one, measured=False) for name, one in step.people.items()}
            # Several steps may show one solve.
            shown = replace(step.step, found_anew={"anna": 0})
            once = {"anna": 2} if len(self.ticks) == 1 else {}
            return replace(step, people=held, step=shown, found_anew=once)

    engine = Holding()
    with Going(make_run(engine=engine)) as going:
        wait_for(lambda: len(engine.ticks) > 5)
    assert going.report is not None
    told = going.report.subjects["anna"]
    assert told.tracked_share > 0.9
    assert told.measured_share == 0.0 and told.found_anew == 2
