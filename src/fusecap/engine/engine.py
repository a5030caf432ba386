"""Events in, poses out: everything of a live run that decides poses.

    CameraSample ─▶ Cameras ──Detections──┐
                                          ├─▶ Pipeline ─▶ Continuity ─▶ LiveStep
       ImuSample ─▶ Sensors ──ImuReading──┘

A `Tick` solves one instant with the samples that have come so far; nothing here knows what time it
is. So an event sequence determines every pose, bit for bit, whenever and on whatever machine it is
played back. Poses go out as `[live] poses` says: of that instant, of one before it that has
settled, or of a later one, for which ticks `ahead` ask.
"""

from __future__ import annotations

import math
from collections import Counter, deque
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from fusecap.engine.cameras import Cameras
from fusecap.engine.continuity import Continuity
from fusecap.engine.sensors import Sensors
from fusecap.errors import SessionError
from fusecap.pipeline import Pipeline, Step
from fusecap.setup import SessionSetup, setup_of
from fusecap.solve.options import SolverOptions
from fusecap.sources.session import LiveSettings
from fusecap.types import (
    CameraSample,
    Command,
    CommandKind,
    Detections,
    Estimate,
    Event,
    ImuReading,
    ImuSample,
)

FARTHEST_AHEAD_S = 0.3
"""Of pictures: longer nobody goes on as before."""
_ROUNDED_NS = 1_000_000
"""By which an instant's time may be off its period."""
LOST_S = 1.0
"""Without any measurement before a person is said to be lost."""


@dataclass(frozen=True, slots=True, kw_only=True)
class LiveStep:
    """The last instant that was solved: its measurements, what was made of it, and what is sent."""

    timestamp_ns: int
    """Of the poses that are sent, on the session's clock."""
    detections: Detections
    """Interpolated to the instant that was solved."""
    readings: Mapping[str, ImuReading]
    """By subject, interpolated to the instant of the tick."""
    step: Step
    """As sorted and solved."""
    people: Mapping[str, Estimate | None]
    """Every subject in a lasting order, without jumps and with error bars that grow where nothing
    measures; None while there is no pose to send."""
    found_anew: Mapping[str, int] = field(default_factory=dict)
    """By name, how many poses were replaced since the step before this one."""


