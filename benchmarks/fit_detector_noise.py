"""Measures a 2D detector's faults on real detections, in the terms of `KeypointNoise`.

    uv run python benchmarks/fit_detector_noise.py DATA_FOLDER [--recording shelf|pose2sim]

DATA_FOLDER holds `shelf/` (OpenPose BODY_25, 25 Hz; frames 150-300 count, those with truth do not)
and `pose2sim_demo/` (BODY_25B, 60 Hz, the balancing trial). Each recording is solved with default
options; a keypoint's error is its distance from the image of the solved landmark. What the solve
follows of an error is missing from it, and where a calibration is loose its error is in: so the
mean over each person, camera and landmark is taken out first, and stated as bias.
"""

from __future__ import annotations

import argparse
import tarfile
import tempfile
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.optimize import linear_sum_assignment, nnls
from scipy.stats import rankdata
from shelf import write_shelf_session

from fusecap.batch.solve import solve_session
from fusecap.body.landmarks import LandmarkSet
from fusecap.body.pose import landmarks_in_world
from fusecap.evaluate.keypoint_noise import (
    APPARENT_HEIGHT_PX,
    body_capsules,
    occluded,
    together,
)
from fusecap.sources.session_data import SessionData, open_session
from fusecap.sources.session_file import load_session

_GATE = 0.25
"""A detection this share of a person's height away, in the median, is not of that person."""
_LIMBS = {
    "arms": ("elbow", "wrist"),
    "legs": ("knee", "ankle", "big_toe", "small_toe", "heel"),
}


class Recording(NamedTuple):
    """P solved people against the detections of C cameras over T frames; lengths in px at 1920."""

    landmarks: LandmarkSet
    rate_hz: float
    seen: np.ndarray
    """(C, T, P, K, 2) images of solved landmarks; NaN where out of the image or not solved."""
    found: np.ndarray
    """(C, T, P, K, 3) keypoints of the detection that is the person; NaN where there is none."""
    hidden: np.ndarray
    """(C, T, P, K) behind a body."""
    apparent_px: np.ndarray
    """(C, T, P) stature in the image."""
    metres_per_px: np.ndarray
    """(C, T, P)"""
    nobody: np.ndarray
    """(C, T) detections that are no solved person."""


def shelf(folder: Path) -> Recording:
    with tempfile.TemporaryDirectory() as target:
        path = write_shelf_session(folder / "shelf", Path(target), frames=301, floor=True)
        return _recording(open_session(load_session(path)), frames=slice(150, 301))


def pose2sim(folder: Path) -> Recording:
    clip = folder / "pose2sim_demo" / "v0.8.4_openpose_body25b"
    trial = "S00_P00_SingleParticipant/S00_P00_T01_BalancingTrial/pose"
    text = f"[session]\nname = 'clip'\ncalibration = '{(clip / 'Calib.qca.txt').resolve()}'\n"
    text += "up = 'z'\nrate_hz = 60.0\nfloor = false\n"
    for camera in ("01", "02", "03", "04"):
        text += f"[[camera]]\nname = 'cam_{camera}'\nformat = 'openpose-body25b'\n"
        text += f"keypoints = '{trial}/cam{camera}_json'\n"
    with tempfile.TemporaryDirectory() as target:
        with tarfile.open(clip / "pose_json.tar.xz") as archive:
            archive.extractall(target, filter="data")
        (Path(target) / "session.toml").write_text(text)
        return _recording(open_session(load_session(target)), frames=slice(0, None))


