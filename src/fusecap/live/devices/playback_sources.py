"""A recorded session, delivered as if it were live: every camera and sensor at its own pace.

A loop jumps back to where people began, though never in time. `there_and_back` plays every second
round backwards instead: nobody jumps, and sensors stay true, because neither orientation nor
acceleration depends on the direction of time.
"""

from __future__ import annotations

import threading
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int

from fusecap.errors import InputError, SessionError
from fusecap.live.devices.paced_sources import (
    HeldPictures,
    Keypoints,
    PacedPictures,
    PacedSensors,
    PacedSource,
    Schedule,
)
from fusecap.live.devices.source import Deliver, Delivery, SessionClock, Source
from fusecap.progress import Progress
from fusecap.sources.keypoint_files import read_keypoints
from fusecap.sources.session import Session
from fusecap.sources.session_cameras import common_landmarks
from fusecap.sources.session_data import session_clocks, video_times_s
from fusecap.sources.session_sensors import open_imus
from fusecap.sources.video import Video
from fusecap.types import ImuSample


@dataclass(frozen=True, slots=True, kw_only=True)
class Stall:
    """A source that delivers nothing for a while."""

    source: str
    """A camera's name, "subject/bone", or a subject's name for all of its sensors."""
    start_s: float
    """Since the run began."""
    length_s: float


@dataclass(frozen=True, slots=True, kw_only=True)
class PlaybackOptions:
    """How a recording is played."""

    loop: bool = False
    """Play again from the start without end, with a jump of the people."""
    there_and_back: bool = False
    """Play backwards and forwards without end; pictures must be `in_memory`."""
    in_memory: bool = False
    """Decode all pictures before the run."""
    image_rate_hz: float | None = None
    """Leave out pictures beyond this rate; None: play all."""
    delay_s: float = 0.0
    """From exposure to arrival."""
    jitter_ms: float = 0.0
    """Further delay, uniform between 0 and this."""
    loss: float = 0.0
    """Share of samples and pictures that never arrive."""
    stalls: tuple[Stall, ...] = ()
    seed: int = 0


def playback_sources(
    session: Session,
    clock: SessionClock,
    options: PlaybackOptions | None = None,
    progress: Progress | None = None,
) -> list[Source]:
    """A source per camera, and one per subject with sensors; files are read before this returns.

    A camera with keypoints delivers these, one with a video only its pictures. Raises `InputError`
    for inputs that cannot be read, and for cameras and sensors without any.
    """
    options = options or PlaybackOptions()
    _check(options)
    sources = [
        *_cameras(session, options, progress),
        *_sensors(session),
    ]
    schedule = Schedule(
        sources,
        clock,
        loop=options.loop or options.there_and_back,
        two_way=options.there_and_back,
        delay_ns=round(options.delay_s * 1e9),
        jitter_ns=round(options.jitter_ms * 1e6),
    )
    for index, source in enumerate(sources):
        source.follow(schedule, seed=options.seed + index)
    stalls = _stalls(options, session)
    if not stalls and not options.loss:
        return list(sources)
    return [
        _Interrupted(source, stalls, options.loss, clock, seed=options.seed + index)
        for index, source in enumerate(sources)
    ]


class _Interrupted:
    """A source that delivers what another does, but for stalls and losses on the way."""

    def __init__(
        self, source: Source, stalls: Sequence[Stall], loss: float, clock: SessionClock, seed: int
    ) -> None:
        self.name = source.name
        self.counts = source.counts
        self._source = source
        self._stalls = tuple(stalls)
        self._loss = loss
        self._clock = clock
        self._rng = np.random.default_rng(seed)

    def run(self, deliver: Deliver, stopping: threading.Event) -> None:
        """As the source does."""

        def pass_on(item: Delivery) -> None:
            if not self._stalled(item) and not (self._loss and self._rng.random() < self._loss):
                deliver(item)

        self._source.run(pass_on, stopping)

    def _stalled(self, item: Delivery) -> bool:
        names = [self.name]
        if isinstance(item, ImuSample):
            names.append(f"{item.subject}/{item.bone}")
        since_s = self._clock.now_ns() * 1e-9
        return any(
            stall.source in names and 0 <= since_s - stall.start_s < stall.length_s
            for stall in self._stalls
        )


def _stalls(options: PlaybackOptions, session: Session) -> list[Stall]:
    """With the names that sources give themselves."""
    where = {camera.name: f"camera '{camera.name}'" for camera in session.cameras}
    for subject in session.subjects:
        where[subject.name] = f"imus of '{subject.name}'"
        where |= {sensor: sensor for sensor in (f"{subject.name}/{i.bone}" for i in subject.imus)}
    for stall in options.stalls:
        if stall.source not in where:
            raise InputError(
                f"no source '{stall.source}' to stall; expected one of {', '.join(where)}"
            )
    return [replace(stall, source=where[stall.source]) for stall in options.stalls]


def _check(options: PlaybackOptions) -> None:
    if not 0 <= options.loss <= 1:
        raise InputError(f"loss is {options.loss:g}, expected a share from 0 to 1")
    if options.jitter_ms < 0 or options.delay_s < 0:
        raise InputError("delay and jitter of a playback must be zero or more")
    if options.image_rate_hz is not None and options.image_rate_hz <= 0:
        raise InputError(f"image rate {options.image_rate_hz:g}, expected a number above zero")


def _cameras(
    session: Session, options: PlaybackOptions, progress: Progress | None
) -> Iterator[PacedSource]:
    landmarks = common_landmarks(session)
    clocks = session_clocks(session)
    for index, camera in enumerate(session.cameras):
        clock = clocks.camera(camera.name)
        if camera.keypoints is not None and landmarks is not None:
            track = read_keypoints(
                camera.keypoints,
                name=camera.name,
                landmarks=landmarks,
                rate_hz=session.camera_rate_hz(camera),
                offset_s=camera.offset_s,
                own_times=camera.rate_hz is None,
                place=session.place_in_table(camera),
                progress=progress,
            )
            yield Keypoints(index, track, clock.session_s(track.times_s))
        elif camera.video is not None:
            video = Video(camera.video)
            times_s = video_times_s(session, camera, video)
            shown = _thinned(times_s, options.image_rate_hz)
            if options.in_memory:
                yield HeldPictures(index, camera.name, video, times_s, shown, progress)
            elif options.there_and_back:
                raise InputError(
                    f"camera '{camera.name}': a video is played backwards only from memory; "
                    "decode it before the run (in_memory)"
                )
            else:
                yield PacedPictures(index, camera.name, video, times_s, shown)
        else:
            raise SessionError(
                f"{session.path}: camera '{camera.name}' is live only; name a folder of keypoints "
                "or a video to play back"
            )


def _sensors(session: Session) -> Iterator[PacedSource]:
    clocks = session_clocks(session)
    for subject in session.subjects:
        if subject.imus:
            bones = [imu.bone for imu in subject.imus]
            tracks = open_imus(subject)
            times_s = [
                clocks.imu(subject.name, bone).session_s(track.times_s)
                for bone, track in zip(bones, tracks, strict=True)
            ]
            yield PacedSensors(subject.name, bones, tracks, times_s)


def _thinned(times_s: Float[np.ndarray, " f"], rate_hz: float | None) -> Int[np.ndarray, " n"]:
    """Which frames to show so that there are at most `rate_hz` per second."""
    if rate_hz is None:
        return np.arange(len(times_s))
    slot = np.floor((times_s - times_s[0]) * rate_hz + 1e-6)
    return np.flatnonzero(np.diff(slot, prepend=-1.0) > 0)
