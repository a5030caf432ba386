"""OpenPose JSON of everybody's landmarks as the session's cameras see them: a folder per camera.

    duo.openpose/left/left_000000000012_keypoints.json

In the order of the cameras' landmark set. A landmark outside the picture, or of a person who is not
tracked, is missing (0, 0, 0); the others have confidence 1, whatever is in front of them.
"""

from __future__ import annotations

import os
import shutil
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float

from fusecap.body.landmarks import LandmarkSet, landmark_set_named
from fusecap.body.pose import landmarks_in_world
from fusecap.errors import InputError, TakeError
from fusecap.exports.openpose import frame_path, frame_text
from fusecap.exports.take_format import AnyTake, ExportOptions, TakeFormat, blocks
from fusecap.files import distinct_names
from fusecap.geometry.camera import Camera
from fusecap.take import Take


def write_openpose(take: AnyTake, path: Path, options: ExportOptions) -> None:
    """Writes all frames of all cameras, whole or not at all; a folder that was there is replaced.

    Raises `InputError` without cameras.
    """
    if options.cameras is None or not len(options.cameras):
        raise InputError("openpose needs cameras that see the keypoints: name --session SESSION")
    landmarks = options.landmarks or landmark_set_named("body25")
    part = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        try:
            cameras = options.cameras.cameras
            folders = [part / name for name in distinct_names(camera.name for camera in cameras)]
            for folder in folders:
                folder.mkdir(parents=True)
            for frames, piece in blocks(take):
                places = [_landmarks_m(piece, row, landmarks) for row in range(len(piece.tracked))]
                for camera, folder in zip(cameras, folders, strict=True):
                    _write_camera(folder, frames.start, camera, piece.tracked, places)
            if path.exists():
                shutil.rmtree(path)
            part.replace(path)
        finally:
            shutil.rmtree(part, ignore_errors=True)
    except OSError as error:
        raise TakeError(f"cannot write {path}: {error.strerror or error}") from error


def _landmarks_m(take: Take, row: int, landmarks: LandmarkSet) -> Float[np.ndarray, "t k 3"]:
    """Of one person in the frames that they are tracked in."""
    mine = landmarks.of(take.subject_names[row])
    tracked = take.tracked[row]
    return landmarks_in_world(
        take.bone_position_in_world_m[row, tracked],
        take.bone_rotation_in_world(row)[tracked],
        mine.bones(take.skeleton),
        mine.offsets_m(take.shape(row)),
    )


def _write_camera(
    folder: Path,
    first: int,
    camera: Camera,
    tracked: Bool[np.ndarray, "s t"],
    places_m: list[Float[np.ndarray, "_ k 3"]],
) -> None:
    """Frames from `first`; the whole folder is renamed at last, so none of them is."""
    seen = np.zeros((*tracked.T.shape, places_m[0].shape[1], 3))
    for row, places in enumerate(places_m):
        pixels = camera.project(places.reshape(-1, 3)).reshape(*places.shape[:2], 2)
        inside = np.all((pixels >= 0) & (pixels <= np.array(camera.size_px) - 1), axis=2)
        keypoints = np.concatenate([pixels, np.ones((*pixels.shape[:2], 1))], axis=2)
        seen[tracked[row], row] = np.where(inside[:, :, None], keypoints, 0.0)
    for frame, people in enumerate(seen):
        text = frame_text(people[tracked[:, frame]])
        frame_path(folder, camera.name, first + frame).write_bytes(text.encode())


FORMAT = TakeFormat(suffix=".openpose", write=write_openpose, per_person=False)
