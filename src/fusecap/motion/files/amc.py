"""Acclaim motion: an ASF skeleton and AMC takes that refer to it.

A bone turns about its own axes: with C the bone's axis frame and M the rotation of its degrees of
freedom, both as rotations about fixed x, then y, then z, a bone's rotation local to its parent is
C M Cᵀ. Angles are degrees, lengths the CMU unit divided by the skeleton's own `length` field.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import PurePath

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from fusecap.errors import InputError
from fusecap.motion.motion import Motion, chain_rotations, numbers
from fusecap.motion.motion_format import MotionFormat

CMU_RATE_HZ = 120.0
"""AMC carries no rate; the CMU database is captured at 120 Hz."""

_ROOT_CHANNELS = ("tx", "ty", "tz", "rx", "ry", "rz")
_INCH_M = 0.0254


@dataclass(frozen=True, kw_only=True)
class AsfSkeleton:
    """The bones of an ASF file, the root first."""

    name: str
    joint_names: tuple[str, ...]
    parents: tuple[int, ...]
    bone_vector_m: Float[np.ndarray, "j 3"]
    axis: Float[np.ndarray, "j 3 3"]
    """C above."""
    channels: tuple[tuple[str, ...], ...]
    """Per bone the degrees of freedom in the order of its AMC line, e.g. ('rx', 'rz')."""
    unit_m: float


def parse_asf(text: str, name: str) -> AsfSkeleton:
    """An ASF skeleton; raises `InputError` where a section or field is missing or broken."""
    sections = _sections(text)
    for section in ("units", "root", "bonedata", "hierarchy"):
        if section not in sections:
            raise InputError(f"{name}: no ':{section}' section; expected an ASF skeleton")
    units = {line[0]: line[1] for line in sections["units"] if len(line) > 1}
    if units.get("angle", "deg") != "deg":
        raise InputError(f"{name}: angles are in '{units['angle']}'; only 'deg' is read")
    length = numbers([units.get("length", "1.0")], f"{name}, length unit")[0]
    if length <= 0:
        raise InputError(f"{name}: the length unit is {length:g}; it must be positive")
    unit_m = _INCH_M / length

    root = {line[0].lower(): line[1:] for line in sections["root"]}
    root_channels = tuple(channel.lower() for channel in root.get("order", ()))
    if sorted(root_channels) != sorted(_ROOT_CHANNELS):
        raise InputError(
            f"{name}: the root's order is '{' '.join(root_channels)}'; "
            "expected TX TY TZ RX RY RZ in some order"
        )
    bones = _bones(sections["bonedata"], name)
    parent_of = _hierarchy(sections["hierarchy"], name)
    order = ["root", *(bone for bone in parent_of if bone in bones)]
    if len(order) != len(bones) + 1 or len(parent_of) != len(bones):
        missing = sorted(set(bones) ^ set(parent_of))
        raise InputError(f"{name}: bones without data or parent: {', '.join(missing)}")
    parents = [-1]
    for joint, bone in enumerate(order[1:], start=1):
        if parent_of[bone] not in order[:joint]:
            raise InputError(f"{name}: '{bone}' hangs on '{parent_of[bone]}', listed after it")
        parents.append(order.index(parent_of[bone]))
    return AsfSkeleton(
        name=name,
        joint_names=tuple(order),
        parents=tuple(parents),
        bone_vector_m=np.array([np.zeros(3), *(bones[b].vector * unit_m for b in order[1:])]),
        axis=np.array([np.eye(3), *(bones[b].axis for b in order[1:])]),
        channels=(root_channels, *(bones[b].channels for b in order[1:])),
        unit_m=unit_m,
    )


def parse_amc(text: str, skeleton: AsfSkeleton, name: str) -> Motion:
    """A take of `skeleton` at 120 Hz; raises `InputError` naming the frame that is broken."""
    lines = [line for line in text.split("\n") if line.strip() and line.lstrip()[0] not in "#:"]
    tokens = " ".join(lines).split()
    starts = [i for i, line in enumerate(lines[:200]) if len(line.split()) == 1]
    if not starts or starts[0] != 0:
        raise InputError(f"{name}: no frame found; expected a frame number, then one line per bone")
    second = starts[1] if len(starts) > 1 else len(lines)
    layout = [line.split() for line in lines[1:second]]
    columns = _columns(layout, skeleton, name)

    stride = 1 + sum(len(line) for line in layout)
    frames, rest = divmod(len(tokens), stride)
    table = np.array(tokens[: frames * stride], dtype=object).reshape(frames, stride)
    label_columns = np.cumsum([1, *(len(line) for line in layout)])[:-1]
    regular = np.all(table[:, label_columns] == table[0, label_columns], axis=1)
    if not regular.all():
        raise InputError(
            f"{name}: frame {int(np.argmin(regular)) + 1} does not list the bones of the first one"
        )
    if rest:
        raise InputError(f"{name}: the file ends in the middle of frame {frames + 1}")
    value_columns = np.setdiff1d(np.arange(1, stride), label_columns)
    try:
        values = table[:, value_columns].astype(np.float64)
    except ValueError as error:
        raise InputError(f"{name}: {error}") from None
    if not np.all(np.isfinite(values)):
        raise InputError(f"{name}: a value is not a finite number")

    position = np.zeros((frames, 3))
    local = np.empty((frames, len(skeleton.joint_names), 3, 3))
    for joint, channels in enumerate(skeleton.channels):
        angles = np.zeros((frames, 3))
        for column, channel in zip(columns[joint], channels, strict=True):
            axis = "xyz".index(channel[1])
            if channel[0] == "t":
                position[:, axis] = values[:, column] * skeleton.unit_m
            else:
                angles[:, axis] = values[:, column]
        turn = Rotation.from_euler("xyz", angles, degrees=True).as_matrix()
        local[:, joint] = skeleton.axis[joint] @ turn @ skeleton.axis[joint].T
    return Motion(
        name=name,
        joint_names=skeleton.joint_names,
        parents=skeleton.parents,
        bone_vector_m=skeleton.bone_vector_m,
        root_position_m=position,
        rotation_in_world=chain_rotations(skeleton.parents, local),
        rate_hz=CMU_RATE_HZ,
    )


@dataclass(frozen=True, kw_only=True)
class _Bone:
    vector: Float[np.ndarray, "3"]
    """In the file's unit."""
    axis: Float[np.ndarray, "3 3"]
    channels: tuple[str, ...]


