"""Who is who across views: rays, distances between skeletons and detections, triangulation.

Detections of all cameras lie flat, n people of k keypoints, grouped by camera. `undistort` turns
their pixels once into rays (X/Z, Y/Z, confidence), after which no kernel here meets lens
distortion again. A distance between a 3D skeleton and a detection is metric: the offset on the
image plane times the depth of the landmark, so that near and far people share one gate.

Missing numbers are asked for with `isnan`: `isfinite` of an expression computes x - x, which
`fastmath` may reassociate to zero.

`person` (t, c) names for each track and camera a row of the detections, or -1.
"""

from __future__ import annotations

import math

import numpy as np

from fusecap.kernels.jit import kernel

# Packed camera rows, see fusecap.geometry.camera.PACKED_SIZE.
_FX, _FY, _CX, _CY, _K1, _K2, _P1, _P2, _K3, _SCALE, _MAX_R2 = range(12, 23)

_PARALLEL = 1e-5
"""Determinant of the normalised information of a point, below which rays are parallel (0.4 deg)."""

_OUTLIER = 3.0
"""A view farther from a triangulated point than this many robust scales did not image it."""


@kernel("void(f8[:, ::1], i8[::1], f8[:, :, ::1], f8[:, :, ::1])")
def undistort(cameras, camera_of, keypoints, rays_out):
    """Rays (X/Z, Y/Z, confidence) of keypoints in pixels; all zero where one is missing."""
    people, landmarks = keypoints.shape[:2]
    for n in range(people):
        cam = cameras[camera_of[n]]
        k1, k2, p1, p2, k3 = cam[_K1], cam[_K2], cam[_P1], cam[_P2], cam[_K3]
        straight = k1 == 0.0 and k2 == 0.0 and p1 == 0.0 and p2 == 0.0 and k3 == 0.0
        for k in range(landmarks):
            rays_out[n, k, :] = 0.0
            confidence = keypoints[n, k, 2]
            u = (keypoints[n, k, 0] - cam[_CX]) / cam[_FX]
            v = (keypoints[n, k, 1] - cam[_CY]) / cam[_FY]
            if not (confidence > 0.0 and -np.inf < u < np.inf and -np.inf < v < np.inf):
                continue
            x, y = u, v
            if not straight:
                for _ in range(30):
                    r2 = x * x + y * y
                    radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
                    dx = u - (x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x))
                    dy = v - (y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y)
                    x += dx
                    y += dy
                    if dx * dx + dy * dy < 1e-14:
                        break
                if not x * x + y * y <= cam[_MAX_R2]:
                    continue
            rays_out[n, k, 0] = x
            rays_out[n, k, 1] = y
            rays_out[n, k, 2] = min(confidence, 1.0)


@kernel("f8(f8, f8)")
def _length(x, y):
    return math.sqrt(x * x + y * y)


@kernel("UniTuple(f8, 3)(f8[::1], f8[::1])")
def _in_camera(cam, point):
    return (
        cam[0] * point[0] + cam[1] * point[1] + cam[2] * point[2] + cam[9],
        cam[3] * point[0] + cam[4] * point[1] + cam[5] * point[2] + cam[10],
        cam[6] * point[0] + cam[7] * point[1] + cam[8] * point[2] + cam[11],
    )


@kernel("void(f8[:, ::1], i8[::1], f8[:, :, ::1], b1[::1], f8[:, :, ::1], f8, i8, f8[:, ::1])")
def match_distance(
    cameras,
    camera_of,
    rays,
    wanted,
    points_in_world,
    truncation_m,
    min_common,
    distance_out,
):
    """Mean distance [m] (t, n) of each skeleton to each detection.

    Weighted by confidence, each landmark's distance truncated; infinite where fewer than
    `min_common` landmarks are known in both, and for detections (n,) that are not `wanted`.
    """
    tracks, landmarks = points_in_world.shape[:2]
    projected = np.empty((landmarks, 3))
    for t in range(tracks):
        last = -1
        for n in range(len(rays)):
            if not wanted[n]:
                distance_out[t, n] = np.inf
                continue
            camera = camera_of[n]
            if camera != last:
                last = camera
                for k in range(landmarks):
                    x, y, z = _in_camera(cameras[camera], points_in_world[t, k])
                    projected[k, 0] = x / z
                    projected[k, 1] = y / z
                    projected[k, 2] = z if z > 0.0 else np.nan
            total = weight = 0.0
            common = 0
            for k in range(landmarks):
                z = projected[k, 2]
                w = rays[n, k, 2]
                if w > 0.0 and not math.isnan(z):
                    dx, dy = rays[n, k, 0] - projected[k, 0], rays[n, k, 1] - projected[k, 1]
                    total += w * min(z * _length(dx, dy), truncation_m)
                    weight += w
                    common += 1
            distance_out[t, n] = total / weight if common >= min_common else np.inf


