"""A recorded run once more: the same poses, and better ones."""

from __future__ import annotations

import json
from collections import deque
from dataclasses import replace
from itertools import count
from operator import attrgetter
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from typer.testing import CliRunner

from fusecap.batch.replay import (
    RecordedMotion,
    Replay,
    opened_take,
    recorded_setup,
    replay,
    solve_as_live,
)
from fusecap.batch.second_solve import solve_recording
from fusecap.batch.solve import solve_session
from fusecap.batch.stored_instants import StoredInstants
from fusecap.body.landmarks import LANDMARK_SETS
from fusecap.cli import app, view
from fusecap.doctor import diagnose_recording
from fusecap.engine.cameras import Cameras
from fusecap.engine.engine import Engine
from fusecap.engine.sensors import Sensors
from fusecap.errors import InputError
from fusecap.geometry.camera import Rig
from fusecap.recording import layout
from fusecap.recording.index import RecordingIndex
from fusecap.recording.reader import Loss, RecordedEvent, Recording
from fusecap.setup import SessionSetup
from fusecap.sources.session import Session
from fusecap.sources.session_data import open_session
from fusecap.sources.session_file import load_session
from fusecap.stored_take import load_take
from fusecap.take import Take, save_take
from fusecap.types import GRAVITY_M_S2, CameraSample, Command, CommandKind, ImuSample, Tick
from fusecap.viewer import page as viewer_page
from fusecap.viewer import recording as viewer_recording
from fusecap.viewer import take as viewer_take
from fusecap.viewer.recording import RecordedDetections, look_for_damage
from live_events import same_bits
from recorded_run import record, simulated_run


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    return tmp_path_factory.mktemp("run")


@pytest.fixture(scope="module")
def run(folder):
    return simulated_run(folder / "session")


@pytest.fixture(scope="module")
def recorded(run, folder) -> Path:
    path = folder / "run.mcap"
    with path.open("wb") as file:
        record(file, *run)
    return path


def written(path: Path, setup, taken, **options) -> Recording:
    with path.open("wb") as file:
        record(file, setup, taken, **options)
    return Recording(path)


def test_replay_gives_the_very_steps_of_the_run(run, recorded):
    again = list(replay(Recording(recorded)))
    steps = [step for _, step in run[1] if step is not None]
    assert len(again) == len(steps) > 50
    assert all(same_bits(a, b) for a, b in zip(steps, again, strict=True))


def test_replay_counts_poses_equal_to_those_recorded(run, recorded):
    solved, again = solve_as_live(Recording(recorded))
    sent = sum(
        person is not None
        for _, step in run[1]
        if step is not None
        for person in step.people.values()
    )
    assert again.equal == again.poses == sent
    assert f"{sent} of {sent} poses are equal" in solved.report.notes[-1]
    assert solved.take.provenance["simulated"] and solved.take.provenance["options"]["as_live"]


def test_replay_notices_what_differs(run, tmp_path):
    """A log without half of its sensor samples is replayed to other poses, and says so."""
    setup, taken = run
    fewer = [
        (event, step)
        for index, (event, step) in enumerate(taken)
        if not (isinstance(event, ImuSample) and index % 2)
    ]
    again = Replay(written(tmp_path / "fewer.mcap", setup, fewer))
    list(again.steps())
    assert again.equal < again.poses


def taken_from(path: Path) -> Take:
    told = []
    with opened_take(path, told.append) as take:
        assert not told
        return take.of_frames(0, len(take.timestamps_ns))


def test_the_take_of_a_recording_holds_the_recorded_poses(run, recorded):
    take = taken_from(recorded)
    live, _ = solve_as_live(Recording(recorded))
    first = int(np.argmax(live.take.tracked.any(axis=0)))
    assert take.subject_names[:2] == live.take.subject_names[:2]
    assert np.array_equal(take.timestamps_ns, live.take.timestamps_ns[first:])
    sent = live.take.theta[:, first:].astype(np.float32)
    assert np.array_equal(take.theta, sent, equal_nan=True)


