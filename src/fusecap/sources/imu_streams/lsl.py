"""Which channels of a Lab Streaming Layer stream make up a sensor, by their labels.

A label ends in what the channel holds, before that stands the sensor's name:

    orientation   qw qx qy qz | quat_w.. | quaternion_w.. | orientation_w.. (any order)
    acceleration  ax ay az | acc_x.. | accel_x.. | acceleration_x..

as in `left_forearm_qw` or `LeftForeArm_OrientationW`; case, spaces, `_`, `.`, `-` and `/` do not
matter. Without labels a stream of 4 or 7 channels is qw qx qy qz [ax ay az]. Acceleration is
specific force in the sensor's frame, in m/s2 unless the channel's unit says g.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from fusecap.errors import InputError, nearest
from fusecap.sources.live_address import wrong_address
from fusecap.sources.live_sensor import (
    SensorAddress,
    SensorProtocol,
    SensorSample,
    checked_accel,
    checked_orientation,
)
from fusecap.types import GRAVITY_M_S2

MAX_CHANNELS = 4096
_ORIENTATION = re.compile(r"(?:q|quat|quaternion|orientation)([wxyz])$")
_ACCELERATION = re.compile(r"(?:a|acc|accel|acceleration)([xyz])$")


@dataclass(frozen=True, slots=True, kw_only=True)
class SensorChannels:
    """Where a sensor's numbers stand in a sample of its stream."""

    sensor: str
    orientation_wxyz: tuple[int, int, int, int]
    accel: tuple[int, int, int] | None
    accel_unit_m_s2: float = 1.0

    def sample(self, values: Sequence[float], stamp_ns: int) -> SensorSample:
        """Raises `Refused` for numbers that are no sample."""
        accel = np.full(3, np.nan)
        if self.accel is not None:
            accel = checked_accel([values[i] * self.accel_unit_m_s2 for i in self.accel])
        return SensorSample(
            sensor=self.sensor,
            stamp_ns=stamp_ns,
            orientation_wxyz=checked_orientation([values[i] for i in self.orientation_wxyz]),
            accel_m_s2=accel,
        )


def sensor_channels(
    stream: str, labels: Sequence[str], units: Sequence[str], sensor: str
) -> SensorChannels:
    """The channels of `sensor` (empty: the only one); raises `InputError` that names what is there.

    `labels` and `units` are empty texts where the stream says nothing.
    """
    if len(labels) > MAX_CHANNELS:
        raise InputError(f"lsl:{stream}: {len(labels)} channels, expected at most {MAX_CHANNELS}")
    if not any(labels):
        if sensor or len(labels) not in (4, 7):
            raise InputError(
                f"lsl:{stream}: {len(labels)} channels without labels; expected 4 or 7 (qw qx qy "
                "qz ax ay az), or labels such as 'left_forearm_qw'"
            )
        labels = ["qw", "qx", "qy", "qz", "ax", "ay", "az"][: len(labels)]
    found: dict[str, dict[str, int]] = {}
    shown: dict[str, str] = {}
    for index, label in enumerate(labels):
        plain = _plain(label)
        for kind, pattern in (("q", _ORIENTATION), ("a", _ACCELERATION)):
            match = pattern.search(plain)
            if match is not None:
                owner = plain[: match.start()]
                found.setdefault(owner, {}).setdefault(kind + match[1], index)
                shown.setdefault(owner, label)
    whole = {name: at for name, at in found.items() if all(f"q{axis}" in at for axis in "wxyz")}
    wanted = _plain(sensor) if sensor else next(iter(whole), "")
    if wanted not in whole or (not sensor and len(whole) > 1):
        which = f"no sensor '{sensor}'" if sensor else f"{len(whole)} sensors"
        hint = nearest(wanted, whole) if whole else "; no four channels make up a quaternion"
        raise InputError(
            f"lsl:{stream}: {which} among its {len(labels)} channels{hint}; write "
            f'live = "lsl:{stream}/SENSOR" with the part of the labels before _qw'
        )
    at = whole[wanted]
    accel = None
    unit = 1.0
    if all(f"a{axis}" in at for axis in "xyz"):
        accel = (at["ax"], at["ay"], at["az"])
        unit = GRAVITY_M_S2 if units and units[at["ax"]].strip().lower() == "g" else 1.0
    return SensorChannels(
        sensor=sensor or shown[wanted],
        orientation_wxyz=(at["qw"], at["qx"], at["qy"], at["qz"]),
        accel=accel,
        accel_unit_m_s2=unit,
    )


def _plain(text: str) -> str:
    return re.sub(r"[\s_.\-/]", "", text).lower()


def _address(text: str) -> SensorAddress:
    stream, _, sensor = text.partition(":")[2].partition("/")
    if not stream or {"'", '"'} & set(stream):
        raise wrong_address(
            text, "expected a stream's name, without quotes", 'live = "lsl:imus/left_forearm"'
        )
    return SensorAddress(protocol="lsl", stream=stream, sensor=sensor)


PROTOCOL = SensorProtocol(parse=_address)
