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
from jaxtyping import Float

from fusecap.body.landmarks import LandmarkSet, landmark_set_named
from fusecap.body.pose import landmarks_in_world
from fusecap.errors import InputError, TakeError
from fusecap.exports.openpose import write_frame
from fusecap.exports.take_format import ExportOptions, TakeFormat
from fusecap.files import distinct_names
from fusecap.geometry.camera import Camera
from fusecap.take import Take


def write_openpose(take: Take, path: Path, options: ExportOptions) -> None:
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
            names = distinct_names(camera.name for camera in cameras)
            for camera, name in zip(cameras, names, strict=True):
                folder = part / name
                folder.mkdir(parents=True)
                for frame, people in enumerate(_seen(take, camera, landmarks)):
                    write_frame(folder, camera.name, frame, people[take.tracked[:, frame]])
            if path.exists():
                shutil.rmtree(path)
            part.replace(path)
        finally:
            shutil.rmtree(part, ignore_errors=True)
    except OSError as error:
        raise TakeError(f"cannot write {path}: {error.strerror or error}") from error


def _seen(take: Take, camera: Camera, landmarks: LandmarkSet) -> Float[np.ndarray, "t s k 3"]:
    """Pixels and confidence of everybody, 0 where not in the picture."""
    people, frames = take.tracked.shape
    seen = np.zeros((frames, people, len(landmarks.landmark_names), 3))
    for row, name in enumerate(take.subject_names):
        mine = landmarks.of(name)
        tracked = take.tracked[row]
        places = landmarks_in_world(
            take.bone_position_in_world_m[row, tracked],
            take.bone_rotation_in_world(row)[tracked],
            mine.bones(take.skeleton),
            mine.offsets_m(take.shape(row)),
        )
        pixels = camera.project(places.reshape(-1, 3)).reshape(*places.shape[:2], 2)
        inside = np.all((pixels >= 0) & (pixels <= np.array(camera.size_px) - 1), axis=2)
        keypoints = np.concatenate([pixels, np.ones((*pixels.shape[:2], 1))], axis=2)
        seen[tracked, row] = np.where(inside[:, :, None], keypoints, 0.0)
    return seen


FORMAT = TakeFormat(suffix=".openpose", write=write_openpose, per_person=False)
