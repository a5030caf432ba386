"""Motion in FBX, which Blender writes: of people and of characters.

Blender's exporter looks at every joint in every frame, 11 s for a minute of two people. So it is
given what stands at rest, and our curves take the place of its in the file. Its joints lie along
bones where ours need not, but what turns one from its rest is the same in any axes:

    in_file(t) = above(t)ᵀ turned(t) in_file(rest)      turned(t) = in_world(t) in_world(rest)ᵀ

Nodes have labels on their way through Blender, which shortens long names and numbers equal ones.
"""

from __future__ import annotations

import re
import tempfile
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from fusecap.errors import InputError
from fusecap.exports.blender import fbx_from_glb
from fusecap.exports.euler import euler_rad
from fusecap.exports.fbx_tree import FbxElement, FbxFile, array_property, text_property
from fusecap.exports.gltf import Gltf
from fusecap.files import written_whole

_TICKS_PER_S = 46_186_158_000
_BAKED_STEP = 100
"""The most frames that Blender's exporter steps over; what it finds there is replaced."""
_CM_PER_M = 100.0
_STILL = 1e-6
"""Centimetres and degrees: a curve that moves less has two keys."""
_LABELLED = ("nodes", "meshes", "skins", "materials")


@dataclass(frozen=True, slots=True, kw_only=True)
class NodeMotion:
    """What a node does in the world over T frames."""

    rest: Float[np.ndarray, "3 3"]
    turn: Rotation
    """T of them."""
    place_m: Float[np.ndarray, "t 3"] | None = None
    """None: where it is in its parent at rest."""


def write_fbx(
    still: Gltf,
    moves: Mapping[int, NodeMotion],
    path: Path,
    *,
    time_s: Float[np.ndarray, " t"],
    rate_hz: float,
) -> None:
    """Writes a document, that stands at rest, with these nodes in motion; whole or not at all.

    Raises `InputError` without Blender, or where it leaves a node out, or one without curves.
    """
    names = _labelled(still.tree)
    with tempfile.TemporaryDirectory() as folder:
        glb, base = Path(folder) / "still.glb", Path(folder) / "still.fbx"
        still.write(glb)
        fbx_from_glb(glb, base, rate_hz=rate_hz, frames=len(time_s), step=_BAKED_STEP)
        file = FbxFile.read(base.read_bytes())
    labelled = {_label("nodes", node): move for node, move in moves.items()}
    lost = labelled.keys() - _Scene(file, time_s).move(labelled)
    if lost:
        told = ", ".join(names[label] for label in sorted(lost))
        raise InputError(f"Blender leaves {told} out of the FBX file: write .glb instead")
    _rename(file, names)
    with written_whole(path) as target:
        target.writelines(file.pieces())


def _label(kind: str, index: int) -> str:
    return f"fusecap-{kind}-{index}"


def _labelled(tree: dict[str, Any]) -> dict[str, str]:
    """Names by the labels that a document's items have from now on."""
    names = {}
    for kind in _LABELLED:
        for index, item in enumerate(tree.get(kind, ())):
            label = _label(kind, index)
            names[label] = str(item.get("name", f"{kind} {index}"))
            item["name"] = label
    return names


@dataclass(frozen=True, slots=True, kw_only=True)
class _Placed:
    """A model in the world of the file over T frames."""

    place_cm: Float[np.ndarray, "t 3"]
    turn: Rotation
    rest: Rotation
    scale: float