@kernel("void(f8[:, ::1], i8[::1], f8[:, :, ::1], i8[:, ::1], f8, i8, f8[:, :, ::1], f8[::1])")
def triangulate_pairs(
    cameras, camera_of, rays, pairs, max_error_px, min_common, points_out, error_out
):
    """Landmarks (h, k, 3) of each pair of detections, and their mean reprojection error (h).

    A landmark is the midpoint of the shortest segment between its two rays. Errors are pixels of
    a 1920-pixel-wide image; infinite where the mean exceeds `max_error_px` or fewer than
    `min_common` landmarks are seen in both.
    """
    landmarks = rays.shape[1]
    point = np.empty(3)
    for h in range(len(pairs)):
        a, b = pairs[h]
        cam_a, cam_b = cameras[camera_of[a]], cameras[camera_of[b]]
        points_out[h] = np.nan
        error_out[h] = np.inf
        common = 0
        for k in range(landmarks):
            if rays[a, k, 2] > 0.0 and rays[b, k, 2] > 0.0:
                common += 1
        if common < min_common:
            continue
        px_a = 0.5 * (cam_a[_FX] + cam_a[_FY]) * cam_a[_SCALE]
        px_b = 0.5 * (cam_b[_FX] + cam_b[_FY]) * cam_b[_SCALE]
        # Centres of projection and the segment between them.
        ax = -(cam_a[0] * cam_a[9] + cam_a[3] * cam_a[10] + cam_a[6] * cam_a[11])
        ay = -(cam_a[1] * cam_a[9] + cam_a[4] * cam_a[10] + cam_a[7] * cam_a[11])
        az = -(cam_a[2] * cam_a[9] + cam_a[5] * cam_a[10] + cam_a[8] * cam_a[11])
        bx = -(cam_b[0] * cam_b[9] + cam_b[3] * cam_b[10] + cam_b[6] * cam_b[11])
        by = -(cam_b[1] * cam_b[9] + cam_b[4] * cam_b[10] + cam_b[7] * cam_b[11])
        bz = -(cam_b[2] * cam_b[9] + cam_b[5] * cam_b[10] + cam_b[8] * cam_b[11])
        cx, cy, cz = bx - ax, by - ay, bz - az
        total = 0.0
        good = 0
        for k in range(landmarks):
            if not (rays[a, k, 2] > 0.0 and rays[b, k, 2] > 0.0):
                continue
            x, y = rays[a, k, 0], rays[a, k, 1]
            ux = cam_a[0] * x + cam_a[3] * y + cam_a[6]
            uy = cam_a[1] * x + cam_a[4] * y + cam_a[7]
            uz = cam_a[2] * x + cam_a[5] * y + cam_a[8]
            x, y = rays[b, k, 0], rays[b, k, 1]
            vx = cam_b[0] * x + cam_b[3] * y + cam_b[6]
            vy = cam_b[1] * x + cam_b[4] * y + cam_b[7]
            vz = cam_b[2] * x + cam_b[5] * y + cam_b[8]
            uu = ux * ux + uy * uy + uz * uz
            vv = vx * vx + vy * vy + vz * vz
            uv = ux * vx + uy * vy + uz * vz
            determinant = uu * vv - uv * uv
            if determinant < _PARALLEL * uu * vv:
                common -= 1
                continue
            uc = ux * cx + uy * cy + uz * cz
            vc = vx * cx + vy * cy + vz * cz
            along_a = (uc * vv - vc * uv) / determinant
            along_b = (uc * uv - vc * uu) / determinant
            if along_a <= 0.0 or along_b <= 0.0:
                total = np.inf
                break
            point[0] = 0.5 * (ax + along_a * ux + bx + along_b * vx)
            point[1] = 0.5 * (ay + along_a * uy + by + along_b * vy)
            point[2] = 0.5 * (az + along_a * uz + bz + along_b * vz)
            x, y, z = _in_camera(cam_a, point)
            total += 0.5 * px_a * _length(x / z - rays[a, k, 0], y / z - rays[a, k, 1])
            x, y, z = _in_camera(cam_b, point)
            total += 0.5 * px_b * _length(x / z - rays[b, k, 0], y / z - rays[b, k, 1])
            points_out[h, k] = point
            good += 1
            if total > max_error_px * common:
                break
        if good >= min_common and total <= max_error_px * good:
            error_out[h] = total / good


