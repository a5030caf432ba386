"""Lab Streaming Layer: the channels of one person, after XDF's meta-data for MoCap [1].

Eight channels per bone, in the world and in our axes: position [m], quaternion x y z w, and the
quality as confidence. The stream keeps its rate while a person is not tracked: all channels NaN.

[1] https://github.com/sccn/xdf/wiki/MoCap-Meta-Data
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float32

from fusecap.body.skeleton import Skeleton
from fusecap.errors import InputError, from_extra
from fusecap.streams.person_pose import PersonPose, StreamFrame
from fusecap.streams.stream import Cast, StreamProtocol
from fusecap.streams.target import Target
from fusecap.streams.transports import Counts

CONTENT_TYPE = "MoCap"
COORDINATES = "right-handed, y up, floor at y = 0; bones parallel to the world in the T-pose"

_OF_A_BONE = (
    ("PositionX", "PositionX", "meters"),
    ("PositionY", "PositionY", "meters"),
    ("PositionZ", "PositionZ", "meters"),
    ("OrientationX", "OrientationB", "quaternion"),
    ("OrientationY", "OrientationC", "quaternion"),
    ("OrientationZ", "OrientationD", "quaternion"),
    ("OrientationW", "OrientationA", "quaternion"),
    ("Confidence", "Confidence", "normalized"),
)
"""Label's end, XDF's type, unit; XDF calls a quaternion's real part A."""


@dataclass(frozen=True, kw_only=True)
class LslChannel:
    """What is known about one channel; the names are those of XDF."""

    label: str
    object: str
    type: str
    unit: str


def lsl_channels(skeleton: Skeleton) -> tuple[LslChannel, ...]:
    """In the order of a sample: bone by bone."""
    return tuple(
        LslChannel(label=f"{bone}_{end}", object=bone, type=kind, unit=unit)
        for bone in skeleton.bone_names
        for end, kind, unit in _OF_A_BONE
    )


def lsl_sample(pose: PersonPose | None, skeleton: Skeleton) -> Float32[np.ndarray, " c"]:
    """One instant; NaN throughout where the person is not tracked."""
    if pose is None:
        return np.full(len(_OF_A_BONE) * skeleton.bone_count, np.nan, dtype=np.float32)
    return np.concatenate(
        [
            pose.bone_position_in_world_m,
            pose.bone_rotation_in_world_xyzw,
            pose.bone_quality[:, None],
        ],
        axis=1,
        dtype=np.float32,
    ).reshape(-1)


class LslStream:
    """One outlet per person."""

    def __init__(self, target: Target, cast: Cast, rate_hz: float) -> None:
        self.target = target
        self.counts = Counts()
        self._rate_hz = rate_hz
        self._skeletons: dict[str, Skeleton] = {}
        self._outlets: dict[str, LslOutlet] = {}
        _pylsl()
        self.set_cast(cast)

    def send(self, frame: StreamFrame) -> None:
        for name, pose in frame.people.items():
            if name in self._outlets:
                self._outlets[name].send(lsl_sample(pose, self._skeletons[name]))

    def set_cast(self, cast: Cast) -> None:
        """Opens outlets for who is new and closes those of who is gone."""
        for name in [name for name in self._outlets if name not in cast]:
            self._outlets.pop(name).close()
        for name, shape in cast.items():
            if name not in self._outlets:
                self._skeletons[name] = shape.skeleton
                self._outlets[name] = LslOutlet(name, shape.skeleton, self._rate_hz, self.counts)

    def remark(self) -> str:
        if any(outlet.heard for outlet in self._outlets.values()):
            return ""
        return "nobody has subscribed; look for streams of type MoCap"

    def where(self) -> dict[str, str]:
        return {name: f"lsl stream 'fusecap {name}'" for name in self._outlets}

    def close(self) -> None:
        for outlet in self._outlets.values():
            outlet.close()


class LslOutlet:
    """One person's LSL stream; raises `InputError` where the library is missing."""

    def __init__(self, name: str, skeleton: Skeleton, rate_hz: float, counts: Counts) -> None:
        self._counts = counts
        self._lsl = _pylsl()
        channels = lsl_channels(skeleton)
        info = self._lsl.StreamInfo(
            f"fusecap {name}",
            CONTENT_TYPE,
            len(channels),
            rate_hz,
            self._lsl.cf_float32,
            f"fusecap-{name}",
        )
        _describe(info.desc(), channels, name)
        self._outlet = self._lsl.StreamOutlet(info, max_buffered=10)
        self.heard = False

    def send(self, sample: Any) -> None:
        """Push one float32 sample, stamped now."""
        self._outlet.push_sample(sample, self._lsl.local_clock())
        self._counts.sent += 1
        self._counts.bytes += sample.nbytes
        self.heard = self.heard or self._outlet.have_consumers()

    def close(self) -> None:
        del self._outlet


def _describe(description: Any, channels: Iterable[LslChannel], person: str) -> None:
    description.append_child("acquisition").append_child_value("manufacturer", "fusecap")
    setup = description.append_child("setup")
    setup.append_child_value("person", person)
    setup.append_child_value("coordinates", COORDINATES)
    described = description.append_child("channels")
    for channel in channels:
        node = described.append_child("channel")
        for key in ("label", "object", "type", "unit"):
            node.append_child_value(key, getattr(channel, key))


def _pylsl() -> Any:
    try:
        import pylsl
    except ImportError:
        raise InputError(f"--to lsl needs pylsl; {from_extra('lsl')}") from None
    except RuntimeError as error:
        raise InputError(f"--to lsl: the LSL library cannot be loaded ({error})") from error
    return pylsl


PROTOCOL = StreamProtocol(open=LslStream, port=None)