def _recording(data: SessionData, *, frames: slice) -> Recording:
    take = solve_session(data).whole_take
    if data.landmarks is None:
        raise SystemExit("the recording has no keypoints")
    instants = np.arange(len(take.timestamps_ns))[frames]
    cameras, people, count = len(data.rig), len(take.subject_names), len(data.landmarks.mirror)
    size = (cameras, len(instants), people, count)
    seen, found = np.full((*size, 2), np.nan), np.full((*size, 3), np.nan)
    hidden = np.zeros(size, dtype=bool)
    apparent, metres = np.full(size[:3], np.nan), np.full(size[:3], np.nan)
    nobody = np.zeros(size[:2], dtype=int)
    points, capsules = [], []
    for person in range(people):
        shape = take.shape(person)
        position = np.nan_to_num(take.bone_position_in_world_m[person, instants])
        rotation = np.nan_to_num(take.bone_rotation_in_world(person)[instants])
        where = landmarks_in_world(
            position, rotation, data.landmarks.bones(take.skeleton), data.landmarks.offsets_m(shape)
        )
        # People who are not there at an instant stand where they hide nobody.
        gone = ~take.tracked[person, instants]
        position[gone] += [0.0, -1e3, 0.0]
        points.append(np.where(gone[:, None, None], np.nan, where))
        capsules.append(body_capsules(shape, position, rotation))
    world = np.stack(points, axis=1)
    for index, camera in enumerate(data.rig.cameras):
        scale = camera.pixel_scale
        flat = world.reshape(len(instants), people * count, 3)
        pixels = camera.project(flat.reshape(-1, 3)).reshape(size[1:] + (2,))
        width, height = camera.size_px
        inside = np.asarray((pixels >= 0).all(axis=-1) & (pixels < [width, height]).all(axis=-1))
        seen[index] = np.where(inside[..., None], pixels, np.nan) * scale
        hidden[index] = occluded(camera, np.nan_to_num(flat), together(capsules)).reshape(size[1:])
        depth = np.median(world @ camera.rotation[2] + camera.translation[2], axis=2)
        focal = camera.matrix[0, 0] * scale
        apparent[index] = focal * take.heights_m / depth
        metres[index] = depth / focal
    for row, instant in enumerate(instants):
        for index, detected in enumerate(data.detections(int(instant)).people):
            scaled = detected.copy()
            scaled[..., :2] *= data.rig.cameras[index].pixel_scale
            pairs = _same_person(seen[index, row], scaled, apparent[index, row])
            for person, detection in pairs:
                found[index, row, person] = scaled[detection]
            nobody[index, row] = len(scaled) - len(pairs)
    return Recording(
        data.landmarks,
        data.session.settings.rate_hz,
        seen,
        found,
        hidden,
        apparent,
        metres,
        nobody,
    )


def _same_person(
    seen: np.ndarray, detected: np.ndarray, apparent_px: np.ndarray
) -> list[tuple[int, int]]:
    """Pairs of person and detection, one to one."""
    cost = np.full((len(seen), len(detected)), 10.0)
    for i, person in enumerate(seen):
        for j, other in enumerate(detected):
            distance = np.linalg.norm(person - other[:, :2], axis=-1)
            if np.isfinite(distance).sum() >= 4:
                cost[i, j] = np.nanmedian(distance) / apparent_px[i]
    return [(i, j) for i, j in zip(*linear_sum_assignment(cost), strict=True) if cost[i, j] < _GATE]


def fitted(recording: Recording) -> dict[str, str]:
    """What `KeypointNoise` would have to be, each with its number."""
    r = recording
    names = r.landmarks.landmark_names
    there = np.isfinite(r.found[..., 0]) & np.isfinite(r.seen[..., 0])
    residual = np.where(there[..., None], r.found[..., :2] - r.seen, np.nan)
    swapped, table = _swaps(r)
    residual[swapped] = np.nan

    with np.errstate(all="ignore"):
        mean = np.nanmedian(residual, axis=1, keepdims=True)
    enough = np.isfinite(residual[..., 0]).sum(axis=1, keepdims=True) >= r.rate_hz
    bias = np.where(enough[..., None], mean, np.nan)
    bias_m = bias[:, 0] * np.nanmedian(r.metres_per_px, axis=1)[..., None, None]
    table["bias [mm per axis]"] = f"{_sigma(bias_m) * 1e3:.1f}"
    change = residual - bias

    apparent = np.broadcast_to(r.apparent_px[..., None], change.shape[:-1])
    unit = change / apparent[..., None] * APPARENT_HEIGHT_PX
    clear = ~r.hidden
    speed = np.full(change.shape[:-1], np.nan)
    speed[:, 1:-1] = np.linalg.norm(r.seen[:, 2:] - r.seen[:, :-2], axis=-1) * r.rate_hz / 2

    table |= _size_and_speed(change[clear], apparent[clear], speed[clear])
    table["sigma at 600 px [px]"] = f"{_sigma(unit[clear]):.2f}"
    table["sigma hidden / clear"] = f"{_sigma(unit[r.hidden]) / _sigma(unit[clear]):.2f}"
    for part in sorted({name.removeprefix("left_").removeprefix("right_") for name in names}):
        rows = [i for i, name in enumerate(names) if name.endswith(part)]
        own = unit[..., rows, :][clear[..., rows]]
        table[f"  sigma of {part} / all"] = f"{_sigma(own) / _sigma(unit[clear]):.2f}"

    lag = round(r.rate_hz / 25.0) or 1
    a, b = unit[:, :-lag], unit[:, lag:]
    both = np.isfinite(a) & np.isfinite(b) & (np.abs(a) < 30) & (np.abs(b) < 30)
    lag1 = float(np.corrcoef(a[both], b[both])[0, 1])
    table["correlation over 1/25 s"] = f"{lag1:.2f}"
    table["correlation time [s]"] = f"{-(lag / r.rate_hz) / np.log(lag1):.3f}"

    sigma = _sigma(unit[clear])
    error = np.linalg.norm(unit, axis=-1) / sigma
    outlier = error > 5.0
    known = np.isfinite(error)
    table["beyond 5 sigma, clear [%]"] = f"{100 * outlier[known & clear].mean():.2f}"
    table["beyond 5 sigma, hidden [%]"] = f"{100 * outlier[known & r.hidden].mean():.2f}"
    table["  outliers' run [s]"] = f"{_run_s(outlier, known, r.rate_hz):.3f}"
    far = error * sigma / APPARENT_HEIGHT_PX
    table["  their distance by stature, quartiles"] = _quartiles(far[known & outlier], ".2f")

    in_view = np.isfinite(r.seen[..., 0])
    detected = np.asarray(there.any(axis=-1, keepdims=True))
    missed = ~np.isfinite(r.found[..., 0])
    due = in_view & detected
    table["missed, clear [%]"] = f"{100 * missed[due & clear].mean():.2f}"
    table["missed, hidden [%]"] = f"{100 * missed[due & r.hidden].mean():.2f}"
    table["  misses' run [s]"] = f"{_run_s(missed & due & clear, due, r.rate_hz):.3f}"
    table["  hidden and missed, run [s]"] = f"{_run_s(missed & due & r.hidden, due, r.rate_hz):.3f}"
    whole = in_view.mean(axis=-1) > 0.8
    open_ = (in_view & clear).mean(axis=-1)
    for label, rows in (("most clear", open_ > 0.6), ("mostly hidden", open_ < 0.3)):
        gone = ~detected[..., 0]
        table[f"people missed, {label} [%]"] = f"{100 * gone[whole & rows].mean():.2f}"
    run_s = _run_s(~detected[..., 0] & whole, whole, r.rate_hz)
    table["  missed people's run [s]"] = f"{run_s:.3f}"
    table["nobody's detections per view and frame"] = f"{r.nobody.mean():.3f}"
    table |= _confidence(error, r.found[..., 2], r.hidden, outlier)
    return table | _confusion(r)


