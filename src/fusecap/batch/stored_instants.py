"""The instants of a recording, each read from it when somebody asks."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Int
from scipy.spatial.transform import Rotation

from fusecap.batch.replay import Replay, recorded_setup
from fusecap.engine.cameras import Cameras
from fusecap.engine.samples import KEPT_NS, PERIOD_SAMPLES
from fusecap.engine.sensors import Sensors
from fusecap.errors import InputError
from fusecap.geometry.quaternions import to_wxyz
from fusecap.progress import Progress
from fusecap.recording.index import Places, RecordingIndex
from fusecap.recording.layout import COMMAND, IMU, TICK
from fusecap.recording.reader import RecordedEvent, Recording
from fusecap.setup import SessionSetup, Setup, setup_of
from fusecap.sources.session import Session, SubjectSettings
from fusecap.sources.session_data import MAX_INSTANTS
from fusecap.sources.synchronizer import EXACT_S
from fusecap.types import (
    CameraSample,
    Command,
    CommandKind,
    Detections,
    Event,
    ImuReading,
    ImuSample,
    Tick,
)

_EXACT_NS = round(EXACT_S * 1e9)
_NEVER = -(1 << 63)


class StoredInstants:
    """The samples of a run, interpolated to instants as the run does it.

    No more is in memory than where the samples are. Instants in their order take each sample once;
    for one out of order, only the two samples around it are read of a camera or a sensor. Raises
    `InputError` where there is no instant.
    """

    def __init__(self, recording: Recording, progress: Progress | None = None) -> None:
        self._index = RecordingIndex(recording, events=True, progress=progress)
        setup = recorded_setup(recording)
        rate_hz = setup.session.settings.rate_hz
        self._times_ns = instants_ns(recording, self._first_and_last_ns(), rate_hz)
        commands = [
            item
            for places in self._of_schema(COMMAND)
            for row in range(len(places.times_ns))
            if isinstance(item := self._index.read(places, row), RecordedEvent)
        ]
        self.recorded = after_commands(recording, setup, commands, progress)
        """With who was added in the run, and how sensors sat in the end."""
        session = self.recorded.session
        self.setup: Setup = setup_of(session, setup.rig, setup.landmarks)
        self._rates_hz = [session.camera_rate_hz(camera) for camera in session.cameras]
        self._nobody = np.empty((0, len(setup.landmarks.landmark_names), 3))
        self._seen = [
            _Source(self._index, self._index.events.get(f"/camera/{name}/keypoints"))
            for name in setup.rig.names
        ]
        self._worn = [_Source(self._index, places) for places in self._of_schema(IMU)]
        self._cameras, self._cameras_at = self._new_cameras(), -1
        self._sensors, self._sensors_at = Sensors(session.subjects), -1

    def __len__(self) -> int:
        return len(self._times_ns)

    def detections(self, instant: int) -> Detections:
        """Everyone in every camera."""
        now_ns = self._times_ns[instant]
        jumped = instant not in (self._cameras_at, self._cameras_at + 1)
        if jumped:
            self._cameras = self._new_cameras()
        self._cameras_at = instant
        for camera, source in enumerate(self._seen):
            if jumped:
                # Of those farther away, times alone matter: the camera's rate, whether it looks.
                for time_ns in source.jump(now_ns)[-PERIOD_SAMPLES:].tolist():
                    if time_ns >= now_ns - KEPT_NS:
                        self._cameras.take(
                            CameraSample(camera=camera, timestamp_ns=time_ns, people=self._nobody)
                        )
            for sample in source.until(now_ns):
                if isinstance(sample, CameraSample):
                    self._cameras.take(sample)
        return self._cameras.detections(now_ns)

    def readings(self, instant: int) -> Mapping[str, ImuReading]:
        """By subject name, what its sensors say."""
        now_ns = self._times_ns[instant]
        jumped = instant not in (self._sensors_at, self._sensors_at + 1)
        if jumped:
            self._sensors = Sensors(self.recorded.session.subjects)
        self._sensors_at = instant
        for source in self._worn:
            if jumped:
                source.jump(now_ns)
            for sample in source.until(now_ns):
                if isinstance(sample, ImuSample):
                    self._sensors.take(sample)
        return self._sensors.readings(now_ns)

    def _new_cameras(self) -> Cameras:
        return Cameras(self._rates_hz, self._nobody.shape[1])

    def _of_schema(self, schema: str) -> list[Places]:
        return [places for places in self._index.events.values() if places.schema == schema]

    def _first_and_last_ns(self) -> list[int]:
        """Of the ticks that were not for instants ahead; fewer where there are fewer."""
        found = []
        for places in self._of_schema(TICK):
            rows = np.argsort(np.array(places.times_ns))
            for order in (rows, rows[::-1]):
                for row in order.tolist():
                    tick = _event(self._index, places, row)
                    if isinstance(tick, Tick) and not tick.ahead:
                        found.append(tick.timestamp_ns)
                        break
        return found


class _Source:
    """The samples of one camera or sensor in the order of their times, else as they came."""

    def __init__(self, index: RecordingIndex, places: Places | None) -> None:
        self._index, self._places = index, places
        self._times_ns = np.frombuffer(b"" if places is None else places.times_ns, np.int64)
        self._rows: np.ndarray | None = None
        if (np.diff(self._times_ns) < 0).any():
            self._rows = np.argsort(self._times_ns, kind="stable")
            self._times_ns = self._times_ns[self._rows]
        self._next, self._reached_ns = 0, _NEVER

    def jump(self, now_ns: int) -> Int[np.ndarray, " n"]:
        """Go on with the last sample before an instant; the times of those that are left out."""
        times_ns = self._times_ns
        at = int(np.searchsorted(times_ns, now_ns - _EXACT_NS)) - 1
        while at >= 0:
            at = int(np.searchsorted(times_ns, times_ns[at]))
            if times_ns[at] < now_ns - KEPT_NS or self._read(at) is not None:
                break
            at -= 1
        self._next, self._reached_ns = max(at, 0), _NEVER
        return times_ns[: self._next]

    def until(self, now_ns: int) -> Iterator[Event]:
        """The next ones that are not malformed, to the first after an instant; none far ahead."""
        while self._reached_ns <= now_ns and self._next < len(self._times_ns):
            at = self._next
            time_ns = int(self._times_ns[at])
            if time_ns > now_ns + KEPT_NS:
                return
            self._next, sample = at + 1, self._read(at)
            if sample is not None:
                self._reached_ns = time_ns
                yield sample

    def _read(self, at: int) -> Event | None:
        assert self._places is not None
        return _event(self._index, self._places, int(at if self._rows is None else self._rows[at]))


def _event(index: RecordingIndex, places: Places, row: int) -> Event | None:
    item = index.read(places, row)
    return item.event if isinstance(item, RecordedEvent) else None


def instants_ns(recording: Recording, ticks_ns: Sequence[int], rate_hz: float) -> list[int]:
    """The run's own instants, those that it left out filled in; raises `InputError` without any."""
    if not ticks_ns:
        raise InputError(
            f"{recording.path} holds no solved instant: it was cut off within the first moments, "
            "or the run never came to solve"
        )
    first, last = (round(ns * 1e-9 * rate_hz) for ns in (min(ticks_ns), max(ticks_ns)))
    if last - first > MAX_INSTANTS:
        raise InputError(
            f"{recording.path}: instants from {min(ticks_ns) * 1e-9:g} to "
            f"{max(ticks_ns) * 1e-9:g} s at {rate_hz:g} Hz are too many; it is damaged"
        )
    return [round(instant * 1e9 / rate_hz) for instant in range(first, last + 1)]