def test_single_instants_of_a_recording_are_those_of_the_whole(recorded):
    recording = Recording(recorded)
    index = RecordingIndex(recording, keypoints_hz=10.0)
    motion, take = RecordedMotion(recording, index), taken_from(recorded)
    frames = [3, 10, 11, 40]
    some, same = motion.at_frames(frames), take.at_frames(frames)
    for name in ("timestamps_ns", "tracked", "theta", "bone_sigma_deg"):
        np.testing.assert_allclose(getattr(some, name), getattr(same, name), rtol=1e-3)
    np.testing.assert_array_equal(motion.time_s, take.time_s)
    samples = [item.event for item in recording.items() if isinstance(item, RecordedEvent)]
    seen = [s for s in samples if isinstance(s, CameraSample) and s.camera == 1]
    detections = RecordedDetections(index, recorded_setup(recording))
    found = detections.at(1, seen[0].timestamp_ns)
    np.testing.assert_array_equal(found, seen[0].people)
    assert detections.at(1, seen[0].timestamp_ns - 1) is None
    assert detections.at(1, seen[-1].timestamp_ns + 10**9) is None


def as_the_run_does(setup, samples, times_ns):
    """Detections and readings, all samples in memory."""
    session = setup.session
    rates_hz = [session.camera_rate_hz(camera) for camera in session.cameras]
    cameras = Cameras(rates_hz, len(setup.landmarks.landmark_names))
    sensors = Sensors(session.subjects)
    coming = deque(sorted(samples, key=attrgetter("timestamp_ns")))
    for now_ns in times_ns:
        while coming and coming[0].timestamp_ns <= now_ns + 1_000_000_000:
            sample = coming.popleft()
            (cameras if isinstance(sample, CameraSample) else sensors).take(sample)
        yield cameras.detections(now_ns), sensors.readings(now_ns)


@pytest.mark.parametrize("without", ["nothing", "a camera for a while", "order", "broken samples"])
def test_instants_of_a_recording_are_those_of_all_samples_in_memory(
    run, tmp_path, monkeypatch, without
):
    setup, taken = run
    if without == "a camera for a while":
        off = [
            isinstance(event, CameraSample) and event.camera == 1 and 3e8 < event.timestamp_ns < 9e8
            for event, _ in taken
        ]
        taken = [item for item, left_out in zip(taken, off, strict=True) if not left_out]
    if without == "order":
        taken = [taken[row] for row in np.random.default_rng(0).permutation(len(taken))]
    if without == "broken samples":
        for kind in ("imu_message", "keypoints_message"):
            whole, number = getattr(layout, kind), count()
            monkeypatch.setattr(
                layout, kind, lambda one, w=whole, n=number: "{}" if next(n) % 5 == 0 else w(one)
            )
    recording = written(tmp_path / "run.mcap", setup, taken)
    events = [item.event for item in recording.items() if isinstance(item, RecordedEvent)]
    assert (len(events) < 0.85 * len(taken)) == (without == "broken samples")
    samples = [event for event in events if isinstance(event, CameraSample | ImuSample)]
    stored = StoredInstants(recording)
    times_ns = sorted(event.timestamp_ns for event in events if isinstance(event, Tick))
    expected = list(as_the_run_does(setup, samples, times_ns))
    assert len(stored) == len(expected) > 50
    in_order = [*range(len(stored)), *range(5, 12)]
    anywhere = [*range(0, len(stored), 3), 40, 39, 38, 38, 5]
    for instant in [*in_order, *anywhere]:
        seen, worn = expected[instant]
        detections, readings = stored.detections(instant), stored.readings(instant)
        assert detections.timestamp_ns == seen.timestamp_ns and detections.looked == seen.looked
        for found, there in zip(detections.people, seen.people, strict=True):
            np.testing.assert_array_equal(found, there)
        assert readings.keys() == worn.keys()
        for name, reading in worn.items():
            for values in ("bone_rotation_in_world", "accel_in_world_m_s2"):
                np.testing.assert_array_equal(
                    getattr(readings[name], values), getattr(reading, values)
                )


def test_sources_that_were_silent_for_long_are_back_with_their_first_sample(run, tmp_path):
    """As for who asks for that instant alone."""
    setup, taken = run
    events = [event for event, _ in taken if not isinstance(event, Command)]
    late = [
        replace(
            event, timestamp_ns=event.timestamp_ns + 12_000_000_000 * (event.timestamp_ns > 5e8)
        )
        for event in events
    ]
    recording = written(tmp_path / "run.mcap", setup, [(event, None) for event in late])
    in_order, alone = StoredInstants(recording), StoredInstants(recording)
    back = 0
    for instant in range(len(in_order)):
        seen, worn = in_order.detections(instant), in_order.readings(instant)
        if not 12.4e9 < seen.timestamp_ns < 12.6e9:
            continue
        alone.detections(0), alone.readings(0)
        expected = alone.detections(instant)
        for found, there in zip(seen.people, expected.people, strict=True):
            np.testing.assert_array_equal(found, there)
        assert worn.keys() == alone.readings(instant).keys()
        back += len(worn) > 0 and any(len(people) for people in seen.people)
    assert back > 3


