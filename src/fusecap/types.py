"""What crosses a stage.

    sources ──Detections, ImuReading──▶ associate ──Observation──▶ solve ──Estimate──▶ take, streams

Live, samples come one by one, each with a time of its own:

    CameraImage ──detect──▶ CameraSample ┐
                               ImuSample ├──▶ Event ──engine──▶ Detections, ImuReading
                           Command, Tick ┘

Arrays are float64, shapes are types, missing values are NaN with confidence 0. Times are int
nanoseconds on one clock.
"""

from __future__ import annotations

import enum
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from fusecap.body.shape import BodyShape

GRAVITY_M_S2 = 9.80665
"""Standard gravity; the paper prints 9.8707 [1, sec. 3.2.3]."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ImuReading:
    """What the I sensors of one subject say about its bones at one instant, in the world."""

    bone_rotation_in_world: Float[np.ndarray, "i 3 3"]
    """Measured bone orientation [1, eq. 8]; NaN where no sample is near."""
    accel_in_world_m_s2: Float[np.ndarray, "i 3"]
    """Acceleration without gravity [1, eq. 12]; NaN where not measured."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Detections:
    """Everyone the detector found in every camera at one instant."""

    timestamp_ns: int
    people: tuple[Float[np.ndarray, "n k 3"], ...]
    """Per camera the n people's keypoints: x [px], y [px], confidence 0-1 (0 = missing)."""
    looked: tuple[bool, ...] | None = None
    """Per camera whether it sees at all, that is, whether nobody means nobody; None: all do."""
    appearance: tuple[UInt8[np.ndarray, "n 40"], ...] | None = None
    """Row by row how the people's clothes look to the camera (`fusecap.appearance`), 0 where not
    seen; None without pictures."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Observation:
    """The measurements that were assigned to one track at one instant."""

    timestamp_ns: int
    keypoints: Float[np.ndarray, "c k 3"]
    """Per camera: x [px], y [px], confidence (0 = missing)."""
    imu: ImuReading | None = None


def quality_of(bone_sigma_deg: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n"]:
    """0-1, for colours and for programs that know no units: a half at 15 deg."""
    return 1.0 / (1.0 + (bone_sigma_deg / 15.0) ** 2)


class Status(enum.Enum):
    """How a solve ended."""

    CONVERGED = 0
    ITERATION_LIMIT = 1
    DIVERGED = 2
    """No finite improvement could be found; the pose is the one it started from."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Estimate:
    """One subject's pose at one instant."""

    track_id: int
    name: str
    timestamp_ns: int
    theta: Float[np.ndarray, " p"]
    bone_position_in_world_m: Float[np.ndarray, "b 3"]
    bone_rotation_in_world: Float[np.ndarray, "b 3 3"]
    bone_sigma_deg: Float[np.ndarray, " b"]
    """Expected root mean square error of each bone's rotation in the world."""
    position_sigma_m: Float[np.ndarray, " b"]
    """Expected root mean square error of each joint's place in the cameras' world."""
    shape: BodyShape
    status: Status
    iterations: int
    cost: float
    solve_s: float
    """Wall time of the solve alone."""
    views: Bool[np.ndarray, " c"]
    """Which cameras contributed."""
    measured: bool
    """A camera or a sensor told of this instant; else the pose goes on from those before."""

    @property
    def bone_quality(self) -> Float[np.ndarray, " b"]:
        """See `quality_of`."""
        return quality_of(self.bone_sigma_deg)


class TrackState(enum.Enum):
    """A track's life: tentative until seen often enough, confirmed, coasting while unseen."""

    TENTATIVE = "tentative"
    CONFIRMED = "confirmed"
    COASTING = "coasting"


@dataclass(frozen=True, slots=True, kw_only=True)
class TrackUpdate:
    """What association decided about one track at one instant."""

    track_id: int
    name: str
    state: TrackState
    person: Int[np.ndarray, " c"]
    """Per camera the index into `Detections.people`, or -1 where the track is not seen."""
    landmarks_in_world_m: Float[np.ndarray, "k 3"]
    """Triangulated from the assigned keypoints; NaN where fewer than two views agree."""


@dataclass(frozen=True, slots=True, kw_only=True)
class CameraImage:
    """One picture of a live camera."""

    camera: int
    """In the order of the rig."""
    timestamp_ns: int
    """Of the exposure, on the session's clock."""
    image: UInt8[np.ndarray, "h w 3"]
    """BGR."""


@dataclass(frozen=True, slots=True, kw_only=True)
class CameraSample:
    """Everyone the detector found in one picture of one camera."""

    camera: int
    """In the order of the rig."""
    timestamp_ns: int
    """Of the exposure, on the session's clock."""
    people: Float[np.ndarray, "n k 3"]
    """x [px], y [px], confidence 0-1; NaN, NaN, 0 where missing."""
    appearance: UInt8[np.ndarray, "n 40"] | None = None
    """As in `Detections`."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ImuSample:
    """What one sensor measured at one moment."""

    subject: str
    bone: str
    """That carries the sensor; with the subject it says which sensor this is."""
    timestamp_ns: int
    """On the session's clock."""
    orientation_wxyz: Float[np.ndarray, "4"]
    """imu_world_from_imu, unit."""
    accel_m_s2: Float[np.ndarray, "3"]
    """Specific force in the imu frame (at rest +9.8 along up); NaN where not measured."""


class CommandKind(enum.Enum):
    """What a user may ask of a live run."""

    REINITIALISE = "reinitialise"
    """Find the subject (empty name: everyone) anew."""
    ADD_SUBJECT = "add_subject"
    """Make room for one more person."""
    REMOVE_SUBJECT = "remove_subject"
    """Follow this person no longer."""
    TPOSE = "tpose"
    """The subject (empty name: everyone with sensors) has stood in the T-pose for the last second;
    its sensors' mounting is taken from there."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Command:
    """A user's wish, in its place among the samples."""

    kind: CommandKind
    subject: str = ""


@dataclass(frozen=True, slots=True, kw_only=True)
class Tick:
    """Solve this instant now, with the samples that have come so far."""

    timestamp_ns: int
    """On the session's clock."""
    ahead: bool = False
    """From sensors and by how people move; pictures have only come to the last tick that is not."""


Event = CameraSample | ImuSample | Command | Tick
"""What a live run is made of; a recording holds events in the order in which they were taken."""
