"""Unreal's JSONLiveLink source: one JSON object per datagram, one array of bones per subject [1].

    {"anna": [{"Name": "pelvis", "Parent": -1, "Location": [x, y, z],
               "Rotation": [x, y, z, w], "Scale": [1, 1, 1]}, ...]}

Locations [cm] and rotations are local to the parent, in Unreal's axes. The receiver takes a
subject's names and parents from the first datagram that has it and never looks at them again, so
everyone is sent on the same 23 bones. It reads bytes as characters: text is ASCII with escapes.

[1] JSONLiveLinkSource.cpp of Epic's sample plugin, `HandleReceivedData`
"""

from __future__ import annotations

import json
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from fusecap.body.rigs import PRESETS
from fusecap.body.skeleton import EXTENDED23
from fusecap.geometry.quaternions import to_xyzw
from fusecap.streams.axes import UNREAL
from fusecap.streams.person_pose import (
    PersonPose,
    StreamFrame,
    in_parents,
)
from fusecap.streams.stream import udp_protocol

MAX_BYTES = 8192
"""Of a datagram with several subjects: macOS sends no more than 9216 unless told to."""

_NAMES = [PRESETS["ue5"].name_at[bone] for bone in EXTENDED23.bone_names]


def livelink_datagrams(frame: StreamFrame, max_bytes: int = MAX_BYTES) -> list[bytes]:
    """Everyone tracked; several subjects share a datagram as far as they fit, none is divided."""
    datagrams: list[str] = []
    for pose in frame.tracked:
        subject = json.dumps({pose.name: _bones(pose.extended)}, separators=(",", ":"))
        if datagrams and len(datagrams[-1]) + len(subject) - 1 <= max_bytes:
            datagrams[-1] = f"{datagrams[-1][:-1]},{subject[1:]}"
        else:
            datagrams.append(subject)
    return [datagram.encode("ascii") for datagram in datagrams]


def _bones(pose: PersonPose) -> list[dict[str, Any]]:
    parents = pose.skeleton.parents
    position_m, rotation = in_parents(
        parents, pose.bone_position_in_world_m, pose.bone_rotation_in_world
    )
    locations_cm = np.round(UNREAL.positions(position_m), 3).tolist()
    quaternions = np.round(to_xyzw(Rotation.from_matrix(UNREAL.rotations(rotation))), 6).tolist()
    return [
        {
            "Name": name,
            "Parent": parent,
            "Location": location,
            "Rotation": quaternion,
            "Scale": [1, 1, 1],
        }
        for name, parent, location, quaternion in zip(
            _NAMES, parents, locations_cm, quaternions, strict=True
        )
    ]


PROTOCOL = udp_protocol(lambda frame, rate_hz: livelink_datagrams(frame), port=54321)
