"""Derivatives of a pixel by camera and point, against finite differences of `Camera.project`."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from derivatives import assert_jacobian
from fusecap.geometry.projection_derivatives import moved, projection_derivatives
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
    assert_jacobian(lambda delta: moved(camera, delta).project(points), d_camera, atol=1e-4)
    assert_jacobian(lambda delta: camera.project(points + delta), d_point, atol=1e-4)
