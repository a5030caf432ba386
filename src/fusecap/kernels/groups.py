"""Arguments that travel together, by name. numba passes them as plain values: naming costs nothing.

`Model` is what stays from one instant to the next, `Measured` what one instant brings; the others
are the caller's arrays that kernels write to.
"""

from __future__ import annotations

from typing import Any, NamedTuple

from numba import float64 as f8
from numba import int64 as i8
from numba import types


class TermWeights(NamedTuple):
    """λ of each term; 0 switches it off."""

    position: Any
    orientation: Any
    acceleration: Any
    projection: Any
    deviation: Any
    floor: Any
    motion: Any
    increment: Any
    specific_force: Any
    rest: Any


class Body(NamedTuple):
    """A tree of B bones: parents (B,), joint offsets in the parent's frame (B, 3)."""

    parents: Any
    offsets: Any


class Landmarks(NamedTuple):
    """K points on bones (K,), (K, 3), before C packed cameras (C, 24)."""

    bone: Any
    offset: Any
    cameras: Any


class SensorSites(NamedTuple):
    """I sensors on bones (I,), their places (I, 3)."""

    bone: Any
    offset: Any


class Prior(NamedTuple):
    """PCA mean (3B - 3,) and the matrices of its two terms."""

    mean: Any
    projector: Any
    precision: Any


class Floor(NamedTuple):
    """Joints that stay above the floor (F,), by how much [m]; joints that may rest (R,)."""

    bone: Any
    radius: Any
    resting: Any


class Model(NamedTuple):
    """All that one subject's cost depends on besides measurements."""

    weights: Any
    body: Any
    landmarks: Any
    sensors: Any
    prior: Any
    floor: Any


class Measured(NamedTuple):
    """One instant.

    Keypoints (C, K, 3); sensor rotations (I, 3, 3), present (I,) or not; for the acceleration term
    accelerations at t-1 (I, 3), sites at t-1 and t-2 (2, I, 3), Δt.
    """

    keypoints: Any
    rotation: Any
    present: Any
    accel: Any
    history: Any
    dt: Any


class Window(NamedTuple):
    """N instants.

    Keypoints (N, C, K, 3); sensor rotations (N, I, 3, 3), present (N, I) or not, specific force in
    the bone's frame (N, I, 3); contact (N, R) of joints that rest from the instant before to this
    one; steps between instants (N - 1,) [s]; steadiness (1 + B,) of the root's place and of every
    joint, one over their mean square acceleration.
    """

    keypoints: Any
    rotation: Any
    present: Any
    force: Any
    contact: Any
    steps: Any
    steadiness: Any


class Posed(NamedTuple):
    """A posed body: joints (B, 3), rotations and twists (B, 3, 3); see `kinematics.forward`."""

    position: Any
    rotation: Any
    twist: Any


class Gathered(NamedTuple):
    """Information (B, 6, 6) and gradient (B, 6) per bone; see `information`.

    Of a window (N, 3, B, 6, 6) and (N, B, 6): [t, k] couples the instants t and t - k.
    """

    information: Any
    gradient: Any


class Scratch(NamedTuple):
    """Room to compute in.

    A matrix (3, 3), a point's information (3, 3) and gradient (3,), joint motions (B, 6, 3) and a
    force (6, 3).
    """

    local: Any
    information: Any
    gradient: Any
    motion: Any
    force: Any


_vector, _matrix, _cube = f8[::1], f8[:, ::1], f8[:, :, ::1]
_cubes = f8[:, :, :, ::1]
_bones = i8[::1]
_GROUPS = (types.NamedTuple, types.NamedUniTuple)


def _group(kind: type, *members: Any) -> types.BaseTuple:
    """Numba's type of a group: equal members make a type of its own."""
    if len(set(members)) == 1:
        return types.NamedUniTuple(members[0], len(members), kind)
    return types.NamedTuple(members, kind)


WEIGHTS = _group(TermWeights, *[f8] * len(TermWeights._fields))
BODY = _group(Body, _bones, _matrix)
LANDMARKS = _group(Landmarks, _bones, _matrix, _matrix)
SENSORS = _group(SensorSites, _bones, _matrix)
PRIOR = _group(Prior, _vector, _matrix, _matrix)
FLOOR = _group(Floor, _bones, f8, _bones)
MODEL = _group(Model, WEIGHTS, BODY, LANDMARKS, SENSORS, PRIOR, FLOOR)
MEASURED = _group(Measured, _cube, _cube, _vector, _matrix, _cube, f8)
POSED = _group(Posed, _matrix, _cube, _cube)
GATHERED = _group(Gathered, _cube, _matrix)
WINDOW = _group(Window, _cubes, _cubes, _matrix, _cube, _matrix, _vector, _vector)
POSED_WINDOW = _group(Posed, _cube, _cubes, _cubes)
GATHERED_WINDOW = _group(Gathered, f8[:, :, :, :, ::1], _cube)
SCRATCH = _group(Scratch, _matrix, _matrix, _vector, _cube, _matrix)


def plain(group: Any) -> Any:
    """A group as nested tuples without names, which numba takes from Python four times faster."""
    return tuple(plain(one) for one in group) if isinstance(group, tuple) else group


def plain_type(*members: Any) -> types.Tuple:
    """Types of what `plain` gives for groups of these types."""
    return types.Tuple(
        [plain_type(*one.types) if isinstance(one, _GROUPS) else one for one in members]
    )
