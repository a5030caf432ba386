"""Human3.6M: one person, 4 cameras, 50 Hz, no IMUs; the protocol of the paper's table 4.

    FOLDER/cameras.json                          {"S9_cam1": {id, R, T_camera_centre_mm, f, c, k123,
                                                  p12}, ...}; x_cam = R (X - T)
    FOLDER/data_3d_h36m.npz                      positions_3d[subject][action] (T, 32, 3) [m]
      or   positions/<subject>/<action>.npy      D3_Positions, (T, 32, 3) or (T, 96) [mm]
    FOLDER/keypoints/<subject>/<action>/<camera id>/*.json     OpenPose BODY_25

The world is z up. Of the 32 joints 17 are scored. Subjects S9 and S11, every action, averaged over
an action's takes ("Directions", "Directions 1"); global positions with all four cameras, per-frame
Procrustes with one. S11's "Directions" is left out, as everywhere: its video is damaged.

Spine, thorax and head of Human3.6M are scored at our chest, neck, nose and head-top landmarks,
which are not the same points of the body; the paper calibrates its offsets for this data set anew.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from fusecap.body.landmarks import LandmarkSet, landmark_set_named
from fusecap.errors import InputError, nearest
from fusecap.evaluate.datasets.files import camera_at_centre
from fusecap.evaluate.datasets.recording import (
    DatasetSequence,
    LandmarkTruth,
    last_frame,
    read_views,
)
from fusecap.evaluate.datasets.safe_pickle import load_npz_object
from fusecap.geometry.camera import Y_UP_FROM_Z_UP, Rig
from fusecap.inputs import DATASET, open_input
from fusecap.sources.calibration_files import fields

RATE_HZ = 50.0
SUBJECTS = ("S9", "S11")
SIZES_PX = {
    "54138969": (1000, 1002),
    "55011271": (1000, 1000),
    "58860488": (1000, 1000),
    "60457274": (1000, 1002),
}
SCORED = (0, 1, 2, 3, 6, 7, 8, 12, 13, 14, 15, 17, 18, 19, 25, 26, 27)
"""Of the 32 joints."""
_NAMES = (
    "mid_hip right_hip right_knee right_ankle left_hip left_knee left_ankle chest neck nose "
    "head_top left_shoulder left_elbow left_wrist right_shoulder right_elbow right_wrist"
)
H36M17 = LandmarkSet(name="h36m17", landmark_names=tuple(_NAMES.split()))
"""Our landmarks at the scored joints, in their order."""
DAMAGED = (("S11", "Directions"),)
_PACKED = "data_3d_h36m.npz"


@dataclass(frozen=True, kw_only=True)
class Take36:
    """One take of one subject."""

    subject: str
    action: str
    """As the files are called: "Directions 1"."""

    @property
    def activity(self) -> str:
        """What table 4 calls it: the action without the take's number."""
        word, _, number = self.action.rpartition(" ")
        return word if number.isdigit() else self.action


def list_takes(folder: Path | str, subjects: Sequence[str] = SUBJECTS) -> tuple[Take36, ...]:
    """Every take of the subjects that has truth, but for damaged ones; raises `InputError`."""
    positions = _Positions(Path(folder))
    takes = [
        Take36(subject=subject, action=action)
        for subject in subjects
        for action in positions.actions(subject)
        if (subject, action) not in DAMAGED
    ]
    if not takes:
        raise InputError(f"{folder}: no truth of {', '.join(subjects)}")
    return tuple(takes)


