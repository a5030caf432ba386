"""Whose world is it: the seven numbers that no residual sees, taken from the rough calibration.

Cameras and people may be moved, turned and scaled together and every keypoint stays where it is.
Of all these worlds the one is chosen in which the cameras moved least from where the rough
calibration had them:

    min over s, R, t   sum over cameras  w_c ( |s R C_c + t - C0_c|^2 / a^2  +  angle_c^2 / b^2 )

with w_c Cauchy's weight, so that one camera that was knocked over does not turn the room, and a, b
the typical remaining shift and angle, measured along with it: where centres were surveyed well and
directions badly, the centres decide. Origin, up and floor so stay those of the rough calibration
as well as all its cameras together know them.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from fusecap.geometry.camera import Rig
from fusecap.geometry.similarity import Similarity

_ROUNDS = 30
_MIN_SHIFT_M, _MIN_ANGLE_RAD = 0.002, np.radians(0.05)
"""No rough calibration is trusted more; keeps weights finite."""


@dataclass(frozen=True, kw_only=True)
class Alignment:
    """Found by `align`."""

    similarity: Similarity
    weight: Float[np.ndarray, " c"]
    """Of each camera, 0-1."""
    shift_m: float
    """Typical remaining shift of a camera along an axis, a."""
    angle_rad: float
    """Typical remaining angle about an axis, b."""


def align(rig: Rig, reference: Rig, scale: float | None = None) -> Alignment:
    """Bring `rig` nearest to `reference`, camera by camera; `scale` is found unless given."""
    centres = np.array([camera.position_in_world for camera in rig.cameras])
    target = np.array([camera.position_in_world for camera in reference.cameras])
    weight = np.ones(len(rig))
    shift_m, angle_rad = 0.1, np.radians(2.0)
    relative = np.array(
        [b.rotation.T @ a.rotation for a, b in zip(rig.cameras, reference.cameras, strict=True)]
    )
    rotation = Rotation.from_matrix(relative).mean(weight).as_matrix()
    found, ratio = None, scale or 1.0
    for _ in range(_ROUNDS):
        mean, mean_target = (np.average(p, axis=0, weights=weight) for p in (centres, target))
        a, b = centres - mean, target - mean_target
        # Procrustes with the directions as further, weighted votes for the rotation: a camera's
        # 3 x 3 vote counts like a point at distance shift / angle.
        lever = (shift_m / angle_rad) ** 2 / 2
        votes = np.einsum("c,ci,cj->ij", weight, b, a * ratio)
        votes = votes + lever * np.einsum("c,cij->ij", weight, relative)
        u, _, vt = np.linalg.svd(votes)
        rotation = u @ np.diag([1, 1, np.linalg.det(u @ vt)]) @ vt
        if scale is None:
            square = float((weight[:, None] * a * a).sum())
            along = float((weight[:, None] * b * (a @ rotation.T)).sum())
            ratio = along / square if square > 1e-12 and along > 0 else 1.0
        found = Similarity(
            scale=ratio, rotation=rotation, translation_m=mean_target - ratio * rotation @ mean
        )
        moved = found.rig(rig)
        shift = np.array([np.linalg.norm(d) for d in _centre_shifts_m(moved, reference)])
        angle = np.array([np.linalg.norm(v) for v in _turns_rad(moved, reference)])
        shift_m = max(_typical(shift, weight), _MIN_SHIFT_M)
        angle_rad = max(_typical(angle, weight), _MIN_ANGLE_RAD)
        off = (shift / shift_m) ** 2 + (angle / angle_rad) ** 2
        fresh = 1.0 / (1.0 + off / 6 / 4)
        if np.abs(fresh - weight).max() < 1e-6:
            break
        weight = fresh
    assert found is not None
    return Alignment(similarity=found, weight=weight, shift_m=shift_m, angle_rad=angle_rad)


def motions(rig: Rig, reference: Rig) -> tuple[Float[np.ndarray, " c"], Float[np.ndarray, " c"]]:
    """How far each camera's centre [m] and direction [rad] are from the reference's."""
    shift = np.linalg.norm(_centre_shifts_m(rig, reference), axis=1)
    return shift, np.linalg.norm(_turns_rad(rig, reference), axis=1)


def gauge_free(
    information: Float[np.ndarray, "g g"], rig: Rig, alignment: Alignment, own: int
) -> Float[np.ndarray, "g g"]:
    """Covariance of the cameras' numbers in the world that `align` chooses, from information.

    Per camera: turn (3) and shift of the centre (3) along its own axes, then intrinsics; `own`
    numbers in all. The alignment takes out what a similarity can: x - G (G' W G)^-1 G' W x.
    """
    size = own * len(rig)
    gauge = np.zeros((size, 7))
    trust = np.zeros(size)
    for c, camera in enumerate(rig.cameras):
        r, centre = camera.rotation, camera.position_in_world
        cross = np.array(
            [[0, -centre[2], centre[1]], [centre[2], 0, -centre[0]], [-centre[1], centre[0], 0]]
        )
        first = c * own
        gauge[first : first + 3, 0:3] = -r
        gauge[first + 3 : first + 6, 0:3] = -r @ cross
        gauge[first + 3 : first + 6, 3:6] = r
        gauge[first + 3 : first + 6, 6] = r @ centre
        trust[first : first + 3] = alignment.weight[c] / alignment.angle_rad**2
        trust[first + 3 : first + 6] = alignment.weight[c] / alignment.shift_m**2
    kept = np.eye(size) - gauge @ np.linalg.pinv(gauge.T @ (trust[:, None] * gauge)) @ (
        gauge.T * trust
    )
    return kept @ np.linalg.pinv(information, hermitian=True) @ kept.T


def _typical(size: np.ndarray, weight: np.ndarray) -> float:
    """Per axis, weighted root mean square."""
    return float(np.sqrt((weight * size**2).sum() / weight.sum() / 3))


def _centre_shifts_m(rig: Rig, reference: Rig) -> np.ndarray:
    return np.array(
        [
            a.position_in_world - b.position_in_world
            for a, b in zip(rig.cameras, reference.cameras, strict=True)
        ]
    )


def _turns_rad(rig: Rig, reference: Rig) -> np.ndarray:
    turns = [a.rotation @ b.rotation.T for a, b in zip(rig.cameras, reference.cameras, strict=True)]
    return Rotation.from_matrix(np.array(turns)).as_rotvec()