def _sections(text: str) -> dict[str, list[list[str]]]:
    """Lines as words under each ':section', comments dropped."""
    sections: dict[str, list[list[str]]] = {}
    current: list[list[str]] = []
    for line in text.split("\n"):
        words = line.split("#")[0].split()
        if words and words[0].startswith(":"):
            current = sections.setdefault(words[0][1:].lower(), [])
        elif words:
            current.append(words)
    return sections


def _bones(lines: Sequence[list[str]], name: str) -> dict[str, _Bone]:
    bones: dict[str, _Bone] = {}
    fields: dict[str, list[str]] = {}
    for words in lines:
        if words[0] == "begin":
            fields = {}
        elif words[0] == "end":
            bone, built = _bone(fields, name)
            bones[bone] = built
        else:
            fields[words[0]] = words[1:]
    if not bones:
        raise InputError(f"{name}: ':bonedata' holds no bone")
    return bones


def _bone(fields: dict[str, list[str]], name: str) -> tuple[str, _Bone]:
    bone = "".join(fields.get("name", ["(unnamed)"]))
    for field, size in (("direction", 3), ("length", 1), ("axis", 4)):
        if len(fields.get(field, ())) != size:
            raise InputError(f"{name}: bone '{bone}' has no complete '{field}'")
    direction = np.array(numbers(fields["direction"], f"{name}, bone '{bone}', direction"))
    length = numbers(fields["length"], f"{name}, bone '{bone}', length")[0]
    angles = numbers(fields["axis"][:3], f"{name}, bone '{bone}', axis")
    if fields["axis"][3].upper() != "XYZ":
        raise InputError(f"{name}: bone '{bone}' has axis order '{fields['axis'][3]}', not XYZ")
    channels = tuple(channel.lower() for channel in fields.get("dof", ()))
    unknown = [channel for channel in channels if channel not in ("rx", "ry", "rz")]
    if unknown:
        raise InputError(f"{name}: bone '{bone}' has degree of freedom '{unknown[0]}'")
    axis = Rotation.from_euler("xyz", angles, degrees=True).as_matrix()
    return bone, _Bone(vector=direction * length, axis=axis, channels=channels)


def _hierarchy(lines: Sequence[list[str]], name: str) -> dict[str, str]:
    """Bone to parent, in the file's order."""
    parent_of: dict[str, str] = {}
    for parent, *children in lines:
        for child in children:
            if child in parent_of:
                raise InputError(f"{name}: bone '{child}' has two parents")
            parent_of[child] = parent
    return parent_of


def _columns(
    layout: Sequence[list[str]], skeleton: AsfSkeleton, name: str
) -> list[tuple[int, ...]]:
    """Per joint the columns of its values among all values of a frame."""
    columns: list[tuple[int, ...]] = [()] * len(skeleton.joint_names)
    column = 0
    for bone, *values in layout:
        if bone not in skeleton.joint_names:
            raise InputError(f"{name}: bone '{bone}' is not in {skeleton.name}")
        joint = skeleton.joint_names.index(bone)
        if len(values) != len(skeleton.channels[joint]):
            raise InputError(
                f"{name}: bone '{bone}' has {len(values)} values in the first frame; "
                f"{skeleton.name} gives it {len(skeleton.channels[joint])}"
            )
        columns[joint] = tuple(range(column, column + len(values)))
        column += len(values)
    for joint, bone in enumerate(skeleton.joint_names):
        if skeleton.channels[joint] and not columns[joint]:
            raise InputError(f"{name}: the first frame has no line for bone '{bone}'")
    return columns


def _parse(text: str, path: str, beside: Mapping[str, str]) -> Motion:
    """The skeleton is that of the take's subject, '01.asf' of '01_02.amc', or the only one."""
    subject = re.split(r"[_.]", PurePath(path).name)[0]
    named = [skeleton for skeleton in beside if PurePath(skeleton).stem == subject]
    if len(named or beside) != 1:
        raise InputError(
            f"{path}: expected its skeleton '{subject}.asf' beside it; "
            f"found {', '.join(beside) or 'no .asf'}"
        )
    skeleton = next(iter(named or beside))
    return parse_amc(text, parse_asf(beside[skeleton], skeleton), path)


FORMAT = MotionFormat(
    what="an .amc with its .asf beside it", suffix=".amc", beside=".asf", parse=_parse
)
