"""Multi-view triangulation: exact without noise, blind to one outlier, honest about too little."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import least_squares

from fusecap.geometry.camera import Rig
from fusecap.geometry.triangulation import ROBUST_SCALE_PX, triangulate
from people_scene import ring_of_cameras


def imaged(rig: Rig, points: np.ndarray) -> np.ndarray:
    ones = np.ones((len(points), 1))
    return np.stack([np.hstack([camera.project(points), ones]) for camera in rig.cameras])


def cauchy_twin(rig: Rig, keypoints: np.ndarray, start: np.ndarray) -> np.ndarray:
    """Eq. 17 for one landmark (c, 3) by SciPy, on undistorted coordinates like the kernel."""

    def residuals(point: np.ndarray) -> np.ndarray:
        rows = []
        for camera, (u, v, confidence) in zip(rig.cameras, keypoints, strict=True):
            if confidence > 0:
                x, y, z = camera.rotation @ point + camera.translation
                ray = camera.undistort(np.array([[u, v]]))[0]
                focal = 0.5 * (camera.matrix[0, 0] + camera.matrix[1, 1]) * camera.pixel_scale
                norm = focal * np.hypot(x / z - ray[0], y / z - ray[1]) / ROBUST_SCALE_PX
                rows.append(np.sqrt(confidence * np.log1p(norm**2)))
        return np.array(rows)

    return least_squares(residuals, start, xtol=1e-12, ftol=1e-12, gtol=1e-12).x


@given(seed=st.integers(0, 10_000), cameras=st.integers(2, 8))
def test_noise_free_points_are_recovered(seed, cameras):
    rig = ring_of_cameras(cameras)
    points = np.random.default_rng(seed).uniform([-1.5, 0.1, -1.5], [1.5, 1.9, 1.5], (25, 3))
    found, error_px = triangulate(rig, imaged(rig, points))
    # Two facing cameras give no depth on the line between them.
    known = np.isfinite(found[:, 0])
    assert known.all() or cameras == 2
    np.testing.assert_allclose(found[known], points[known], atol=1e-4)
    assert np.all(error_px[known] < 0.02)


def test_point_agrees_with_scipys_minimum_of_eq_17(rng):
    rig = ring_of_cameras(5)
    points = rng.uniform([-1, 0.2, -1], [1, 1.8, 1], (4, 3))
    keypoints = imaged(rig, points)
    keypoints[..., :2] += rng.normal(size=(5, 4, 2)) * 5
    keypoints[..., 2] = rng.uniform(0.2, 1, (5, 4))
    found, _ = triangulate(rig, keypoints)
    for k in range(4):
        np.testing.assert_allclose(
            found[k], cauchy_twin(rig, keypoints[:, k], points[k]), atol=1e-3
        )


@pytest.mark.parametrize("cameras", [3, 4, 8])
def test_one_outlier_view_is_ignored(rng, cameras):
    rig = ring_of_cameras(cameras)
    points = rng.uniform([-1, 0.2, -1], [1, 1.8, 1], (25, 3))
    keypoints = imaged(rig, points)
    wrong = rng.integers(0, cameras, 25)
    angle = rng.uniform(0, 2 * np.pi, 25)
    keypoints[wrong, np.arange(25), :2] += 250 * np.stack([np.cos(angle), np.sin(angle)], 1)
    found, error_px = triangulate(rig, keypoints)
    distance = np.linalg.norm(found - points, axis=1)
    # With three views an outlier along an epipolar line can be consistent with one other view.
    assert np.mean(distance < 0.01) >= (0.9 if cameras == 3 else 1.0)
    assert np.median(error_px) < 1.0


def test_noise_of_five_pixels_gives_two_centimetres(rng):
    rig = ring_of_cameras(4)
    points = rng.uniform([-1, 0.2, -1], [1, 1.8, 1], (500, 3))
    keypoints = imaged(rig, points)
    keypoints[..., :2] += rng.normal(size=(4, 500, 2)) * 5
    found, error_px = triangulate(rig, keypoints)
    assert np.median(np.linalg.norm(found - points, axis=1)) < 0.03
    assert 3 < np.median(error_px) < 7


def test_fewer_than_two_views_give_nan():
    rig = ring_of_cameras(3)
    keypoints = imaged(rig, np.array([[0.0, 1.0, 0.0], [0.2, 1.0, 0.1], [0.3, 1.2, 0.0]]))
    keypoints[1:, 0, 2] = 0.0
    keypoints[:, 1] = [np.nan, np.nan, 0.0]
    found, error_px = triangulate(rig, keypoints)
    assert np.isnan(found[:2]).all() and np.isnan(error_px[:2]).all()
    assert np.isfinite(found[2]).all()


def test_two_views_that_disagree_give_nan():
    rig = ring_of_cameras(3)
    keypoints = imaged(rig, np.array([[0.0, 1.0, 0.0]]))
    keypoints[2, :, 2] = 0.0
    keypoints[1, 0, 1] += 300
    found, _ = triangulate(rig, keypoints)
    assert np.isnan(found).all()


def test_nan_pixels_with_confidence_are_missing():
    rig = ring_of_cameras(4)
    keypoints = imaged(rig, np.array([[0.0, 1.0, 0.0]]))
    keypoints[0, 0, 0] = np.nan
    keypoints[1, 0, 1] = np.inf
    found, _ = triangulate(rig, keypoints)
    np.testing.assert_allclose(found, [[0.0, 1.0, 0.0]], atol=1e-4)


def test_no_camera_gives_nan():
    found, _ = triangulate(Rig(cameras=()), np.zeros((0, 25, 3)))
    assert found.shape == (25, 3) and np.isnan(found).all()