def _sigma(values: np.ndarray) -> float:
    """Standard deviation of the normal with these values' median absolute size."""
    return float(np.nanmedian(np.abs(values))) / 0.6745


def _quartiles(values: np.ndarray, form: str) -> str:
    return " ".join(f"{q:{form}}" for q in np.quantile(values, [0.25, 0.5, 0.75]))


def _run_s(active: np.ndarray, known: np.ndarray, rate_hz: float) -> float:
    """Mean length of runs along the frames (axis 1), where the frame before was known."""
    start = active[:, 1:] & ~active[:, :-1] & known[:, :-1]
    return float(active[:, 1:][known[:, 1:]].sum() / max(start.sum(), 1) / rate_hz)


def _size_and_speed(
    change: np.ndarray, apparent_px: np.ndarray, speed_px_s: np.ndarray
) -> dict[str, str]:
    """sigma² = floor² + (share of apparent height)² + (seconds of image speed)², over bins."""
    known = np.isfinite(change[:, 0]) & np.isfinite(speed_px_s)
    change, size, speed = change[known], apparent_px[known], speed_px_s[known]
    rows, variance, weight = [], [], []
    size_edges = np.quantile(size, np.linspace(0, 1, 7))
    for low, high in pairwise(size_edges):
        here = (size >= low) & (size <= high)
        speed_edges = np.quantile(speed[here], np.linspace(0, 1, 7))
        for slow, fast in pairwise(speed_edges):
            cell = here & (speed >= slow) & (speed <= fast)
            if cell.sum() > 50:
                rows.append([1.0, np.median(size[cell]) ** 2, np.mean(speed[cell] ** 2)])
                variance.append(_sigma(change[cell]) ** 2)
                weight.append(1.0 / variance[-1])
    matrix, w = np.array(rows), np.array(weight)
    scale = matrix.max(axis=0)
    solution = nnls(matrix / scale * w[:, None], np.array(variance) * w)[0] / scale
    floor, share, seconds = np.sqrt(solution)
    return {
        "apparent height, quartiles [px]": _quartiles(size, ".0f"),
        "image speed, quartiles [px/s]": _quartiles(speed, ".0f"),
        "floor [px at 1920]": f"{floor:.2f}",
        "part with size, at 600 px [px]": f"{share * APPARENT_HEIGHT_PX:.2f}",
        "part with image speed [s]": f"{seconds:.4f}",
    }


