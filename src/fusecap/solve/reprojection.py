"""How far keypoints lie from the solved landmarks' images, camera by camera."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from fusecap.body.landmarks import LandmarkSet
from fusecap.body.pose import landmarks_in_world
from fusecap.geometry.camera import Rig
from fusecap.solve.quantiles import Quantiles
from fusecap.types import Estimate

_BATCH = 256


class Reprojection:
    """Collects residuals of a whole take; projects in batches."""

    def __init__(self, rig: Rig, landmarks: LandmarkSet) -> None:
        self._rig = rig
        self._landmarks = landmarks
        self._points: list[np.ndarray] = []
        self._keypoints: list[np.ndarray] = []
        self._residual_px = [Quantiles() for _ in rig.cameras]

    def add(self, estimate: Estimate, keypoints: Float[np.ndarray, "c k 3"]) -> None:
        """The keypoints that an estimate was solved from."""
        shape = estimate.shape
        self._points.append(
            landmarks_in_world(
                estimate.bone_position_in_world_m[None],
                estimate.bone_rotation_in_world[None],
                self._landmarks.bones(shape.skeleton),
                self._landmarks.of(estimate.name).offsets_m(shape),
            )[0]
        )
        self._keypoints.append(keypoints)
        if len(self._points) == _BATCH:
            self._flush()

    def summary(self) -> dict[str, dict[str, float]]:
        """Per camera the median and 90th percentile [px], and the number of keypoints."""
        self._flush()
        return {
            camera.name: {
                "median": residual.at(0.5),
                "p90": residual.at(0.9),
                "keypoints": residual.count,
            }
            for camera, residual in zip(self._rig.cameras, self._residual_px, strict=True)
        }

    def _flush(self) -> None:
        if not self._points:
            return
        points = np.stack(self._points)
        keypoints = np.stack(self._keypoints)
        for index, camera in enumerate(self._rig.cameras):
            seen = keypoints[:, index]
            used = seen[:, :, 2] > 0
            residual = np.linalg.norm(camera.project(points[used]) - seen[used][:, :2], axis=1)
            self._residual_px[index].add(residual)
        self._points.clear()
        self._keypoints.clear()