@kernel("b1(f8[:, ::1], f8[::1], f8[::1])")
def _solve3(h, g, x_out):
    """X = h⁻¹ g by Cramer's rule for symmetric h; False where h is close to singular."""
    a = h[1, 1] * h[2, 2] - h[1, 2] * h[1, 2]
    b = h[0, 2] * h[1, 2] - h[0, 1] * h[2, 2]
    c = h[0, 1] * h[1, 2] - h[0, 2] * h[1, 1]
    determinant = h[0, 0] * a + h[0, 1] * b + h[0, 2] * c
    mean = (h[0, 0] + h[1, 1] + h[2, 2]) / 3.0
    if not determinant > _PARALLEL * mean * mean * mean:
        return False
    d = h[0, 0] * h[2, 2] - h[0, 2] * h[0, 2]
    e = h[0, 1] * h[0, 2] - h[0, 0] * h[1, 2]
    f = h[0, 0] * h[1, 1] - h[0, 1] * h[0, 1]
    x_out[0] = (a * g[0] + b * g[1] + c * g[2]) / determinant
    x_out[1] = (b * g[0] + d * g[1] + e * g[2]) / determinant
    x_out[2] = (c * g[0] + e * g[1] + f * g[2]) / determinant
    return True


@kernel("void(f8[::1], f8, f8, f8, f8, f8, f8[:, ::1], f8[::1])")
def _add_row(cam, x, y, offset_x, offset_y, weight, h, g):
    """Add weight (aᵀa, aᵀb) of the rows a = R₁ - x R₃ and R₂ - y R₃, with b = -offset."""
    for row in range(2):
        v = y if row else x
        b = -(offset_y if row else offset_x)
        base = 3 * row
        a0 = cam[base] - v * cam[6]
        a1 = cam[base + 1] - v * cam[7]
        a2 = cam[base + 2] - v * cam[8]
        h[0, 0] += weight * a0 * a0
        h[0, 1] += weight * a0 * a1
        h[0, 2] += weight * a0 * a2
        h[1, 1] += weight * a1 * a1
        h[1, 2] += weight * a1 * a2
        h[2, 2] += weight * a2 * a2
        g[0] += weight * a0 * b
        g[1] += weight * a1 * b
        g[2] += weight * a2 * b


@kernel("f8(f8[:, ::1], i8[::1], f8[:, ::1], i8, f8, f8[::1], f8[::1])")
def _residuals(cameras, camera, row, views, scale_px, point, residual_px_out):
    """Truncated square cost of a point; its residual per view [px at 1920], inf behind a camera."""
    cost = 0.0
    for v in range(views):
        x, y, z = _in_camera(cameras[camera[v]], point)
        residual_px_out[v] = np.inf
        if z > 0.0:
            residual_px_out[v] = row[v, 3] * _length(x / z - row[v, 0], y / z - row[v, 1])
        cost += row[v, 2] * min(residual_px_out[v] / scale_px, _OUTLIER) ** 2
    return cost


