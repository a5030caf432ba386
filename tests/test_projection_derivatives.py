"""Derivatives of a pixel by camera and point, against finite differences of `Camera.project`."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from fusecap.geometry.projection_derivatives import PARAMETERS, moved, projection_derivatives
from people_scene import ring_of_cameras


def distorted_camera():
    camera = ring_of_cameras(3).cameras[1]
    return replace(camera, distortion=np.array([-0.21, 0.08, 0.003, -0.004, -0.01]))


def test_pixels_are_those_of_the_camera(rng):
    camera = distorted_camera()
    points = rng.uniform([-1, 0.2, -1], [1, 1.8, 1], (20, 3))
    pixels, _, _ = projection_derivatives(camera, points)
    np.testing.assert_allclose(pixels, camera.project(points), atol=1e-9)


def test_derivatives_are_those_of_finite_differences(rng):
    camera = distorted_camera()
    points = rng.uniform([-1, 0.2, -1], [1, 1.8, 1], (20, 3))
    _, d_camera, d_point = projection_derivatives(camera, points)
    for parameter in range(PARAMETERS):
        step = np.zeros(PARAMETERS)
        step[parameter] = 1e-6
        slope = (moved(camera, step).project(points) - moved(camera, -step).project(points)) / 2e-6
        np.testing.assert_allclose(d_camera[:, :, parameter], slope, rtol=1e-5, atol=1e-4)
    for axis in range(3):
        step = np.eye(3)[axis] * 1e-6
        slope = (camera.project(points + step) - camera.project(points - step)) / 2e-6
        np.testing.assert_allclose(d_point[:, :, axis], slope, rtol=1e-5, atol=1e-4)
