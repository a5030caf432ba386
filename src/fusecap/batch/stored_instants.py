"""Single instants of a recording, each read when somebody asks for it."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from fusecap.batch.replay import recorded_setup
from fusecap.batch.second_solve import after_commands, instants_ns
from fusecap.engine.cameras import Cameras
from fusecap.engine.samples import KEPT_NS, PERIOD_SAMPLES
from fusecap.engine.sensors import Sensors
from fusecap.progress import Progress
from fusecap.recording.index import Places, RecordingIndex
from fusecap.recording.layout import COMMAND, IMU, TICK
from fusecap.recording.reader import RecordedEvent, Recording
from fusecap.setup import Setup, setup_of
from fusecap.sources.synchronizer import EXACT_S
from fusecap.types import CameraSample, Detections, Event, ImuReading, ImuSample, Tick

_EXACT_NS = round(EXACT_S * 1e9)


class StoredInstants:
    """What `RecordedInstants` holds of a run, with no more in memory than where its samples are.

    Of a camera or a sensor the two samples around an instant are read; one of them that is
    malformed is missing there, in place of the next that is not. Raises `InputError` where there
    is no instant.
    """

    def __init__(self, recording: Recording, progress: Progress | None = None) -> None:
        self._index = RecordingIndex(recording, events=True, progress=progress)
        setup = recorded_setup(recording)
        times_ns = instants_ns(recording, self._first_and_last_ns(), setup.session.settings.rate_hz)
        commands = [
            item
            for places in self._of_schema(COMMAND)
            for row in range(len(places.times_ns))
            if isinstance(item := self._index.read(places, row), RecordedEvent)
        ]
        setup = after_commands(recording, setup, commands, progress)
        self.setup: Setup = setup_of(setup.session, setup.rig, setup.landmarks)
        self._session, self._times_ns = setup.session, times_ns
        self._rates_hz = [self._session.camera_rate_hz(camera) for camera in self._session.cameras]
        self._cameras = [
            _Source(self._index.events.get(f"/camera/{name}/keypoints")) for name in setup.rig.names
        ]
        self._sensors = [_Source(places) for places in self._of_schema(IMU)]
        self._nobody = np.empty((0, len(setup.landmarks.landmark_names), 3))

    def __len__(self) -> int:
        return len(self._times_ns)

    def detections(self, instant: int) -> Detections:
        """Everyone in every camera."""
        now_ns = self._times_ns[instant]
        cameras = Cameras(self._rates_hz, self._nobody.shape[1])
        for camera, source in enumerate(self._cameras):
            after = source.first_from(now_ns - _EXACT_NS)
            # Of those farther away, times alone matter: the camera's rate, and whether it looks.
            for at in range(max(after - PERIOD_SAMPLES, 0), min(after + 3, len(source.times_ns))):
                time_ns = int(source.times_ns[at])
                sample: Event | None = CameraSample(
                    camera=camera, timestamp_ns=time_ns, people=self._nobody
                )
                if at in (after - 1, after):
                    sample = source.read(self._index, at)
                if isinstance(sample, CameraSample) and time_ns >= now_ns - KEPT_NS:
                    cameras.take(sample)
        return cameras.detections(now_ns)

    def readings(self, instant: int) -> Mapping[str, ImuReading]:
        """By subject name, what its sensors say."""
        now_ns = self._times_ns[instant]
        sensors = Sensors(self._session.subjects)
        for source in self._sensors:
            after = source.first_from(now_ns - _EXACT_NS)
            for at in range(max(after - 1, 0), min(after + 1, len(source.times_ns))):
                sample = source.read(self._index, at)
                if isinstance(sample, ImuSample):
                    sensors.take(sample)
        return sensors.readings(now_ns)

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
    """The samples of one camera or sensor in the order of their times; of one time the first."""

    def __init__(self, places: Places | None) -> None:
        self._places = places
        times_ns = np.array([] if places is None else places.times_ns, dtype=np.int64)
        self.times_ns, self._rows = np.unique(times_ns, return_index=True)

    def first_from(self, time_ns: int) -> int:
        """The first sample not before a time."""
        return int(np.searchsorted(self.times_ns, time_ns))

    def read(self, index: RecordingIndex, at: int) -> Event | None:
        """One of them; None where it is malformed."""
        assert self._places is not None
        return _event(index, self._places, int(self._rows[at]))


def _event(index: RecordingIndex, places: Places, row: int) -> Event | None:
    item = index.read(places, row)
    return item.event if isinstance(item, RecordedEvent) else None