def load_take36(
    folder: Path | str, take: Take36, cameras: Sequence[str] | None = None
) -> DatasetSequence:
    """One take as seen by the cameras with these ids, all by default; raises `InputError`."""
    folder = Path(folder)
    rig = read_rig(folder / "cameras.json", take.subject)
    rig = rig if cameras is None else rig.subset(list(cameras))
    landmarks = landmark_set_named("body25")
    seen = folder / "keypoints" / take.subject / take.action
    views = read_views({name: seen / name for name in rig.names}, landmarks, RATE_HZ)
    points = _Positions(folder).points(take)
    return DatasetSequence(
        name=f"{take.subject} {take.action}",
        rate_hz=RATE_HZ,
        frames=min(last_frame(views), len(points)),
        rig=rig,
        landmarks=landmarks,
        views=views,
        truth=LandmarkTruth(
            landmarks=H36M17, points_in_world_m=points[None, :, SCORED] @ Y_UP_FROM_Z_UP.T
        ),
        max_subjects=1,
    )


def read_rig(path: Path, subject: str) -> Rig:
    """A subject's cameras, called by their ids, in our world; raises `CalibrationError`."""
    data = fields.json_object(path)
    cameras = []
    for key, entry in data.items():
        if not key.startswith(f"{subject}_"):
            continue
        where = f"{path}: {key}"

        def numbers(key: str, *shape: int, entry: Any = entry, where: str = where) -> np.ndarray:
            if not isinstance(entry, dict) or key not in entry:
                raise InputError(
                    f"{where} has no {key}; expected id, R, T_camera_centre_mm, f, c, k123, p12"
                )
            return fields.numbers(entry[key], shape, f"{where} {key}")

        focal_px = numbers("f", 2)
        name = str(entry.get("id", key))
        cameras.append(
            camera_at_centre(
                path,
                name=name,
                size_px=SIZES_PX.get(name, (1000, 1000)),
                focal_px=focal_px,
                centre_px=numbers("c", 2),
                radial=numbers("k123", 3),
                tangential=numbers("p12", 2),
                rotation=numbers("R", 3, 3),
                position_m=numbers("T_camera_centre_mm", 3) / 1000.0,
            )
        )
    if not cameras:
        subjects = {key.partition("_")[0] for key in data}
        raise InputError(f"{path}: no camera of '{subject}'{nearest(subject, subjects)}")
    return Rig(cameras=tuple(cameras)).in_world(Y_UP_FROM_Z_UP)


class _Positions:
    """The 32 joints in their z-up world [m], from either layout."""

    def __init__(self, folder: Path) -> None:
        self._loose = folder / "positions"
        self._packed_path = folder / _PACKED
        self._packed: dict[str, Any] | None = None
        if self._packed_path.is_file():
            value = load_npz_object(self._packed_path, "positions_3d")
            if not isinstance(value, dict):
                raise InputError(
                    f"{self._packed_path}: positions_3d is a {type(value).__name__}, expected a "
                    "dict of subjects"
                )
            self._packed = value
        elif not self._loose.is_dir():
            raise InputError(
                f"{folder}: neither {_PACKED} nor positions/<subject>/<action>.npy; expected the "
                "3D joints in one of them"
            )

    def actions(self, subject: str) -> list[str]:
        if self._packed is not None:
            return sorted(self._packed.get(subject, {}))
        return sorted(path.stem for path in (self._loose / subject).glob("*.npy"))

    def points(self, take: Take36) -> np.ndarray:
        if self._packed is not None:
            try:
                return self._checked(self._packed[take.subject][take.action], str(take))
            except (KeyError, TypeError):
                raise InputError(f"{self._packed_path}: no {take.subject} {take.action}") from None
        path = self._loose / take.subject / f"{take.action}.npy"
        try:
            with open_input(path, DATASET) as file:
                values = np.load(file, allow_pickle=False)
        except (OSError, ValueError, EOFError, MemoryError) as error:
            raise InputError(f"{path}: cannot be read as an array: {error}") from None
        return self._checked(values, str(path)) / 1000.0

    @staticmethod
    def _checked(values: Any, where: str) -> np.ndarray:
        array = np.asarray(values)
        if array.dtype.kind not in "fiu" or array.ndim < 2 or array[0].size != 96:
            raise InputError(f"{where}: joints are {array.shape}, expected frames x 32 x 3")
        return array.reshape(-1, 32, 3).astype(np.float64)