def _swaps(r: Recording) -> tuple[np.ndarray, dict[str, str]]:
    """Which keypoints lie on the other side's limb, and their share of limbs that could tell."""
    names, mirror = r.landmarks.landmark_names, r.landmarks.mirror
    own = np.linalg.norm(r.found[..., :2] - r.seen, axis=-1)
    other = np.linalg.norm(r.found[..., :2] - r.seen[..., mirror, :], axis=-1)
    apart = np.linalg.norm(r.seen - r.seen[..., mirror, :], axis=-1)
    swapped = np.zeros(own.shape, dtype=bool)
    table = {}
    for limb, parts in _LIMBS.items():
        rows = [i for i, name in enumerate(names) if name.partition("_")[2] in parts]
        tell = (apart > 0.1 * r.apparent_px[..., None])[..., rows] & np.isfinite(own[..., rows])
        told = tell.sum(axis=-1) >= 4
        closer = ((other < own)[..., rows] & tell).sum(axis=-1) >= 0.75 * tell.sum(axis=-1)
        swap = told & closer
        swapped[..., rows] |= swap[..., None]
        table[f"{limb} swapped [%]"] = f"{100 * swap[told].mean():.2f} of {told.sum()}"
        table[f"  {limb} run [s]"] = f"{_run_s(swap, told, r.rate_hz):.3f}"
    return swapped, table


def _confidence(
    error: np.ndarray, confidence: np.ndarray, hidden: np.ndarray, outlier: np.ndarray
) -> dict[str, str]:
    """confidence = a - b log(1 + error) - c hidden + normal noise, by least squares."""
    known = np.isfinite(error) & (confidence > 0)
    e, c, h = error[known & ~outlier], confidence[known & ~outlier], hidden[known & ~outlier]
    matrix = np.stack([np.ones_like(e), -np.log1p(e), -h.astype(float)], axis=1)
    solution = np.linalg.lstsq(matrix, c, rcond=None)[0]
    spread = float(np.std(c - matrix @ solution))
    bad = confidence[known & outlier]
    return {
        "confidence at no error": f"{solution[0]:.3f}",
        "  less per log(1 + error in sigmas)": f"{solution[1]:.3f}",
        "  less when hidden": f"{solution[2]:.3f}",
        "  noise about it": f"{spread:.3f}",
        "confidence beyond 5 sigma, quartiles": _quartiles(bad, ".2f"),
        "rank correlation with error": f"{_rank_correlation(e, c):.2f}",
    }


def _rank_correlation(a: np.ndarray, b: np.ndarray) -> float:
    return float(np.corrcoef(rankdata(a), rankdata(b))[0, 1])


def _confusion(r: Recording) -> dict[str, str]:
    """Limb keypoints that lie on another person whose box covers a third of this one's or more."""
    people = r.seen.shape[2]
    rows = _named(r.landmarks.landmark_names, [part for parts in _LIMBS.values() for part in parts])
    taken, due = 0, 0
    series = []
    for a in range(people):
        for b in range(people):
            if a == b:
                continue
            overlap = _overlap(r.seen[:, :, a], r.seen[:, :, b]) > 1 / 3
            own = np.linalg.norm(r.found[:, :, a, :, :2] - r.seen[:, :, a], axis=-1)
            other = np.linalg.norm(r.found[:, :, a, :, :2] - r.seen[:, :, b], axis=-1)
            size = r.apparent_px[:, :, a, None]
            mine = (own > 0.15 * size) & (other < 0.05 * size)
            known = (np.isfinite(own) & np.isfinite(other) & overlap[..., None])[..., rows]
            taken += int((mine[..., rows] & known).sum())
            due += int(known.sum())
            series.append((mine[..., rows] & known, known))
    if not due:
        return {"taken from an overlapping person [%]": "nobody overlaps"}
    active = np.concatenate([s for s, _ in series])
    known = np.concatenate([k for _, k in series])
    return {
        "taken from an overlapping person [%]": f"{100 * taken / due:.2f} of {due}",
        "  its run [s]": f"{_run_s(active, known, r.rate_hz):.3f}",
    }


def _named(names: Sequence[str], parts: Sequence[str]) -> list[int]:
    return [i for i, name in enumerate(names) if name.partition("_")[2] in parts]


def _overlap(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """(C, T) share of the box of a's landmarks (C, T, K, 2) that b's box covers; 0 where unseen."""
    with np.errstate(all="ignore"):
        low_a, high_a, low_b, high_b = (
            f(np.where(np.isfinite(x), x, s), axis=2)
            for x in (a, b)
            for f, s in ((np.min, np.inf), (np.max, -np.inf))
        )
        shared = np.clip(np.minimum(high_a, high_b) - np.maximum(low_a, low_b), 0, None).prod(-1)
        whole = (high_a - low_a).prod(axis=-1)
        return np.nan_to_num(shared / whole)


def main() -> None:
    parser = argparse.ArgumentParser(description="Measures a 2D detector's faults")
    parser.add_argument("folder", type=Path)
    parser.add_argument("--recording", choices=("shelf", "pose2sim"))
    arguments = parser.parse_args()
    for name, read in (("shelf", shelf), ("pose2sim", pose2sim)):
        if arguments.recording in (None, name):
            print(f"{name}")
            for what, value in fitted(read(arguments.folder)).items():
                print(f"  {what:<40} {value}")


if __name__ == "__main__":
    main()
