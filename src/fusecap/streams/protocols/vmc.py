"""Virtual Motion Capture protocol 3.1, as a performer sends it to a marionette [1].

    /VMC/Ext/T f            /VMC/Ext/OK i i i i       /VMC/Ext/Root/Pos s fff ffff
    /VMC/Ext/Bone/Pos s fff ffff      local to the parent, metres, quaternion xyzw, Unity's axes

The stream of a port is one avatar. The root stands at the world's origin; the hips carry the
person through the room. Bones have the names of Unity's `HumanBodyBones`. Unity's spine has three
bones and ours four: the second (`spine1`) is left out of the tree, so that `Chest` turns as spine1
and spine2 do together and everything above keeps its place in the world.

[1] https://protocol.vmc.info, marionette specification
"""

from __future__ import annotations

from scipy.spatial.transform import Rotation

from fusecap.body.rigs import PRESETS
from fusecap.body.skeleton import EXTENDED23
from fusecap.errors import InputError
from fusecap.geometry.quaternions import to_xyzw
from fusecap.streams.axes import UNITY
from fusecap.streams.osc_packets import bundles, message
from fusecap.streams.person_pose import PersonPose, StreamFrame, in_parents
from fusecap.streams.stream import Cast, StreamProtocol, udp_remark
from fusecap.streams.target import Target
from fusecap.streams.transports import Counts, UdpSender

PORT_STEP = 10
"""From one person's port to the next one's."""

_LOADED, _CALIBRATED, _NORMAL_MODE = 1, 3, 0

_JOINTS = PRESETS["unity"].joints
_NAMES = tuple(joint.name for joint in _JOINTS)
_BONES = [EXTENDED23.bone(joint.sits_at) for joint in _JOINTS]
_PARENTS = tuple(_NAMES.index(joint.parent) if joint.parent else -1 for joint in _JOINTS)


def vmc_datagrams(pose: PersonPose | None, time_s: float) -> list[bytes]:
    """One instant of one person; without a pose only that it is not tracked."""
    tracking = int(pose is not None)
    messages = [
        message("/VMC/Ext/T", float(time_s)),
        message("/VMC/Ext/OK", _LOADED, _CALIBRATED, _NORMAL_MODE, tracking),
    ]
    if pose is not None:
        messages.append(message("/VMC/Ext/Root/Pos", "root", 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0))
        messages += _bones(pose.extended)
    return bundles(messages)


def _bones(pose: PersonPose) -> list[bytes]:
    position_m, rotation = in_parents(
        _PARENTS, pose.bone_position_in_world_m[_BONES], pose.bone_rotation_in_world[_BONES]
    )
    positions = UNITY.positions(position_m).tolist()
    quaternions = to_xyzw(Rotation.from_matrix(UNITY.rotations(rotation))).tolist()
    return [
        message("/VMC/Ext/Bone/Pos", name, *xyz, *xyzw)
        for name, xyz, xyzw in zip(_NAMES, positions, quaternions, strict=True)
    ]


class VmcStream:
    """Each person to a port of their own; who comes later gets the first that is free."""

    def __init__(self, target: Target, cast: Cast) -> None:
        self.target = target
        self.counts = Counts()
        self._ports: dict[str, int] = {}
        self._senders: dict[str, UdpSender] = {}
        self.set_cast(cast)

    def send(self, frame: StreamFrame) -> None:
        for name, pose in frame.people.items():
            if name in self._senders:
                for datagram in vmc_datagrams(pose, frame.time_s):
                    self._senders[name].send(datagram)

    def set_cast(self, cast: Cast) -> None:
        """Opens ports for who is new and closes those of who is gone."""
        last = self.target.port + PORT_STEP * (len(cast) - 1)
        if last > 65535:
            raise InputError(
                f"{self.target}: {len(cast)} people need ports up to {last}; choose a lower one"
            )
        for name in [name for name in self._ports if name not in cast]:
            del self._ports[name]
            self._senders.pop(name).close()
        usable = range(self.target.port, last + 1, PORT_STEP)
        for name in cast:
            if name not in self._ports:
                port = next(port for port in usable if port not in self._ports.values())
                self._senders[name] = UdpSender(self.target.host, port, self.counts)
                self._ports[name] = port

    def remark(self) -> str:
        return udp_remark(self.counts)

    def where(self) -> dict[str, str]:
        return {
            name: str(Target(protocol="vmc", host=self.target.host, port=port))
            for name, port in self._ports.items()
        }

    def close(self) -> None:
        for sender in self._senders.values():
            sender.close()


PROTOCOL = StreamProtocol(open=lambda target, cast, rate_hz: VmcStream(target, cast), port=39539)
