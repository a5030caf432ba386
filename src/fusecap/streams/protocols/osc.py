"""Our own OSC addresses, for Max, TouchDesigner, Pure Data and whatever else listens to OSC.

    /fusecap/time f                        seconds since the stream began
    /fusecap/<person>/tracked i            1 or 0
    /fusecap/<person>/<bone> ffffffff      x y z [m], quaternion x y z w, quality 0-1

Bones are in the world and in our axes: right-handed, y up. Their messages come only while the
person is tracked. An instant takes several bundles; `time` opens the first.
"""

from __future__ import annotations

from collections.abc import Iterable

from fusecap.streams.osc_packets import bundles, message
from fusecap.streams.person_pose import StreamFrame
from fusecap.streams.stream import udp_protocol


def osc_datagrams(frame: StreamFrame) -> list[bytes]:
    """Everyone, one bundle after the other."""
    messages = [message("/fusecap/time", float(frame.time_s))]
    for address, pose in zip(person_addresses(frame.people), frame.people.values(), strict=True):
        messages.append(message(f"{address}/tracked", int(pose is not None)))
        if pose is None:
            continue
        messages += [
            message(f"{address}/{bone}", *xyz, *xyzw, quality)
            for bone, xyz, xyzw, quality in zip(
                pose.skeleton.bone_names,
                pose.bone_position_in_world_m.tolist(),
                pose.bone_rotation_in_world_xyzw.tolist(),
                pose.bone_quality.tolist(),
                strict=True,
            )
        ]
    return bundles(messages)


def person_addresses(names: Iterable[str]) -> list[str]:
    """`/fusecap/<person>`: ASCII letters, digits, `-` and `_`; repeated ones are numbered."""
    addresses: list[str] = []
    for name in names:
        kept = "".join(c if (c.isascii() and c.isalnum()) or c in "-_" else "_" for c in name)
        address, number = f"/fusecap/{kept}", 1
        while address in addresses:
            number += 1
            address = f"/fusecap/{kept}_{number}"
        addresses.append(address)
    return addresses


PROTOCOL = udp_protocol(lambda frame, rate_hz: osc_datagrams(frame), port=9000)
