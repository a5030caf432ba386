"""OSIM: the person as an OpenSim 4 model, scaled by construction: bodies, joints and markers.

Its coordinates are those of `mot`, its markers those of `trc`, so inverse kinematics runs as it is.
It has no muscles, and every body weighs a kilogram: forces need a model of your own.
"""

from __future__ import annotations

from pathlib import Path
from xml.etree import ElementTree as xml

import numpy as np

from fusecap.body.shape import shape_with_clavicles
from fusecap.exports.opensim import (
    OPENSIM_FROM_OURS,
    TRANSLATIONS,
    Coordinate,
    coordinates,
    opensim_markers,
    opensim_preset,
)
from fusecap.exports.rest_rig import rest_rig
from fusecap.exports.take_format import AnyTake, ExportOptions, TakeFormat
from fusecap.files import safe_name, write_whole

_AXES = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))


def write_osim(take: AnyTake, path: Path, _: ExportOptions) -> None:
    """Writes the one subject of `take`, whole or not at all."""
    shape = take.shape(0)
    rest = rest_rig(opensim_preset(take), shape_with_clavicles(shape))
    document = xml.Element("OpenSimDocument", Version="40000")
    model = xml.SubElement(document, "Model", name=safe_name(take.subject_names[0]))
    xml.SubElement(model, "Ground", name="ground")
    bodies = _objects(model, "BodySet", "bodyset")
    joints = _objects(model, "JointSet", "jointset")
    markers = _objects(model, "MarkerSet", "markerset")
    for index, (body, parent) in enumerate(zip(rest.names, rest.parents, strict=True)):
        _add_body(bodies, body)
        above = "/ground" if parent < 0 else f"/bodyset/{rest.names[parent]}"
        place = np.zeros(3) if parent < 0 else rest.position_in_parent_m[index]
        _add_joint(joints, body, above, OPENSIM_FROM_OURS @ place, root=parent < 0)
    for marker in opensim_markers(shape, rest):
        element = xml.SubElement(markers, "Marker", name=marker.name)
        _text(element, "socket_parent_frame", f"/bodyset/{marker.body}")
        _text(element, "location", _vector(marker.location_m))
        _text(element, "fixed", "true")
    xml.indent(document, "\t")
    write_whole(path, xml.tostring(document, encoding="utf-8", xml_declaration=True) + b"\n")


def _add_body(bodies: xml.Element, body: str) -> None:
    element = xml.SubElement(bodies, "Body", name=body)
    _text(element, "mass", "1")
    _text(element, "mass_center", "0 0 0")
    _text(element, "inertia", "0.01 0.01 0.01 0 0 0")


def _add_joint(
    joints: xml.Element, body: str, above: str, place_m: np.ndarray, *, root: bool
) -> None:
    joint = xml.SubElement(joints, "CustomJoint", name=f"{body}_joint")
    _text(joint, "socket_parent_frame", "parent_offset")
    _text(joint, "socket_child_frame", "child_offset")
    turns = coordinates(body)
    group = xml.SubElement(joint, "coordinates")
    for turn in turns:
        coordinate = xml.SubElement(group, "Coordinate", name=turn.name)
        _text(coordinate, "range", "-7 7")
        _text(coordinate, "clamped", "false")
    for name in TRANSLATIONS if root else ():
        coordinate = xml.SubElement(group, "Coordinate", name=name)
        _text(coordinate, "range", "-100 100")
        _text(coordinate, "clamped", "false")
    frames = xml.SubElement(joint, "frames")
    for name, owner, at in (
        ("parent_offset", above, place_m),
        ("child_offset", f"/bodyset/{body}", np.zeros(3)),
    ):
        frame = xml.SubElement(frames, "PhysicalOffsetFrame", name=name)
        _text(frame, "socket_parent", owner)
        _text(frame, "translation", _vector(at))
        _text(frame, "orientation", "0 0 0")
    transform = xml.SubElement(joint, "SpatialTransform")
    for number, turn in enumerate(turns, start=1):
        _add_axis(transform, f"rotation{number}", turn)
    for number, axis in enumerate(_AXES, start=1):
        moved = Coordinate(name=TRANSLATIONS[number - 1], axis=axis) if root else None
        _add_axis(transform, f"translation{number}", moved, axis)


def _add_axis(
    transform: xml.Element,
    name: str,
    coordinate: Coordinate | None,
    axis: tuple[float, float, float] = (0.0, 0.0, 0.0),
) -> None:
    element = xml.SubElement(transform, "TransformAxis", name=name)
    if coordinate is None:
        _text(element, "axis", _vector(np.array(axis)))
        constant = xml.SubElement(element, "Constant", name="function")
        _text(constant, "value", "0")
        return
    _text(element, "coordinates", coordinate.name)
    _text(element, "axis", _vector(np.array(coordinate.axis)))
    linear = xml.SubElement(element, "LinearFunction", name="function")
    _text(linear, "coefficients", "1 0")


def _objects(model: xml.Element, kind: str, name: str) -> xml.Element:
    return xml.SubElement(xml.SubElement(model, kind, name=name), "objects")


def _text(parent: xml.Element, tag: str, text: str) -> None:
    xml.SubElement(parent, tag).text = text


def _vector(xyz: np.ndarray) -> str:
    return " ".join(f"{value:.6f}" for value in xyz)


FORMAT = TakeFormat(suffix=".osim", write=write_osim, per_person=True)