@kernel("b1(f8[:, ::1], i8[::1], f8[:, ::1], i8, i8, f8[:, ::1], f8[::1], f8[::1])")
def _linear(cameras, camera, row, views, without, h, g, point_out):
    """DLT of all views but one (-1: of all)."""
    h[:] = 0.0
    g[:] = 0.0
    for v in range(views):
        if v != without:
            cam = cameras[camera[v]]
            x, y = row[v, 0], row[v, 1]
            weight = row[v, 2] * row[v, 3] ** 2
            _add_row(cam, x, y, cam[9] - x * cam[11], cam[10] - y * cam[11], weight, h, g)
    return _solve3(h, g, point_out)


@kernel("b1(f8[:, ::1], i8[::1], f8[:, ::1], i8, i8, f8[:, ::1], f8[::1], f8[::1])")
def _of_two(cameras, camera, row, first, second, h, g, point_out):
    """DLT of two views."""
    h[:] = 0.0
    g[:] = 0.0
    for v in (first, second):
        cam = cameras[camera[v]]
        x, y = row[v, 0], row[v, 1]
        weight = row[v, 2] * row[v, 3] ** 2
        _add_row(cam, x, y, cam[9] - x * cam[11], cam[10] - y * cam[11], weight, h, g)
    return _solve3(h, g, point_out)


@kernel(
    "f8(f8[:, ::1], i8[::1], f8[:, ::1], i8, f8, f8[:, ::1], f8[::1], f8[:, ::1], f8[::1], f8[::1])"
)
def _triangulate_point(cameras, camera, row, views, scale_px, h, g, points, residual_px, point_out):
    """Point of least Cauchy cost [1, eq. 17] and its mean error over inliers; NaN without two.

    `row` holds per view x, y, confidence and pixels (at 1920) per unit of x. The linear solution
    is the start; where a view contradicts it, that without the worst view; where that does not
    help either, the best solution of two views.
    """
    best, trial = points[0], points[1]
    limit_px = _OUTLIER * scale_px
    point_out[:] = np.nan
    cost = np.inf
    worst = -1
    if _linear(cameras, camera, row, views, -1, h, g, best):
        cost = _residuals(cameras, camera, row, views, scale_px, best, residual_px)
        worst = np.argmax(residual_px[:views])
    if views > 2 and (worst < 0 or residual_px[worst] > limit_px):
        settled = False
        if worst >= 0 and _linear(cameras, camera, row, views, worst, h, g, trial):
            other = _residuals(cameras, camera, row, views, scale_px, trial, residual_px)
            residual_px[worst] = 0.0
            settled = views > 3 and residual_px[:views].max() <= limit_px
            if other < cost:
                cost = other
                best[:] = trial
        if not settled:
            for first in range(views):
                for second in range(first):
                    if _of_two(cameras, camera, row, first, second, h, g, trial):
                        other = _residuals(
                            cameras, camera, row, views, scale_px, trial, residual_px
                        )
                        if other < cost:
                            cost = other
                            best[:] = trial
    if cost == np.inf:
        return np.nan
    for _ in range(12):
        h[:] = 0.0
        g[:] = 0.0
        for v in range(views):
            cam = cameras[camera[v]]
            x, y, z = _in_camera(cam, best)
            if z <= 0.0:
                continue
            x /= z
            y /= z
            dx, dy = x - row[v, 0], y - row[v, 1]
            ratio = row[v, 3] / scale_px
            robust = 1.0 + ratio * ratio * (dx * dx + dy * dy)
            weight = row[v, 2] * (row[v, 3] / z) ** 2 / robust
            _add_row(cam, x, y, z * dx, z * dy, weight, h, g)
        if not _solve3(h, g, trial):
            return np.nan
        best += trial
        if trial[0] ** 2 + trial[1] ** 2 + trial[2] ** 2 < 1e-8:
            break
    _residuals(cameras, camera, row, views, scale_px, best, residual_px)
    inliers = 0
    error = 0.0
    for v in range(views):
        if residual_px[v] < limit_px:
            inliers += 1
            error += residual_px[v]
    if inliers < 2:
        return np.nan
    point_out[:] = best
    return error / inliers