def after_commands(
    recording: Recording,
    setup: SessionSetup,
    commands: Sequence[RecordedEvent],
    progress: Progress | None,
) -> SessionSetup:
    """With who was added in the run, and how sensors sat in the end."""
    asked = [(item.number, item.event) for item in commands if isinstance(item.event, Command)]
    session = _with_people(setup.session, [command for _, command in asked])
    tposes = [number for number, command in asked if command.kind is CommandKind.TPOSE]
    if tposes:
        again = Replay(Recording(recording.path))
        deque(again.steps(progress, last=tposes[-1]), maxlen=0)
        session = _with_mountings(session, again.engine.mountings)
    return replace(setup, session=session)


def _with_people(session: Session, commands: Sequence[Command]) -> Session:
    """The session with everyone who was added in the run."""
    added = [c.subject for c in commands if c.kind is CommandKind.ADD_SUBJECT]
    known = [subject.name for subject in session.subjects]
    new = [name for name in dict.fromkeys(added) if name and name not in known]
    limit = session.settings.max_subjects
    settings = session.settings.model_copy(
        update={"max_subjects": None if limit is None else limit + len(added)}
    )
    subjects = (*session.subjects, *(SubjectSettings(name=name) for name in new))
    return session.model_copy(update={"settings": settings, "subjects": subjects})


def _with_mountings(session: Session, mountings: Mapping[tuple[str, str], np.ndarray]) -> Session:
    subjects = []
    for subject in session.subjects:
        imus = []
        for imu in subject.imus:
            bone_from_imu = mountings.get((subject.name, imu.bone))
            if bone_from_imu is not None:
                w, x, y, z = to_wxyz(Rotation.from_matrix(bone_from_imu)).tolist()
                imu = imu.model_copy(update={"bone_from_imu_wxyz": (w, x, y, z)})
            imus.append(imu)
        subjects.append(subject.model_copy(update={"imus": tuple(imus)}))
    return session.model_copy(update={"subjects": tuple(subjects)})
