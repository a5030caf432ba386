"""The second solve of a live run: the two passes of a session over all that was recorded.

Every sample counts that came at all, however late it came in the run. Who was added in the run is
expected from the start, and sensors sit as the last T-pose found them; other commands were about
the run's own tracks and mean nothing here.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import replace
from operator import attrgetter

import numpy as np
from scipy.spatial.transform import Rotation

from fusecap.batch.replay import Replay, loss_notes, recorded_setup
from fusecap.batch.solve import Solved, refuse_errors, solve_instants
from fusecap.checks import check_samples
from fusecap.engine.cameras import Cameras
from fusecap.engine.sensors import Sensors
from fusecap.errors import InputError
from fusecap.geometry.quaternions import to_wxyz
from fusecap.progress import Progress
from fusecap.recording.reader import RecordedEvent, Recording
from fusecap.setup import SessionSetup, setup_of
from fusecap.sources.session import Session, SubjectSettings
from fusecap.sources.session_data import MAX_INSTANTS
from fusecap.types import (
    CameraSample,
    Command,
    CommandKind,
    Detections,
    ImuReading,
    ImuSample,
    Tick,
)

AHEAD_NS = 1_000_000_000
"""Samples so much later than an instant are known to it."""

Sample = CameraSample | ImuSample


class RecordedInstants:
    """The samples of a run, interpolated to instants as the run does it."""

    def __init__(
        self, session: Session, landmark_count: int, samples: list[Sample], times_ns: list[int]
    ) -> None:
        rates_hz = [session.camera_rate_hz(camera) for camera in session.cameras]
        cameras, sensors = Cameras(rates_hz, landmark_count), Sensors(session.subjects)
        self._instants: list[tuple[Detections, Mapping[str, ImuReading]]] = []
        coming = deque(sorted(samples, key=attrgetter("timestamp_ns")))
        for now_ns in times_ns:
            while coming and coming[0].timestamp_ns <= now_ns + AHEAD_NS:
                sample = coming.popleft()
                if isinstance(sample, CameraSample):
                    cameras.take(sample)
                else:
                    sensors.take(sample)
            self._instants.append((cameras.detections(now_ns), sensors.readings(now_ns)))

    def __len__(self) -> int:
        return len(self._instants)

    def detections(self, instant: int) -> Detections:
        """Everyone in every camera."""
        return self._instants[instant][0]

    def readings(self, instant: int) -> Mapping[str, ImuReading]:
        """By subject name, what its sensors say."""
        return self._instants[instant][1]


def solve_recording(
    recording: Recording, progress: Progress | None = None, *, anyway: bool = False
) -> Solved:
    """Both passes over a recording; what is odd about it is in the report's notes.

    Raises `InputError` where it holds no instant, and for what is an error to doctor, unless
    `anyway`.
    """
    setup, samples, times_ns = _recorded(recording, progress)
    found = check_samples(setup, samples).sorted()
    if not anyway:
        refuse_errors(recording.path, found)
    return solve_instants(
        setup_of(setup.session, setup.rig, setup.landmarks),
        RecordedInstants(setup.session, len(setup.landmarks.landmark_names), samples, times_ns),
        progress=progress,
        session_sha256=recording.sha256(),
        recording=recording.path.name,
        simulated=setup.simulated,
        notes=(*loss_notes(recording), *(str(f) for f in found if f.severity != "info")),
    )


def _recorded(
    recording: Recording, progress: Progress | None
) -> tuple[SessionSetup, list[Sample], list[int]]:
    """With who was added and how sensors sat in the end; all samples, and when to solve."""
    setup = recorded_setup(recording)
    samples: list[Sample] = []
    ticks_ns: list[int] = []
    commands: list[RecordedEvent] = []
    for item in recording.items(progress):
        match item:
            case RecordedEvent(event=Tick(ahead=False) as tick):
                ticks_ns.append(tick.timestamp_ns)
            case RecordedEvent(event=Command()):
                commands.append(item)
            case RecordedEvent(event=CameraSample() | ImuSample() as sample):
                samples.append(sample)
    times_ns = instants_ns(recording, ticks_ns, setup.session.settings.rate_hz)
    return after_commands(recording, setup, commands, progress), samples, times_ns


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