@kernel("void(f8[:, ::1], f8[:, :, ::1], i8[::1], f8, f8[:, ::1], f8[::1])")
def triangulate_person(cameras, rays, person, scale_px, points_out, error_px_out):
    """Landmarks (k, 3) of one person from the detections `person` (c,), NaN without two views.

    `scale_px` is where the Cauchy loss turns, in pixels of a 1920-pixel-wide image, and so is the
    mean reprojection error (k,) over the views that agree.
    """
    views = len(person)
    camera = np.empty(views, np.int64)
    row = np.empty((views, 4))
    h, g = np.empty((3, 3)), np.empty(3)
    points, residual_px = np.empty((2, 3)), np.empty(views)
    for k in range(rays.shape[1]):
        count = 0
        for c in range(views):
            n = person[c]
            if n >= 0 and rays[n, k, 2] > 0.0:
                camera[count] = c
                row[count, 0] = rays[n, k, 0]
                row[count, 1] = rays[n, k, 1]
                row[count, 2] = rays[n, k, 2]
                row[count, 3] = 0.5 * (cameras[c, _FX] + cameras[c, _FY]) * cameras[c, _SCALE]
                count += 1
        if count < 2:
            points_out[k] = np.nan
            error_px_out[k] = np.nan
        else:
            error_px_out[k] = _triangulate_point(
                cameras, camera, row, count, scale_px, h, g, points, residual_px, points_out[k]
            )


@kernel("f8(f8[::1], f8[:, ::1], f8[:, ::1], f8, i8)")
def _view_distance(cam, ray, points, truncation_m, min_common):
    """Mean truncated distance [m] of one detection to a skeleton; 0 where too little is common."""
    total = weight = 0.0
    common = 0
    for k in range(len(points)):
        w = ray[k, 2]
        if w > 0.0 and not math.isnan(points[k, 0]):
            x, y, z = _in_camera(cam, points[k])
            d = truncation_m
            if z > 0.0:
                d = min(d, z * _length(ray[k, 0] - x / z, ray[k, 1] - y / z))
            total += w * d
            weight += w
            common += 1
    return total / weight if common >= min_common else 0.0


@kernel("f8(f8[:, ::1], f8[:, :, ::1], i8[::1], f8[:, ::1], f8, i8)")
def _farthest_view(cameras, rays, person, points, truncation_m, min_common):
    """Distance [m] to the skeleton of the detection in `person` that lies farthest from it."""
    farthest = 0.0
    for c in range(len(person)):
        if person[c] >= 0:
            d = _view_distance(cameras[c], rays[person[c]], points, truncation_m, min_common)
            farthest = max(farthest, d)
    return farthest


@kernel(
    "void(f8[:, ::1], f8[:, :, ::1], f8[:, ::1], f8, f8, i8, f8, i8[:, ::1], "
    "f8[:, :, ::1], f8[:, ::1])"
)
def drop_contradicting_views(
    cameras,
    rays,
    prior_m,
    max_distance_m,
    truncation_m,
    min_common,
    scale_px,
    person,
    points_out,
    error_px_out,
):
    """Triangulate each track and set to -1, in place, the views of `person` that disagree.

    While some view is farther than `max_distance_m` from the skeleton, one goes: of four and more
    the farthest, for the others outvote it; of three the one without which the other two agree
    best; of two the one farther from the prediction, by `prior_m` (t, n).
    """
    tracks, views = person.shape
    landmarks = rays.shape[1]
    trial = np.empty(views, np.int64)
    points, error = np.empty((landmarks, 3)), np.empty(landmarks)
    for t in range(tracks):
        while True:
            triangulate_person(cameras, rays, person[t], scale_px, points_out[t], error_px_out[t])
            farthest = _farthest_view(
                cameras, rays, person[t], points_out[t], truncation_m, min_common
            )
            count = 0
            for c in range(views):
                if person[t, c] >= 0:
                    count += 1
            # Two rays can pass so far from each other that hardly a landmark survives.
            apart = False
            if count == 2:
                shared = found = 0
                for k in range(landmarks):
                    seeing = 0
                    for c in range(views):
                        if person[t, c] >= 0 and rays[person[t, c], k, 2] > 0.0:
                            seeing += 1
                    shared += seeing == 2
                    found += not math.isnan(points_out[t, k, 0])
                apart = shared >= min_common and found < min_common
            if count < 2 or (farthest <= max_distance_m and not apart):
                break
            out = -1
            least = np.inf
            for c in range(views):
                if person[t, c] < 0:
                    continue
                if count == 2:
                    remaining = -prior_m[t, person[t, c]]
                elif count == 3:
                    trial[:] = person[t]
                    trial[c] = -1
                    triangulate_person(cameras, rays, trial, scale_px, points, error)
                    found = 0
                    for k in range(landmarks):
                        found += not math.isnan(points[k, 0])
                    remaining = truncation_m
                    if found >= min_common:
                        remaining = _farthest_view(
                            cameras, rays, trial, points, truncation_m, min_common
                        )
                else:
                    remaining = -_view_distance(
                        cameras[c], rays[person[t, c]], points_out[t], truncation_m, min_common
                    )
                if remaining < least or out < 0:
                    least = remaining
                    out = c
            person[t, out] = -1


