"""FBX, which Blender writes from our GLB: for Unreal, Unity, MotionBuilder, Maya.

Blender's exporter looks at every joint in every frame, 11 s for a minute of two people. So it is
given people who stand at rest, and our curves take the place of theirs in its file.
Its joints lie along bones where ours need not: what turns the one into the other,

    in_file = from_oursᵀ(parent) in_ours from_ours(joint)

is read from the file at rest.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from fusecap.exports.blender import blender_command, fbx_from_glb
from fusecap.exports.euler import euler_rad
from fusecap.exports.fbx_tree import FbxElement, FbxFile, array_property, text_property
from fusecap.exports.formats.glb import write_people
from fusecap.exports.rig_motion import RigMotion, rig_motions
from fusecap.exports.take_format import ExportOptions, TakeFormat
from fusecap.files import written_whole
from fusecap.take import Take

_TICKS_PER_S = 46_186_158_000
_BAKED_STEP = 100
"""The most frames that Blender's exporter steps over; what it finds there is replaced."""
_Z_UP_FROM_Y_UP = Rotation.from_rotvec([np.pi / 2, 0.0, 0.0])
_STILL = 1e-6
"""Metres and degrees: a curve that moves less has two keys."""


def write_fbx(take: Take, path: Path, options: ExportOptions) -> None:
    """Writes everybody who is tracked, whole or not at all; raises `InputError` without Blender."""
    motions = rig_motions(take, options.rig)
    # Names that Blender does not shorten or number; the file gets people's own.
    labels = [f"person{row}" for row in range(len(motions))]
    with tempfile.TemporaryDirectory() as folder:
        still, base = Path(folder) / "people.glb", Path(folder) / "people.fbx"
        labelled = [replace(m, name=label) for m, label in zip(motions, labels, strict=True)]
        write_people(labelled, still, animated=False)
        frames = len(take.timestamps_ns)
        fbx_from_glb(still, base, rate_hz=take.rate_hz, frames=frames, step=_BAKED_STEP)
        file = FbxFile.read(base.read_bytes())
    scene = _Scene(file)
    ticks = np.round(motions[0].time_s * _TICKS_PER_S).astype(np.int64)
    times = _Times(every=array_property(ticks), ends=array_property(np.unique(ticks[[0, -1]])))
    for motion, label in zip(motions, labels, strict=True):
        joints = scene.joints_of(label)
        for joint, (places, degrees) in _curves(motion, joints).items():
            scene.set_curves(joints[joint], b"Lcl Translation", times, places)
            scene.set_curves(joints[joint], b"Lcl Rotation", times, degrees)
            scene.set_curves(joints[joint], b"Lcl Scaling", times, np.ones((len(ticks), 3)))
    _rename(file, {a.encode(): m.name.encode() for a, m in zip(labels, motions, strict=True)})
    with written_whole(path) as target:
        target.writelines(file.pieces())


@dataclass(frozen=True, slots=True, kw_only=True)
class _Times:
    """Of a curve with a key in every frame, and of one that stays; as properties."""

    every: bytes
    ends: bytes


class _Scene:
    """Objects of a file by what they are connected to."""

    def __init__(self, file: FbxFile) -> None:
        objects = file.named(b"Objects").children
        self._objects = {each.whole(0): each for each in objects}
        self._below: dict[int, list[tuple[int, bytes]]] = {}
        """Per object what is connected to it, and to which of its properties."""
        for line in file.named(b"Connections").children:
            to = line.text(3) if len(line.properties) > 3 else b""
            self._below.setdefault(line.whole(2), []).append((line.whole(1), to))

    def joints_of(self, person: str) -> dict[str, FbxElement]:
        """Models below the one of that name, by names."""
        models = (each for each in self._objects.values() if each.name == b"Model")
        ahead = [next(m for m in models if _name(m) == person and m.text(2) == b"Null")]
        found: dict[str, FbxElement] = {}
        while ahead:
            for identity, _ in self._below.get(ahead.pop().whole(0), ()):
                model = self._objects[identity]
                if model.name == b"Model" and model.text(2) == b"LimbNode":
                    found[_name(model)] = model
                    ahead.append(model)
        return found

    def set_curves(
        self, model: FbxElement, what: bytes, times: _Times, values: Float[np.ndarray, "t 3"]
    ) -> None:
        """The curves of one of a model's properties get these values."""
        still = np.ptp(values, axis=0).max() < _STILL
        kept = values[np.unique([0, len(values) - 1])] if still else values
        for node, to in self._below[model.whole(0)]:
            if to != what:
                continue
            for identity, component in self._below[node]:
                curve = self._objects[identity]
                column = kept[:, b"XYZ".index(component[-1:])].astype(np.float32)
                count = np.array([len(column)], dtype=np.int32)
                curve.child(b"KeyTime").properties = [times.ends if still else times.every]
                curve.child(b"KeyValueFloat").properties = [array_property(column)]
                curve.child(b"KeyAttrRefCount").properties = [array_property(count)]


def _curves(
    motion: RigMotion, joints: Mapping[str, FbxElement]
) -> dict[str, tuple[Float[np.ndarray, "t 3"], Float[np.ndarray, "t 3"]]]:
    """Places [m] and angles [deg] of joints as the file wants them."""
    rest, found = motion.rest, {}
    of_file: list[Rotation] = []
    from_ours: list[Rotation] = []
    for joint, (name, parent) in enumerate(zip(rest.names, rest.parents, strict=True)):
        local = Rotation.from_euler("xyz", _lcl(joints[name], b"Lcl Rotation"), degrees=True)
        of_file.append(of_file[parent] * local if parent >= 0 else local)
        ours = _Z_UP_FROM_Y_UP * Rotation.from_matrix(rest.rotation[joint])
        from_ours.append(ours.inv() * of_file[joint])
        above = from_ours[parent].inv() if parent >= 0 else _Z_UP_FROM_Y_UP
        turns = above * Rotation.from_quat(motion.rotation_xyzw[:, joint]) * from_ours[joint]
        angles = np.degrees(euler_rad(turns.as_matrix(), "ZYX"))[:, ::-1]
        found[name] = above.apply(motion.position_m[:, joint]), angles
    return found


def _lcl(model: FbxElement, what: bytes) -> list[float]:
    lines = model.child(b"Properties70").children
    line = next((each for each in lines if each.text(0) == what), None)
    return [0.0] * 3 if line is None else [line.number(index) for index in (4, 5, 6)]


def _name(element: FbxElement) -> str:
    return element.text(1).partition(b"\0\1")[0].decode()


def _rename(file: FbxFile, names: Mapping[bytes, bytes]) -> None:
    """Objects called by a label, or by one and a word more, get the name in its place."""

    def walk(elements: list[FbxElement]) -> Iterator[FbxElement]:
        for each in elements:
            yield each
            yield from walk(each.children)

    for element in walk(file.elements):
        for index, value in enumerate(element.properties):
            if value[:1] == b"S":
                label, space, more = value[5:].partition(b" ")
                bare, mark, kind = label.partition(b"\0\1")
                if bare in names:
                    whole = names[bare] + mark + kind + space + more
                    element.properties[index] = text_property(whole)


FORMAT = TakeFormat(
    suffix=".fbx",
    write=write_fbx,
    per_person=False,
    has_rig=True,
    holds=True,
    check_needs=blender_command,
)