@pytest.fixture
def damaged(recorded, tmp_path) -> Path:
    """A byte of one chunk in the middle is another; what is told at the end is right."""
    index = RecordingIndex(Recording(recorded))
    places = index.poses["anna"]
    record_at, _ = places.at(len(places.times_ns) // 2)
    data = bytearray(recorded.read_bytes())
    data[record_at + 200] ^= 0xFF
    path = tmp_path / "damaged.mcap"
    path.write_bytes(data)
    return path


def test_damage_within_a_closed_recording_is_told_by_whoever_reads_it(damaged, capsys):
    told = []
    look_for_damage(damaged, told.append).join(60)
    assert len(told) == 1 and "damaged in 1 places" in told[0]
    assert any("is damaged" in note for note in solve_recording(Recording(damaged)).report.notes)
    for command in ("export", "angles", "edit", "report"):
        options = {"export": ["--format", "csv"], "edit": ["--trim", "0.1:"]}.get(command, [])
        result = CliRunner().invoke(app, [command, str(damaged), *options])
        assert result.exit_code == 0, result.output
        assert "is damaged" in result.output.replace("\n", " "), command


@pytest.mark.parametrize(
    ("loss", "words"),
    [
        ({"malformed": 2}, "damaged in 2 entries that do not follow the format; "),
        ({"broken_chunks": 1, "malformed": 2}, "people are missing and in 2 entries"),
    ],
)
def test_only_damage_that_is_there_is_told(recorded, monkeypatch, loss, words):
    def messages(recording):
        recording.loss = Loss(**loss)
        return iter(())

    monkeypatch.setattr(Recording, "messages", messages)
    told = []
    look_for_damage(recorded, told.append).join(60)
    assert len(told) == 1 and words in told[0]
    assert ("people are missing" in told[0]) == ("broken_chunks" in loss)


def test_a_recording_that_a_disk_no_longer_gives_is_told(recorded, monkeypatch):
    def messages(recording):
        raise OSError(5, "Input/output error")

    monkeypatch.setattr(Recording, "messages", messages)
    told = []
    look_for_damage(recorded, told.append).join(60)
    assert len(told) == 1 and told[0].startswith("run.mcap cannot be read to its end")


def test_a_page_that_was_closed_is_told_nothing(recorded, monkeypatch, capsys):
    class Shown:
        def __init__(self, *_, **__):
            self.tell = lambda text: None
            self.run = lambda: reader[0]("found early")

    reader = []
    monkeypatch.setattr(viewer_page, "Page", lambda *_, **__: SimpleNamespace(stop=lambda: None))
    monkeypatch.setattr(viewer_take, "TakePage", Shown)
    monkeypatch.setattr(viewer_recording, "look_for_damage", lambda _, tell: reader.append(tell))
    monkeypatch.setattr(view, "_announce", lambda *_, **__: None)
    view.look(taken_from(recorded), "x", rig=None, curves=(), unread=recorded)
    reader[0]("found late")
    said = capsys.readouterr().err
    assert "found early" in said and "found late" not in said


def test_a_whole_recording_is_told_to_be_nothing_else(recorded):
    told = []
    look_for_damage(recorded, told.append).join(60)
    assert told == []


def test_a_broken_message_is_counted_once_however_often_it_is_read(damaged):
    recording = Recording(damaged)
    index = RecordingIndex(recording)
    for _ in range(3):
        for places in index.poses.values():
            found = [index.read(places, row) for row in range(len(places.times_ns))]
            assert None in found and any(found)
    broken = sum(len(places.broken) for places in index.poses.values())
    assert recording.loss.malformed == broken


def test_second_solve_is_as_good_as_that_of_the_session(run, recorded, folder):
    """The same samples, whatever order they came in, give the session's poses within 2 mm."""
    again = solve_recording(Recording(recorded)).take
    offline = solve_session(open_session(load_session(folder / "session"))).take
    assert again.subject_names == offline.subject_names
    assert again.tracked.all() and offline.tracked.all()
    at = np.searchsorted(again.timestamps_ns, offline.timestamps_ns)
    apart_m = np.linalg.norm(
        again.bone_position_in_world_m[:, at] - offline.bone_position_in_world_m, axis=-1
    )
    assert apart_m.max() < 0.002


def test_second_solve_takes_samples_that_came_too_late_for_the_run(run, tmp_path):
    setup, taken = run
    ticks = [item for item in taken if isinstance(item[0], Tick)]
    samples = [item for item in taken if not isinstance(item[0], Tick)]
    recording = written(tmp_path / "late.mcap", setup, [*ticks, *samples])
    live, _ = solve_as_live(recording)
    assert not live.take.tracked.any()
    assert solve_recording(recording).take.tracked.mean() > 0.9


def test_instants_that_the_run_left_out_are_solved(run, tmp_path):
    setup, taken = run
    ticks = [event for event, _ in taken if isinstance(event, Tick)]
    left_out = {id(tick) for tick in ticks[20:30]}
    recording = written(
        tmp_path / "gaps.mcap", setup, [item for item in taken if id(item[0]) not in left_out]
    )
    take = solve_recording(recording).take
    assert len(take.timestamps_ns) == len(ticks)
    assert np.abs(np.diff(take.timestamps_ns) - 1e9 / 60).max() <= 1


def test_a_recording_begun_in_mid_run_says_so_and_solves(run, tmp_path):
    setup, taken = run
    recording = written(tmp_path / "mid.mcap", setup, taken[len(taken) // 3 :], from_start=False)
    solved = solve_recording(recording)
    assert solved.take.tracked.any()
    assert any("begun in mid-run" in note for note in solved.report.notes)
    assert any("mid-run" in finding.found for finding in diagnose_recording(recording.path))


def test_a_recording_without_instants_is_refused(run, tmp_path):
    setup, taken = run
    recording = written(
        tmp_path / "none.mcap", setup, [item for item in taken if not isinstance(item[0], Tick)]
    )
    with pytest.raises(InputError, match="holds no solved instant"):
        solve_recording(recording)
    with pytest.raises(InputError, match="holds no pose"):
        taken_from(recording.path)


def test_instants_years_apart_are_refused(run, tmp_path):
    setup, taken = run
    far = [(Tick(timestamp_ns=10**18), None)]
    recording = written(tmp_path / "far.mcap", setup, [*taken, *far])
    with pytest.raises(InputError, match="too many"):
        solve_recording(recording)


def test_what_is_made_from_a_recording_and_from_its_take_stands_side_by_side(recorded, tmp_path):
    """`run.mcap` is solved to `run.npz`: no command takes files of the one for the other's."""
    path, take = tmp_path / "run.mcap", tmp_path / "run.npz"
    path.write_bytes(recorded.read_bytes())
    makers = (["export", "--format", "csv,html"], ["angles"], ["report"])
    made = {}
    for source in (path, take):
        if source == take:
            save_take(taken_from(path), take)
        before = {file: file.read_bytes() for file in tmp_path.iterdir()}
        for name, *options in makers:
            result = CliRunner().invoke(app, [name, str(source), *options])
            assert result.exit_code == 0, result.output
        assert {file: file.read_bytes() for file in before} == before
        made[source] = {file.name for file in tmp_path.iterdir()} - {file.name for file in before}
    assert made[path] == {f"run.live{end}" for end in MADE}
    assert "<h2>Cameras</h2>" in (tmp_path / "run.live_report.html").read_text()
    assert made[take] == {f"run{end}" for end in MADE}
    result = CliRunner().invoke(app, ["solve", str(path), "--as-live", "--out", str(take)])
    assert result.exit_code == 0, result.output
    left = {file.name for file in tmp_path.iterdir()}
    assert made[path] <= left and not left & made[take]


def test_an_edited_take_finds_the_recording_that_it_came_from(recorded, tmp_path):
    path, take = tmp_path / "run.mcap", tmp_path / "run-as-live.npz"
    path.write_bytes(recorded.read_bytes())

    def done(*command: str) -> str:
        result = CliRunner().invoke(app, list(command))
        assert result.exit_code == 0, result.output
        return result.stdout

    done("solve", str(path), "--as-live")
    done("edit", str(take), "--trim", "0.2:", "--out", str(tmp_path / "short.npz"))
    told = json.loads(done("report", str(tmp_path / "short.npz"), "--json"))
    assert not told["notes"]
    assert "<h2>Cameras</h2>" in (tmp_path / "short_report.html").read_text()
    path.rename(tmp_path / "moved.mcap")
    told = json.loads(done("report", str(tmp_path / "short.npz"), "--json"))
    assert "does not stand beside" in told["notes"][0]


MADE = (".csv", ".html", "_angles.csv", "_report.html", ".files.json")


def test_commands_solve_and_check_a_recording(recorded, tmp_path):
    runner = CliRunner()
    out = tmp_path / "second.npz"
    result = runner.invoke(app, ["solve", str(recorded), "--out", str(out), "--json"])
    assert result.exit_code == 0, result.output
    assert json.loads(result.stdout)["files"] == [str(out)] and load_take(out).tracked.any()
    out = tmp_path / "live.npz"
    command = ["solve", str(recorded), "--as-live", "--export", "bvh", "--out", str(out), "--json"]
    result = runner.invoke(app, command)
    report = json.loads(result.stdout)
    assert report["replay"]["poses"] == report["replay"]["equal"] > 50
    assert len(report["files"]) == 3
    result = runner.invoke(app, ["doctor", str(recorded), "--json"])
    findings = json.loads(result.stdout)["findings"]
    assert result.exit_code == 0 and all(finding["severity"] != "error" for finding in findings)
    assert any("60.0 per second" in finding["found"] for finding in findings)


def test_doctor_tells_a_cut_recording(recorded, tmp_path):
    path = tmp_path / "cut.mcap"
    path.write_bytes(recorded.read_bytes()[:-20_000])
    found = [f.found for f in diagnose_recording(path) if f.severity == "warning"]
    assert any("was cut off" in text for text in found)


def test_as_live_is_for_recordings(folder):
    with pytest.raises(InputError, match="is no recording"):
        CliRunner().invoke(
            app, ["solve", str(folder / "session"), "--as-live"], catch_exceptions=False
        )


def test_second_solve_mounts_sensors_as_the_t_pose_of_the_run(tmp_path):
    """Sensors without a mounting are of use to the run after its T-pose, here from the start."""
    session = Session.model_validate(
        {
            "session": {"name": "sensors", "rate_hz": 60.0},
            "subject": [
                {"name": "anna", "imu": [{"bone": b, "live": "lsl:x"} for b in ("hips", "head")]}
            ],
        },
        context={"file": tmp_path / "session.toml"},
    )
    setup = SessionSetup(session=session, rig=Rig(cameras=()), landmarks=LANDMARK_SETS["body25"])
    taken = []
    engine = Engine(setup)
    for index in range(240):
        now_ns = round(index * 1e9 / 60)
        events = [
            ImuSample(
                subject="anna",
                bone=bone,
                timestamp_ns=now_ns,
                orientation_wxyz=np.array([np.cos(turn), 0, 0, np.sin(turn)]),
                accel_m_s2=np.array([0, 0, 9.80665]),
            )
            for bone, turn in (("hips", 0.3), ("head", 0.5))
        ]
        events += [Command(kind=CommandKind.TPOSE)] if index == 120 else []
        taken += [(event, engine.take(event)) for event in (*events, Tick(timestamp_ns=now_ns))]
    recording = written(tmp_path / "sensors.mcap", setup, taken)
    live, again = solve_as_live(recording)
    assert again.equal == again.poses > 60
    assert not live.take.tracked[0, :120].any() and live.take.tracked[0, -1]
    second = solve_recording(recording).take
    assert second.tracked.all()
    assert second.theta[0, -1] == pytest.approx(live.take.theta[0, -1], abs=0.01)


def test_second_solve_expects_who_was_added_in_the_run(run, tmp_path):
    setup, taken = run
    settings = setup.session.settings.model_copy(update={"max_subjects": 1})
    one = setup.session.model_copy(
        update={"settings": settings, "subjects": setup.session.subjects[:1]}
    )
    events = [(event, None) for event, _ in taken if getattr(event, "subject", "") in ("", "anna")]
    events.insert(len(events) // 2, (Command(kind=CommandKind.ADD_SUBJECT, subject="ben"), None))
    recording = written(tmp_path / "added.mcap", replace(setup, session=one), events)
    take = solve_recording(recording).take
    assert take.subject_names == ("anna", "ben")
    assert take.tracked.mean(axis=1).min() > 0.9


def test_what_contradicts_itself_in_a_recording_is_noted_or_refused(run, tmp_path):
    setup, taken = run

    def spoilt(event):
        if isinstance(event, CameraSample) and event.camera == 1:
            return replace(event, people=event.people[:, setup.landmarks.mirror])
        return event

    def in_g(event):
        if isinstance(event, ImuSample):
            return replace(event, accel_m_s2=event.accel_m_s2 / GRAVITY_M_S2)
        return event

    def solved(change, **options):
        changed = [(change(event), None) for event, _ in taken]
        recording = written(tmp_path / f"{change.__name__}.mcap", setup, changed)
        return solve_recording(recording, **options).report.notes

    assert any("left and right exchanged" in note for note in solved(spoilt))
    with pytest.raises(InputError, match="in units of g"):
        solved(in_g)
    assert any("in units of g" in note for note in solved(in_g, anyway=True))
