"""The detections of one instant, flat and undistorted, as the kernels want them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fusecap.geometry.camera import Rig
from fusecap.kernels import association as kernels
from fusecap.types import Detections

MIN_COMMON = 4
"""Landmarks that two skeletons, or a skeleton and a detection, must share to be compared: fewer do
not fix a position and a scale with one to spare."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Views:
    """All n people of all cameras, grouped by camera."""

    cameras: np.ndarray
    """Packed rows (c, 24)."""
    camera_of: np.ndarray
    """Camera of each person (n,)."""
    first: tuple[int, ...]
    """Where each camera's people start, and their number at the end (c + 1)."""
    rays: np.ndarray
    """X/Z, Y/Z, confidence (n, k, 3)."""

    @classmethod
    def of(cls, rig: Rig, detections: Detections) -> Views:
        """Flatten and undistort."""
        people = detections.people
        first = [0]
        for p in people:
            first.append(first[-1] + len(p))
        camera_of = np.repeat(np.arange(len(people)), [len(p) for p in people])
        keypoints = np.ascontiguousarray(np.concatenate(people), np.float64)
        rays = np.empty(keypoints.shape)
        kernels.undistort(rig.packed, camera_of, keypoints, rays)
        return cls(cameras=rig.packed, camera_of=camera_of, first=tuple(first), rays=rays)

    def local(self, person: np.ndarray) -> np.ndarray:
        """Rows of `rays` (..., c) as indices into each camera's people; -1 stays."""
        return np.where(person >= 0, person - np.array(self.first[:-1]), -1)

    def distances(
        self, landmarks: np.ndarray, truncation_m: float, wanted: np.ndarray
    ) -> np.ndarray:
        """Distances [m] (t, n) of skeletons (t, k, 3) to the wanted detections; others infinite."""
        distance = np.empty((len(landmarks), len(self.rays)))
        kernels.match_distance(
            self.cameras,
            self.camera_of,
            self.rays,
            wanted,
            landmarks,
            truncation_m,
            MIN_COMMON,
            distance,
        )
        return distance

    def triangulate(
        self, person: np.ndarray, prior_m: np.ndarray, max_distance_m: float, scale_px: float
    ) -> np.ndarray:
        """Landmarks (t, k, 3) from the detections `person` (t, c); contradicting ones become -1."""
        landmarks = np.empty((len(person), *self.rays.shape[1:]))
        error_px = np.empty(landmarks.shape[:2])
        kernels.drop_contradicting_views(
            self.cameras,
            self.rays,
            prior_m,
            max_distance_m,
            3.0 * max_distance_m,
            MIN_COMMON,
            scale_px,
            person,
            landmarks,
            error_px,
        )
        return landmarks
