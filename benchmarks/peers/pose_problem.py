"""One pose problem per frame, as a file that any solver can read, and its cost in plain NumPy.

The file is a sequence of little-endian float64 numbers, in the order of `_LAYOUT`: first the sizes,
then what all frames share, then frame after frame in the order of `_FRAME`. Integers are stored as
floats, missing measurements as NaN or zero confidence, as in `Measurements`. Each frame brings the
pose that the solve starts from: our solution of the frame before, so that every solver is given
the identical problem.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from fusecap.body.landmarks import LandmarkSet
from fusecap.body.prior import PosePrior
from fusecap.body.shape import BodyShape
from fusecap.geometry.camera import Rig
from fusecap.solve.options import SolverOptions
from fusecap.solve.pose_solver import ImuSites, Measurements

MAGIC = 20201.0
"""First number of a file: this layout, of this cost (IJCV 2020), version 1."""

_SIZES = ("bones", "landmarks", "cameras", "imus", "rank", "floor_bones", "frames")
_LAYOUT: dict[str, tuple[str | int, ...]] = {
    "parents": ("bones",),
    "offsets_m": ("bones", 3),
    "landmark_bone": ("landmarks",),
    "landmark_offset_m": ("landmarks", 3),
    "cameras_packed": ("cameras", 24),
    "imu_bone": ("imus",),
    "imu_offset_m": ("imus", 3),
    "prior_mean": ("pose_angles",),
    "prior_basis": ("pose_angles", "rank"),
    "prior_sigma": ("rank",),
    "floor_bone": ("floor_bones",),
    "floor_radius_m": (1,),
    "weights": (6,),
    "function_tolerance": (1,),
    "max_iterations": (1,),
}
_FRAME: dict[str, tuple[str | int, ...]] = {
    "start": ("pose",),
    "dt_s": (1,),
    "keypoints": ("cameras", "landmarks", 3),
    "imu_rotation": ("imus", 3, 3),
    "imu_accel": ("imus", 3),
    "imu_history": (2, "imus", 3),
}

TERMS = ("position", "orientation", "acceleration", "projection", "deviation", "floor")
"""Of one instant, in the order of the peers' files."""


@dataclass(frozen=True, kw_only=True)
class Problems:
    """The arrays of a file, by the names of `_LAYOUT` and, stacked over frames, of `_FRAME`."""

    sizes: dict[str, int]
    shared: dict[str, np.ndarray]
    frames: dict[str, np.ndarray]

    def __len__(self) -> int:
        return self.sizes["frames"]

    def measurements(self, frame: int) -> Measurements:
        """What frame `frame` is solved from."""
        found = {name: values[frame] for name, values in self.frames.items()}
        return Measurements(
            keypoints=found["keypoints"],
            imu_rotation=found["imu_rotation"],
            imu_accel=found["imu_accel"],
            imu_history=found["imu_history"],
            dt_s=float(found["dt_s"][0]),
        )


def build_problems(
    *,
    shape: BodyShape,
    rig: Rig,
    landmarks: LandmarkSet,
    prior: PosePrior,
    sites: ImuSites,
    options: SolverOptions,
    floor_bones: tuple[str, ...],
    starts: np.ndarray,
    data: list[Measurements],
) -> Problems:
    """Gather a solver's inputs; `starts` (T, P) are the poses to start from."""
    skeleton = shape.skeleton
    sizes = {
        "bones": skeleton.bone_count,
        "landmarks": len(landmarks.landmark_names),
        "cameras": len(rig),
        "imus": len(sites.bone),
        "rank": len(prior.sigma),
        "floor_bones": len(floor_bones),
        "frames": len(data),
    }
    shared = {
        "parents": skeleton.parent_array,
        "offsets_m": shape.offsets_m,
        "landmark_bone": landmarks.bones(skeleton),
        "landmark_offset_m": landmarks.offsets_m(shape),
        "cameras_packed": rig.packed,
        "imu_bone": np.array(sites.bone),
        "imu_offset_m": sites.position_m,
        "prior_mean": prior.mean,
        "prior_basis": prior.basis,
        "prior_sigma": prior.sigma,
        "floor_bone": np.array([skeleton.bone(name) for name in floor_bones]),
        "floor_radius_m": np.array([options.floor_radius_m]),
        "weights": [getattr(options.weights, name) for name in TERMS],
        "function_tolerance": np.array([options.function_tolerance]),
        "max_iterations": np.array([options.max_iterations]),
    }
    frames = {"start": starts, "dt_s": np.array([[frame.dt_s] for frame in data])}
    for name in ("keypoints", "imu_rotation", "imu_accel", "imu_history"):
        frames[name] = np.stack([getattr(frame, name) for frame in data])
    return Problems(
        sizes=sizes,
        shared={name: np.asarray(values, np.float64) for name, values in shared.items()},
        frames={name: np.asarray(values, np.float64) for name, values in frames.items()},
    )


def write_problems(problems: Problems, path: Path) -> None:
    parts = [np.array([MAGIC, *(problems.sizes[name] for name in _SIZES)])]
    for name, shape in _LAYOUT.items():
        parts.append(problems.shared[name].reshape(_shape(shape, problems.sizes)).ravel())
    rows = [problems.frames[name].reshape(len(problems), -1) for name in _FRAME]
    parts.append(np.concatenate(rows, axis=1).ravel())
    np.concatenate(parts).astype("<f8").tofile(path)


def read_problems(path: Path) -> Problems:
    """Raises `ValueError` for a file of another layout or length."""
    values = np.fromfile(path, "<f8")
    if len(values) < 1 + len(_SIZES) or values[0] != MAGIC:
        raise ValueError(f"{path} holds no pose problems")
    sizes = {name: int(values[1 + i]) for i, name in enumerate(_SIZES)}
    position = 1 + len(_SIZES)
    shared = {}
    for name, symbols in _LAYOUT.items():
        shape = _shape(symbols, sizes)
        shared[name] = values[position : position + int(np.prod(shape))].reshape(shape)
        position += int(np.prod(shape))
    rest = values[position:].reshape(sizes["frames"], -1)
    frames, column = {}, 0
    for name, symbols in _FRAME.items():
        shape = _shape(symbols, sizes)
        part = rest[:, column : column + int(np.prod(shape))]
        frames[name] = np.ascontiguousarray(part).reshape(sizes["frames"], *shape)
        column += int(np.prod(shape))
    if column != rest.shape[1]:
        raise ValueError(f"{path}: {rest.shape[1]} numbers per frame, expected {column}")
    return Problems(sizes=sizes, shared=shared, frames=frames)


def _shape(symbols: tuple[str | int, ...], sizes: dict[str, int]) -> tuple[int, ...]:
    derived = {"pose": 3 + 3 * sizes["bones"], "pose_angles": 3 * sizes["bones"] - 3}
    known = sizes | derived
    return tuple(known[s] if isinstance(s, str) else s for s in symbols)