@kernel("void(f8[:, :, ::1], f8[:, :, ::1], f8[::1], f8, f8, f8[:, :, ::1], f8[:, :, ::1])")
def move_tracks(measured, predicted, dt_s, position_gain, velocity_gain, landmarks, velocity):
    """Constant-velocity update, in place, of landmarks [m] (t, k, 3) and velocities [m/s].

    A landmark without a measurement moves by the median news of the others; one that had no
    prediction starts where it is measured.
    """
    tracks, count = landmarks.shape[:2]
    news = np.empty(count)
    for t in range(tracks):
        for i in range(3):
            known = 0
            for k in range(count):
                d = measured[t, k, i] - predicted[t, k, i]
                if not math.isnan(d):
                    news[known] = d
                    known += 1
            common = np.median(news[:known]) if known else 0.0
            for k in range(count):
                d = measured[t, k, i] - predicted[t, k, i]
                moved = predicted[t, k, i] + position_gain * (common if math.isnan(d) else d)
                if math.isnan(moved):
                    moved = measured[t, k, i]
                change = moved - landmarks[t, k, i]
                if dt_s[t] > 0.0 and not math.isnan(change):
                    velocity[t, k, i] += velocity_gain * (change / dt_s[t] - velocity[t, k, i])
                landmarks[t, k, i] = moved


@kernel("b1(f8[:, ::1], f8[::1], i8[::1], b1[::1], i8[:, ::1], b1[:, ::1])")
def assign_undisputed(distance_m, gate_m, camera_of, free, person, disputed_out):
    """Assign, in place, the pairs (t, n) inside the gate that nobody else is near to.

    `disputed_out` marks the pairs that remain to be decided; the result says whether there are any.
    """
    tracks, people = distance_m.shape
    rivals = np.zeros(people, np.int64)
    choices = np.zeros(person.shape, np.int64)
    for t in range(tracks):
        for n in range(people):
            c = camera_of[n]
            near = free[n] and person[t, c] < 0 and distance_m[t, n] < gate_m[t]
            disputed_out[t, n] = near
            rivals[n] += near
            choices[t, c] += near
    remains = False
    for t in range(tracks):
        for n in range(people):
            if disputed_out[t, n]:
                if rivals[n] == 1 and choices[t, camera_of[n]] == 1:
                    person[t, camera_of[n]] = n
                    free[n] = False
                    disputed_out[t, n] = False
                else:
                    remains = True
    return remains


@kernel("void(f8[:, :, ::1], f8, i8, b1[:, ::1])")
def coincide(points, limit_m, min_common, same_out):
    """Which skeletons of (t, k, 3) have most of their common landmarks within the limit (t, t)."""
    tracks, landmarks = points.shape[:2]
    for a in range(tracks):
        same_out[a, a] = True
        for b in range(a):
            common = close = 0
            for k in range(landmarks):
                dx = points[a, k, 0] - points[b, k, 0]
                dy = points[a, k, 1] - points[b, k, 1]
                dz = points[a, k, 2] - points[b, k, 2]
                squared = dx * dx + dy * dy + dz * dz
                common += not math.isnan(squared)
                close += squared < limit_m * limit_m
            same_out[a, b] = same_out[b, a] = common >= min_common and 2 * close > common