class Engine:
    """One live run; owned by one thread."""

    def __init__(self, setup: SessionSetup) -> None:
        session = setup.session
        self.notes: deque[str] = deque(maxlen=100)
        """What happened, in words, oldest first; the runtime takes them out."""
        self._cameras = Cameras(
            [session.camera_rate_hz(camera) for camera in session.cameras],
            len(setup.landmarks.landmark_names),
        )
        self._sensors = Sensors(session.subjects)
        solved = setup_of(session, setup.rig, setup.landmarks)
        self._live = session.live
        self._settle_s = (
            math.ceil(session.live.settle_s * session.settings.rate_hz - 1e-6)
            / session.settings.rate_hz
        )
        """In whole instants."""
        self._pipeline = Pipeline(
            replace(solved, options=_with_room(solved.options, session.live, solved.rate_hz))
        )
        self._hold_s = session.live.hold_s
        self._people = {subject.name: Continuity(self._hold_s) for subject in session.subjects}
        """In a lasting order."""
        self._tpose_facing_rad = {
            subject.name: float(np.radians(subject.tpose_facing_deg))
            for subject in session.subjects
        }
        self._present: set[str] = set()
        self._seen: set[str] = set()
        self._detections = self._cameras.detections(0)
        self._step = Step(updates=(), estimates=())
        self._found_anew: Counter[str] = Counter()
        """Since poses were last sent."""
        self._last_ns: int | None = None
        self._sent_ns: int | None = None

    def take(self, event: Event) -> LiveStep | None:
        """A step where poses are to be sent, else None; also for a tick not after the last one."""
        if isinstance(event, CameraSample):
            self._cameras.take(event)
        elif isinstance(event, ImuSample):
            self._sensors.take(event)
        elif isinstance(event, Command):
            self._obey(event)
        elif event.ahead:
            return self._look_ahead(event.timestamp_ns)
        elif self._last_ns is None or event.timestamp_ns > self._last_ns:
            self._last_ns = event.timestamp_ns
            return self._solve(event.timestamp_ns)
        return None

    def ready(self, timestamp_ns: int, *, ahead: bool = False) -> bool:
        """Whether every fresh source has a sample at or after an instant; not without any.

        Ahead of pictures sensors are enough, and without any nothing is waited for.
        """
        waiting = self._sensors.waiting(timestamp_ns)
        if not ahead:
            waiting += self._cameras.waiting(timestamp_ns)
        return (ahead or bool(waiting)) and not any(waiting)

    def expected(self, timestamp_ns: int) -> list[np.ndarray]:
        """Per camera (m, k, 3) people expected at an instant: x, y [px], confidence."""
        return self._pipeline.expected(timestamp_ns)

    @property
    def mountings(self) -> dict[tuple[str, str], np.ndarray]:
        """R_ib (3, 3) by subject and bone, as stated or taken from a T-pose."""
        return self._sensors.mountings

    def _solve(self, now_ns: int) -> LiveStep | None:
        readings = self._sensors.readings(now_ns)
        self._detections = self._cameras.detections(now_ns)
        self._step = self._pipeline.step(self._detections, readings)
        self.notes.extend(self._step.notes)
        self._found_anew.update(self._step.found_anew.keys())
        for name in self._step.found_anew:
            self.notes.append(f"{name}: the pose did not fit what was seen, and was found anew")
        if self._live.poses == "ahead":
            return None
        if self._live.poses == "solved":
            return self._send(now_ns, self._step.estimates, readings)
        settled_ns = now_ns - round(self._settle_s * 1e9)
        settled = [
            estimate
            for estimate in self._pipeline.settled(self._settle_s)
            if abs(estimate.timestamp_ns - settled_ns) <= _ROUNDED_NS
        ]
        return self._send(settled_ns, settled, readings)

    def _look_ahead(self, now_ns: int) -> LiveStep | None:
        if self._last_ns is None:
            return None
        readings = self._sensors.readings(now_ns)
        if now_ns <= self._last_ns:
            return self._send(self._last_ns, self._step.estimates, readings)
        return self._send(now_ns, self._pipeline.ahead(now_ns, readings), readings)

    def _send(
        self, now_ns: int, estimates: Iterable[Estimate], readings: Mapping[str, ImuReading]
    ) -> LiveStep | None:
        if self._sent_ns is not None and now_ns <= self._sent_ns:
            return None
        self._sent_ns = now_ns
        found_anew, self._found_anew = self._found_anew, Counter()
        solved = {estimate.name: estimate for estimate in estimates}
        for name in solved:
            if name not in self._people:
                self._people[name] = Continuity(self._hold_s)
        people = {}
        for name, continuity in self._people.items():
            estimate = solved.get(name)
            views = 0 if estimate is None else min(int(estimate.views.sum()), 2)
            heard_ns = continuity.measured_ns
            silent_ns = 0 if heard_ns is None else now_ns - heard_ns
            people[name] = continuity.update(estimate, (views, name in readings), now_ns)
            self._watch(name, continuity.measured_ns == now_ns, silent_ns * 1e-9)
        return LiveStep(
            timestamp_ns=now_ns,
            detections=self._detections,
            readings=readings,
            step=self._step,
            people=people,
            found_anew=found_anew,
        )

    def _watch(self, name: str, measured: bool, silent_s: float) -> None:
        """Notes of people who come, go and return."""
        if measured and name not in self._present:
            was_here = name in self._seen
            self.notes.append(f"{name} returned" if was_here else f"{name} found")
            self._present.add(name)
            self._seen.add(name)
        elif not measured and silent_s > LOST_S and name in self._present:
            self.notes.append(f"{name} lost: no camera sees them, no sensor is heard")
            self._present.remove(name)

    def _obey(self, command: Command) -> None:
        name, adds = command.subject, command.kind is CommandKind.ADD_SUBJECT
        if name and adds == (name in self._people):
            found = "somebody is" if adds else "nobody is"
            self.notes.append(f"{command.kind.value} ignored: {found} called '{name}'")
            return
        try:
            if adds:
                self._add(name)
            elif command.kind is CommandKind.REINITIALISE:
                self._pipeline.reinitialise(name)
                self.notes.append(f"{name or 'everyone'} to be found anew")
            elif command.kind is CommandKind.REMOVE_SUBJECT:
                self._remove(name)
            else:
                self._mount(name)
        except SessionError as error:
            self.notes.append(f"{command.kind.value} not done: {error}")

    def _add(self, name: str) -> None:
        self._pipeline.add_subject(name)
        self.notes.append(f"room for {name or 'one more person'}")
        if name:
            self._people[name] = Continuity(self._hold_s)

    def _remove(self, name: str) -> None:
        if not name:
            raise SessionError("say whom")
        self._pipeline.remove_subject(name)
        self.notes.append(f"{name} removed")
        del self._people[name]
        self._present.discard(name)
        self._seen.discard(name)

    def _mount(self, name: str) -> None:
        wearers = [name] if name else [n for n in self._sensors.wearers if n in self._people]
        for wearer in wearers:
            if wearer not in self._sensors.wearers:
                self.notes.append(f"{wearer} wears no sensors: no T-pose taken")
            else:
                self.notes.append(self._sensors.mount_in_tpose(wearer, self._facing_rad(wearer)))

    def _facing_rad(self, name: str) -> float:
        """Where a subject faces now: as cameras saw it, else as the session says for the T-pose."""
        for estimate in self._step.estimates:
            if estimate.name == name and estimate.views.sum() > 1:
                ahead = estimate.bone_rotation_in_world[0, :, 2]
                return float(np.arctan2(ahead[0], ahead[2]))
        return self._tpose_facing_rad[name]


def _with_room(options: SolverOptions, live: LiveSettings, rate_hz: float) -> SolverOptions:
    """With a window in which poses can settle, and room ahead of it."""
    if live.poses == "solved":
        return options
    if not options.together:
        raise SessionError(
            f'[live] poses = "{live.poses}" needs instants that are solved together; leave out '
            "[estimator] window = 1 and weights that switch all terms between instants off"
        )
    if live.poses == "ahead":
        return replace(options, ahead=math.ceil(FARTHEST_AHEAD_S * rate_hz))
    return replace(options, window=max(options.window, math.ceil(live.settle_s * rate_hz) + 1))
