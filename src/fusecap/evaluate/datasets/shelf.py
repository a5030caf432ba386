"""Shelf and Campus (TU Munich): several people, occlusion, 3D PCP.

    FOLDER/calibs/<camera>.json          Shelf as `fusecap solve` reads it: K, RT, imgSize
      or   calibration_<name>.json       x_cam = R (X - T), T in mm; the VoxelPose layout
    FOLDER/<camera>/*_keypoints.json     OpenPose BODY_25, a folder per camera
      or   openpose_body25.tar.xz        the same, packed
    FOLDER/gt_*.txt                      joints, see `fusecap.evaluate.shelf`
      or   actorsGT.mat                  actor3D {actor} {frame} 14 x 3 [m]

Both worlds are z up; both are filmed at 25 Hz. Image sizes are not in the VoxelPose layout: 1032 x
776 for Shelf's 5 cameras, 360 x 288 for Campus' 3. The truth in `.mat` lacks the mid-hip, which is
midway between the hips.
"""

from __future__ import annotations

from contextlib import nullcontext
from pathlib import Path
from typing import Any

import numpy as np

from fusecap.body.landmarks import landmark_set_named
from fusecap.errors import InputError
from fusecap.evaluate.datasets.files import camera_at_centre, unpacked
from fusecap.evaluate.datasets.recording import Recording, last_frame, read_views
from fusecap.evaluate.shelf import MID_HIP, RATE_HZ, ShelfScore, ShelfTruth, load_truth
from fusecap.evaluate.tables import Table
from fusecap.geometry.camera import Y_UP_FROM_Z_UP, Rig
from fusecap.sources.calibration_files import fields, load_rig

LANDMARK_SET = "body25"
SIZES_PX = {5: (1032, 776), 3: (360, 288)}
"""By number of cameras: Shelf, Campus."""
_PACKED = "openpose_body25.tar.xz"


def load_shelf(folder: Path | str) -> Recording:
    """The sequence in a folder; raises `InputError`. Its truth is `load_shelf_truth`."""
    folder = Path(folder)
    rig = read_rig(folder)
    landmarks = landmark_set_named(LANDMARK_SET)
    packed = folder / _PACKED
    loose = all((folder / name).is_dir() for name in rig.names)
    with nullcontext(folder) if loose or not packed.is_file() else unpacked(packed) as root:
        views = read_views({name: root / name for name in rig.names}, landmarks, RATE_HZ)
    return Recording(
        name="campus" if len(rig) == 3 else "shelf",
        rate_hz=RATE_HZ,
        frames=last_frame(views),
        rig=rig,
        landmarks=landmarks,
        views=views,
    )


def read_rig(folder: Path) -> Rig:
    """The cameras in our world; raises `CalibrationError`."""
    if (folder / "calibs").is_dir():
        return load_rig(folder / "calibs", up="z")
    found = sorted(folder.glob("calibration*.json"))
    if len(found) != 1:
        raise InputError(
            f"{folder}: holds {len(found)} calibrations; expected calibs/<camera>.json or one "
            "calibration_<name>.json"
        )
    return read_voxelpose_rig(found[0])


def read_voxelpose_rig(path: Path) -> Rig:
    """`{"0": {R, T (camera centre, mm), fx, fy, cx, cy, k, p}, ...}` in our world."""
    data = fields.json_object(path)
    size_px = SIZES_PX.get(len(data))
    if size_px is None:
        raise InputError(f"{path}: {len(data)} cameras; expected Shelf's 5 or Campus' 3")
    cameras = []
    for name, entry in data.items():
        where = f"{path}: camera '{name}'"

        def numbers(key: str, *shape: int, entry: Any = entry, where: str = where) -> np.ndarray:
            if not isinstance(entry, dict) or key not in entry:
                raise InputError(f"{where} has no {key}; expected R, T, fx, fy, cx, cy, k, p")
            return fields.numbers(entry[key], shape, f"{where} {key}")

        cameras.append(
            camera_at_centre(
                path,
                name=name,
                size_px=size_px,
                focal_px=np.array([numbers("fx", 1)[0], numbers("fy", 1)[0]]),
                centre_px=np.array([numbers("cx", 1)[0], numbers("cy", 1)[0]]),
                radial=numbers("k", 3),
                tangential=numbers("p", 2),
                rotation=numbers("R", 3, 3),
                position_m=numbers("T", 3) / 1000.0,
            )
        )
    return Rig(cameras=tuple(cameras)).in_world(Y_UP_FROM_Z_UP)


def load_shelf_truth(folder: Path | str) -> ShelfTruth:
    """The joints in a folder, from its `.mat` or its text; raises `InputError`."""
    folder = Path(folder)
    texts = sorted(folder.glob("gt_*.txt"))
    matlab = sorted(folder.glob("*actorsGT*.mat"))
    if len(texts) == 1:
        return load_truth(texts[0])
    if len(matlab) == 1:
        return read_actors(matlab[0])
    raise InputError(
        f"{folder}: {len(texts)} gt_*.txt and {len(matlab)} actorsGT.mat; expected one truth file"
    )


def read_actors(path: Path) -> ShelfTruth:
    """`actor3D` of an `actorsGT.mat`; an actor without joints in a frame is not there."""
    from scipy.io import loadmat

    try:
        data = loadmat(path)
    except FileNotFoundError:
        raise InputError(f"{path}: no such file; expected actorsGT.mat") from None
    except Exception as error:  # SciPy's reader raises whatever garbage makes it stumble over
        raise InputError(f"{path}: not a MATLAB 5 file, or cut short: {error}") from None
    if "actor3D" not in data:
        raise InputError(f"{path}: holds no actor3D; expected the joints of each actor")
    actors = [_cells(_unwrapped(actor)) for actor in _cells(_unwrapped(data["actor3D"]))]
    frames = max((len(actor) for actor in actors), default=0)
    points = np.full((len(actors), frames, 15, 3), np.nan)
    for row, actor in enumerate(actors):
        for frame, cell in enumerate(actor):
            joints = _unwrapped(cell)
            if joints.shape == (14, 3) and joints.dtype != object:
                points[row, frame, :14] = joints @ Y_UP_FROM_Z_UP.T
            elif joints.size > 1:
                raise InputError(
                    f"{path}: actor {row} frame {frame} has joints {joints.shape}, expected 14 x 3"
                )
    points[:, :, MID_HIP] = (points[:, :, 2] + points[:, :, 3]) / 2
    return ShelfTruth(points_in_world_m=points)


def pcp_table(name: str, score: ShelfScore) -> Table:
    """3D PCP per actor and per kind of limb."""
    rows = [(f"actor {actor}", pcp) for actor, pcp in score.actor_pcp.items()]
    rows += [*score.limb_pcp.items(), ("mean over actors", score.pcp)]
    return Table(
        title=f"{name.capitalize()}: 3D PCP",
        columns=("of", "PCP %"),
        rows=tuple(rows),
        digits=2,
        note=f"{score.person_frames} person-frames, {score.missed_person_frames} of them missed, "
        f"{score.identity_switches} identity switches",
    )


def _unwrapped(value: Any) -> np.ndarray:
    """MATLAB cells that hold a single cell, opened."""
    array = np.asarray(value)
    while array.dtype == object and array.size == 1:
        array = np.asarray(array.reshape(-1)[0])
    return array


def _cells(array: np.ndarray) -> list[Any]:
    """The elements of a cell array; a matrix of one frame is itself the only one."""
    return list(array.reshape(-1)) if array.dtype == object else [array]