class _Scene:
    """Models of a file, their curves, and where they are."""

    def __init__(self, file: FbxFile, time_s: Float[np.ndarray, " t"]) -> None:
        objects = file.named(b"Objects").children
        self._objects = {each.whole(0): each for each in objects}
        self._below: dict[int, list[tuple[int, bytes]]] = {}
        """Per object what is connected to it, and to which of its properties."""
        for line in file.named(b"Connections").children:
            to = line.text(3) if len(line.properties) > 3 else b""
            self._below.setdefault(line.whole(2), []).append((line.whole(1), to))
        ticks = np.round(time_s * _TICKS_PER_S).astype(np.int64)
        self._frames = len(ticks)
        self._ticks = array_property(ticks)
        self._first_and_last = array_property(np.unique(ticks[[0, -1]]))

    def move(self, moves: Mapping[str, NodeMotion]) -> set[str]:
        """Models whose names are keys get these motions; the names of those that do."""
        nothing = np.zeros((self._frames, 3))
        still = Rotation.identity(self._frames)
        world = _Placed(place_cm=nothing, turn=still, rest=Rotation.identity(), scale=1.0)
        return self._move_below(0, world, moves)

    def _move_below(
        self, identity: int, above: _Placed, moves: Mapping[str, NodeMotion]
    ) -> set[str]:
        found: set[str] = set()
        for child, _ in self._below.get(identity, ()):
            model = self._objects[child]
            if model.name != b"Model":
                continue
            move = moves.get(_name(model))
            if move is not None and self._has_curves(model, move):
                found.add(_name(model))
            found |= self._move_below(child, self._placed(model, above, move), moves)
        return found

    def _placed(self, model: FbxElement, above: _Placed, move: NodeMotion | None) -> _Placed:
        """Where a model is; of one that moves the curves are set."""
        place = self._at_rest(model, b"Lcl Translation", 0.0)
        local = Rotation.from_euler("xyz", self._at_rest(model, b"Lcl Rotation", 0.0), degrees=True)
        scale = above.scale * float(self._at_rest(model, b"Lcl Scaling", 1.0)[0])
        rest = above.rest * local
        place_cm = above.place_cm + above.scale * above.turn.apply(place)
        turn = above.turn * local
        if move is not None:
            turn = move.turn * (Rotation.from_matrix(move.rest).inv() * rest)
            inside = (above.turn.inv() * turn).as_matrix()
            degrees = np.degrees(euler_rad(inside, "ZYX"))[:, ::-1]
            self._set_curves(model, b"Lcl Rotation", degrees)
            if move.place_m is not None:
                place_cm = _CM_PER_M * move.place_m
                inside = above.turn.inv().apply(place_cm - above.place_cm) / above.scale
                self._set_curves(model, b"Lcl Translation", inside)
        return _Placed(place_cm=place_cm, turn=turn, rest=rest, scale=scale)

    def _has_curves(self, model: FbxElement, move: NodeMotion) -> bool:
        moved = [b"Lcl Rotation"] + [b"Lcl Translation"] * (move.place_m is not None)
        return all({axis for axis, _ in self._curves(model, what)} == {0, 1, 2} for what in moved)

    def _curves(self, model: FbxElement, what: bytes) -> Iterator[tuple[int, FbxElement]]:
        """Of one of a model's properties, with its axis."""
        for node, to in self._below.get(model.whole(0), ()):
            if to == what:
                for identity, component in self._below.get(node, ()):
                    yield b"XYZ".index(component[-1:]), self._objects[identity]

    def _at_rest(self, model: FbxElement, what: bytes, usual: float) -> Float[np.ndarray, "3"]:
        """What the file's own curves begin with, else the property itself."""
        lines = model.child(b"Properties70").children
        line = next((each for each in lines if each.text(0) == what), None)
        value = [usual] * 3 if line is None else [line.number(index) for index in (4, 5, 6)]
        for axis, curve in self._curves(model, what):
            value[axis] = float(curve.child(b"KeyValueFloat").numbers(0)[0])
        return np.array(value)

    def _set_curves(self, model: FbxElement, what: bytes, values: Float[np.ndarray, "t 3"]) -> None:
        still = np.ptp(values, axis=0).max() < _STILL
        kept = values[np.unique([0, len(values) - 1])] if still else values
        for axis, curve in self._curves(model, what):
            count = np.array([len(kept)], dtype=np.int32)
            times = self._first_and_last if still else self._ticks
            curve.child(b"KeyTime").properties = [times]
            curve.child(b"KeyValueFloat").properties = [
                array_property(kept[:, axis].astype(np.float32))
            ]
            curve.child(b"KeyAttrRefCount").properties = [array_property(count)]


def _name(element: FbxElement) -> str:
    return element.text(1).partition(b"\0\1")[0].decode(errors="replace")


def _rename(file: FbxFile, names: Mapping[str, str]) -> None:
    """Whatever has a label in its name gets the name in the label's place."""
    labels = re.compile(rb"fusecap-[a-z]+-\d+")
    known = {label.encode(): name.encode() for label, name in names.items()}

    def walk(elements: list[FbxElement]) -> Iterator[FbxElement]:
        for each in elements:
            yield each
            yield from walk(each.children)

    for element in walk(file.elements):
        for index, value in enumerate(element.properties):
            if value[:1] == b"S" and b"fusecap-" in value:
                whole = labels.sub(lambda found: known.get(found[0], found[0]), value[5:])
                element.properties[index] = text_property(whole)
