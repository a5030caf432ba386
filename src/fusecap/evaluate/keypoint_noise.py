"""What a 2D detector would have seen: images of landmarks, with the faults that detectors have.

Bodies are capsules around their bones. A landmark whose line of sight passes through a capsule, its
own body's or another's, counts as occluded when it lies deeper than the capsule; the detector then
guesses it, badly, or misses it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int

from fusecap.body.landmarks import LANDMARKS, LandmarkSet
from fusecap.body.pose import forward_kinematics, landmarks_in_world
from fusecap.body.shape import REFERENCE_HEIGHT_M, BodyShape, end_offsets_m
from fusecap.body.skeleton import PAPER21
from fusecap.evaluate.noise import bursts, correlated_noise
from fusecap.geometry.camera import Camera

APPARENT_HEIGHT_PX = 600.0
"""Stature in the image at which `KeypointNoise.sigma_px` holds."""

_CAPSULES = [("hips", "neck", 0.075), ("head", "", 0.045)] + [
    (f"{side}_{bone}", f"{side}_{child}" if child else "", radius)
    for side in ("left", "right")
    for bone, child, radius in (
        ("upper_arm", "forearm", 0.027),
        ("forearm", "hand", 0.022),
        ("thigh", "shank", 0.045),
        ("shank", "foot", 0.032),
        ("foot", "toes", 0.020),
    )
]
"""Bone where a capsule starts, bone where it ends (none: the bone's own end), radius by stature."""

_SWAPPED_TOGETHER = {
    "arms": ("shoulder", "elbow", "wrist"),
    "legs": ("hip", "knee", "ankle", "big_toe", "small_toe", "heel"),
}
_CHUNK = 256
_DETECTOR_SEED = 25
_OUTLIER_SPREAD = 0.6
_OUTLIER_CONFIDENCE = (0.1, 0.8)
_MOSTLY_HIDDEN = 0.7
_COVERED = 1 / 3


@dataclass(frozen=True, kw_only=True)
class KeypointNoise:
    """A detector's faults. A share is a probability per frame; its seconds are the mean run.

    The defaults are what `benchmarks/fit_detector_noise.py` measures on real detections.
    """

    sigma_px: float = 2.3
    """Per axis, for a person who appears 600 px tall; grows with apparent size."""
    floor_px: float = 3.0
    """Per axis, in a 1920-pixel-wide image, whatever the size: so that it grows with distance in
    metres."""
    motion_s: float = 0.006
    """Per axis, times the speed of the landmark's image."""
    correlation_s: float = 0.13
    detector_bias: float = 0.0046
    """Per axis, by stature: constant distance of everybody's landmarks from the default offsets."""
    landmark_bias_m: float = 0.008
    """Per axis: constant distance of each person's landmarks from everybody's."""
    clock_s: float = 0.0
    """Constant error of each camera's clock, which nobody knows of."""
    miss_share: float = 0.035
    """Of keypoints in plain view."""
    miss_s: float = 0.12
    occluded_seen_share: float = 0.65
    """Of occluded keypoints: guessed, not missed."""
    occluded_miss_s: float = 0.3
    occluded_sigma_factor: float = 1.8
    person_miss_share: float = 0.018
    """Of people, in each view."""
    occluded_person_miss_share: float = 0.5
    """Of people with more than 70 % of their landmarks occluded."""
    person_miss_s: float = 0.27
    swap_share: float = 0.003
    """Of people's arms, and of their legs, in each view: left taken for right."""
    swap_s: float = 0.15
    confusion_share: float = 0.025
    """Of limbs of people whose box another's covers by a third: the other's are taken for them."""
    confusion_s: float = 0.19
    outlier_share: float = 0.03
    """Of keypoints in plain view: off by `outlier_size`."""
    occluded_outlier_share: float = 0.2
    outlier_s: float = 0.12
    outlier_size: float = 0.05
    """Median distance by apparent height; its logarithm is normal with a deviation of 0.6."""
    spurious_share: float = 0.04
    """Of views: a picture on the wall taken for a person."""
    spurious_s: float = 0.5
    confidence: float = 0.84
    """At no error."""
    confidence_per_error: float = 0.088
    """Less for each unit of log(1 + error), the error in standard deviations."""
    occluded_confidence: float = 0.13
    """Less when occluded."""
    confidence_sigma: float = 0.15
    """About the value that belongs to the error, as long-lived as the error."""
    min_keypoints: int = 4
    """People with fewer visible keypoints are not detected."""
    min_height_px: float = 40.0
    """Nor are those who appear smaller than this, in a 1920-pixel-wide image."""

    def scaled(self, factor: float) -> KeypointNoise:
        """All errors of position larger by a factor; shares, times and confidences as they are."""
        return replace(
            self,
            sigma_px=self.sigma_px * factor,
            floor_px=self.floor_px * factor,
            motion_s=self.motion_s * factor,
            detector_bias=self.detector_bias * factor,
            landmark_bias_m=self.landmark_bias_m * factor,
            outlier_size=self.outlier_size * factor,
        )


NO_KEYPOINT_NOISE = KeypointNoise(
    sigma_px=0.0,
    floor_px=0.0,
    motion_s=0.0,
    detector_bias=0.0,
    landmark_bias_m=0.0,
    miss_share=0.0,
    occluded_seen_share=1.0,
    occluded_sigma_factor=1.0,
    person_miss_share=0.0,
    occluded_person_miss_share=0.0,
    swap_share=0.0,
    confusion_share=0.0,
    outlier_share=0.0,
    occluded_outlier_share=0.0,
    spurious_share=0.0,
    confidence_per_error=0.0,
    occluded_confidence=0.0,
    confidence_sigma=0.0,
    min_keypoints=1,
    min_height_px=0.0,
)
"""Every landmark that projects into the image, where it is."""


@dataclass(frozen=True, kw_only=True)
class Capsules:
    """The solid parts of P people: Q segments with radii, over T frames."""

    start_in_world_m: Float[np.ndarray, "t q 3"]
    end_in_world_m: Float[np.ndarray, "t q 3"]
    radius_m: Float[np.ndarray, " q"]


def body_capsules(
    shape: BodyShape,
    position_in_world_m: Float[np.ndarray, "t b 3"],
    rotation_in_world: Float[np.ndarray, "t b 3 3"],
) -> Capsules:
    """The capsules of one body in motion."""
    bone = shape.skeleton.bone
    ends = end_offsets_m(shape)
    start = [position_in_world_m[:, bone(name)] for name, _, _ in _CAPSULES]
    end = [
        position_in_world_m[:, bone(child)]
        if child
        else position_in_world_m[:, bone(name)] + rotation_in_world[:, bone(name)] @ ends[name]
        for name, child, _ in _CAPSULES
    ]
    return Capsules(
        start_in_world_m=np.stack(start, axis=1),
        end_in_world_m=np.stack(end, axis=1),
        radius_m=np.array([radius for _, _, radius in _CAPSULES]) * shape.height_m,
    )


def together(capsules: Sequence[Capsules]) -> Capsules:
    """Everyone's capsules as one set."""
    return Capsules(
        start_in_world_m=np.concatenate([c.start_in_world_m for c in capsules], axis=1),
        end_in_world_m=np.concatenate([c.end_in_world_m for c in capsules], axis=1),
        radius_m=np.concatenate([c.radius_m for c in capsules]),
    )


def occluded(
    camera: Camera, points_in_world_m: Float[np.ndarray, "t n 3"], capsules: Capsules
) -> Bool[np.ndarray, "t n"]:
    """Which points lie behind a capsule, by more than half its radius, as this camera sees it."""
    hidden = np.empty(points_in_world_m.shape[:2], dtype=bool)
    for first in range(0, len(points_in_world_m), _CHUNK):
        rows = slice(first, first + _CHUNK)
        point, depth = _seen(camera, points_in_world_m[rows])
        start, start_depth = _seen(camera, capsules.start_in_world_m[rows])
        end, end_depth = _seen(camera, capsules.end_in_world_m[rows])
        axis = end - start
        length2 = np.maximum((axis**2).sum(axis=-1), 1e-12)
        offset = point[:, :, None] - start[:, None]
        along = offset[..., 0] * axis[:, None, :, 0] + offset[..., 1] * axis[:, None, :, 1]
        along = np.clip(along / length2[:, None], 0.0, 1.0)
        offset -= along[..., None] * axis[:, None]
        capsule_depth = 1.0 / (
            1.0 / start_depth[:, None] + along * (1.0 / end_depth - 1.0 / start_depth)[:, None]
        )
        radius = capsules.radius_m.astype(np.float32)
        across = np.hypot(offset[..., 0], offset[..., 1]) * capsule_depth
        behind = depth[:, :, None] - capsule_depth > 0.5 * radius
        hidden[rows] = ((across < radius) & behind).any(axis=-1)
    return hidden


def _seen(
    camera: Camera, points_in_world_m: Float[np.ndarray, "t n 3"]
) -> tuple[Float[np.ndarray, "t n 2"], Float[np.ndarray, "t n"]]:
    """Normalised image coordinates and depth [m], in single precision."""
    in_cam = (points_in_world_m @ camera.rotation.T + camera.translation).astype(np.float32)
    depth = np.maximum(in_cam[..., 2], np.float32(0.05))
    return in_cam[..., :2] / depth[..., None], depth


def detector_bias(landmark_set: LandmarkSet, noise: KeypointNoise) -> Float[np.ndarray, "k 3"]:
    """Where this detector puts landmarks against their defaults, by stature, in the bones' frames.

    The same for every seed, and the same on both sides of the body.
    """
    drawn = np.random.default_rng(_DETECTOR_SEED).standard_normal((len(LANDMARKS), 3))
    table = dict(zip(LANDMARKS, drawn, strict=True))
    bias = []
    for name in landmark_set.landmark_names:
        side, _, part = name.partition("_")
        x, y, z = table[f"left_{part}" if side == "right" else name]
        bias.append([-x if side == "right" else x if side == "left" else 0.0, y, z])
    return noise.detector_bias * np.array(bias)


def detect(
    rng: np.random.Generator,
    camera: Camera,
    landmark_set: LandmarkSet,
    landmarks_in_world_m: Float[np.ndarray, "t p k 3"],
    heights_m: Float[np.ndarray, " p"],
    capsules: Capsules,
    noise: KeypointNoise,
    rate_hz: float,
) -> list[tuple[Float[np.ndarray, "n k 3"], Int[np.ndarray, " n"]]]:
    """Per frame one camera's keypoints (x px, y px, confidence), and whose they are (-1: nobody's).

    People come in random order; a missing keypoint is NaN, NaN, 0.
    """
    frames, people, count = landmarks_in_world_m.shape[:3]
    points = landmarks_in_world_m.reshape(frames, people * count, 3)
    true_px = camera.project(points.reshape(-1, 3)).reshape(frames, people, count, 2)
    hidden = occluded(camera, points, capsules).reshape(frames, people, count)
    depth = (points @ camera.rotation[2] + camera.translation[2]).reshape(frames, people, count)
    apparent_px = camera.matrix[0, 0] * heights_m / np.maximum(np.median(depth, axis=2), 0.1)

    def at_times(shape: tuple[int, ...], share: float, mean_s: float) -> Bool[np.ndarray, "..."]:
        return bursts(rng, frames, shape, share=share, mean_frames=mean_s * rate_hz)

    each = (people, count)
    unit = correlated_noise(rng, frames, (*each, 2), noise.correlation_s * rate_hz)
    sigma_px = _sigma_px(camera, true_px, apparent_px, noise, rate_hz)
    sigma_px = sigma_px * np.where(hidden, noise.occluded_sigma_factor, 1.0)
    pixels = true_px + unit * sigma_px[..., None]
    error = np.linalg.norm(unit, axis=-1) * np.where(hidden, noise.occluded_sigma_factor, 1.0)
    confidence = noise.confidence - noise.confidence_per_error * np.log1p(error)
    confidence -= noise.occluded_confidence * hidden
    confidence += noise.confidence_sigma * correlated_noise(
        rng, frames, each, noise.correlation_s * rate_hz
    )

    for parts in _SWAPPED_TOGETHER.values():
        swapped = at_times((people,), noise.swap_share, noise.swap_s)
        rows = _belonging(landmark_set, parts)
        mirrored = pixels[:, :, landmark_set.mirror]
        pixels = np.where((swapped[..., None] & rows)[..., None], mirrored, pixels)
    if people > 1:
        pixels = _confused(pixels, landmark_set, at_times, noise)

    open_outlier = at_times(each, noise.outlier_share, noise.outlier_s)
    hidden_outlier = at_times(each, noise.occluded_outlier_share, noise.outlier_s)
    outlier = np.where(hidden, hidden_outlier, open_outlier)
    distance = noise.outlier_size * np.exp(_OUTLIER_SPREAD * rng.standard_normal(outlier.shape))
    angle = rng.uniform(0.0, 2 * np.pi, outlier.shape)
    away = np.stack([np.cos(angle), np.sin(angle)], axis=-1) * distance[..., None]
    pixels = np.where(outlier[..., None], pixels + away * apparent_px[..., None, None], pixels)
    confidence = np.where(outlier, rng.uniform(*_OUTLIER_CONFIDENCE, outlier.shape), confidence)

    missed = at_times(each, noise.miss_share, noise.miss_s)
    not_guessed = at_times(each, 1.0 - noise.occluded_seen_share, noise.occluded_miss_s)
    visible = ~np.where(hidden, not_guessed, missed) & _inside(camera, pixels)
    gone = at_times((people,), noise.person_miss_share, noise.person_miss_s)
    gone_hidden = at_times((people,), noise.occluded_person_miss_share, noise.person_miss_s)
    person_missed = np.where(hidden.mean(axis=2) > _MOSTLY_HIDDEN, gone_hidden, gone)
    large = apparent_px * camera.pixel_scale >= noise.min_height_px
    detected = (visible.sum(axis=2) >= noise.min_keypoints) & large & ~person_missed
    found = np.concatenate([pixels, np.clip(confidence, 0.05, 1.0)[..., None]], axis=-1)
    found[~visible] = [np.nan, np.nan, 0.0]

    picture, shown = _picture_on_the_wall(rng, camera, landmark_set, frames, noise, rate_hz)
    result = []
    for frame in range(frames):
        whose = np.flatnonzero(detected[frame])
        keypoints = found[frame, whose]
        if shown[frame]:
            whose = np.append(whose, -1)
            keypoints = np.concatenate([keypoints, picture[frame, None]])
        order = rng.permutation(len(whose))
        result.append((keypoints[order], whose[order]))
    return result


def _sigma_px(
    camera: Camera,
    true_px: Float[np.ndarray, "t p k 2"],
    apparent_px: Float[np.ndarray, "t p"],
    noise: KeypointNoise,
    rate_hz: float,
) -> Float[np.ndarray, "t p k"]:
    """Standard deviation per axis: a floor, a part with apparent size, a part with image speed."""
    speed_px_s = np.zeros(true_px.shape[:3])
    if len(true_px) > 1:
        velocity = np.gradient(true_px, axis=0) * rate_hz
        speed_px_s = np.nan_to_num(np.linalg.norm(velocity, axis=-1))
    floor = noise.floor_px / camera.pixel_scale
    size = noise.sigma_px * apparent_px[..., None] / APPARENT_HEIGHT_PX
    return np.sqrt(floor**2 + size**2 + (noise.motion_s * speed_px_s) ** 2)


def _belonging(landmark_set: LandmarkSet, parts: Sequence[str]) -> Bool[np.ndarray, " k"]:
    return np.array([name.partition("_")[2] in parts for name in landmark_set.landmark_names])


def _confused(
    pixels: Float[np.ndarray, "t p k 2"],
    landmark_set: LandmarkSet,
    at_times: Callable[[tuple[int, ...], float, float], Bool[np.ndarray, "..."]],
    noise: KeypointNoise,
) -> Float[np.ndarray, "t p k 2"]:
    """Limbs of people in front of or behind each other, taken from the other."""
    low, high = _boxes(pixels)
    area = np.maximum(high - low, 0.0).prod(axis=-1)
    result = pixels.copy()
    for a in range(pixels.shape[1]):
        for b in range(pixels.shape[1]):
            if a == b:
                continue
            shared = np.minimum(high[:, a], high[:, b]) - np.maximum(low[:, a], low[:, b])
            covered = np.maximum(shared, 0.0).prod(axis=-1) > _COVERED * area[:, a]
            for side in ("left", "right"):
                for parts in _SWAPPED_TOGETHER.values():
                    rows = _belonging(landmark_set, parts)
                    rows &= [name.startswith(side) for name in landmark_set.landmark_names]
                    when = at_times((), noise.confusion_share, noise.confusion_s) & covered
                    taken = (when[:, None] & rows)[..., None]
                    result[:, a] = np.where(taken, pixels[:, b], result[:, a])
    return result


def _inside(camera: Camera, pixels: Float[np.ndarray, "*n 2"]) -> Bool[np.ndarray, "*n"]:
    width, height = camera.size_px
    with np.errstate(invalid="ignore"):
        return (
            (pixels[..., 0] >= 0)
            & (pixels[..., 0] <= width - 1)
            & (pixels[..., 1] >= 0)
            & (pixels[..., 1] <= height - 1)
        )


def _boxes(
    pixels: Float[np.ndarray, "t p k 2"],
) -> tuple[Float[np.ndarray, "t p 2"], Float[np.ndarray, "t p 2"]]:
    """Corners of each person's box; both in one point where nothing is imaged."""
    low = np.where(np.isnan(pixels), np.inf, pixels).min(axis=2)
    high = np.where(np.isnan(pixels), -np.inf, pixels).max(axis=2)
    empty = low > high
    return np.where(empty, -1.0, low), np.where(empty, -1.0, high)


def _picture_on_the_wall(
    rng: np.random.Generator,
    camera: Camera,
    landmark_set: LandmarkSet,
    frames: int,
    noise: KeypointNoise,
    rate_hz: float,
) -> tuple[Float[np.ndarray, "t k 3"], Bool[np.ndarray, " t"]]:
    """A standing figure at one place, a quarter of the image tall, and when it is detected."""
    shape = BodyShape.from_height(PAPER21, REFERENCE_HEIGHT_M)
    position, rotation = forward_kinematics(shape, np.zeros((1, PAPER21.pose_size)))
    offsets = landmark_set.offsets_m(shape)
    points = landmarks_in_world(position, rotation, landmark_set.bones(PAPER21), offsets)[0]
    figure = points[:, :2] * [1.0, -1.0]
    width, height = camera.size_px
    tall_px = 0.25 * height
    place = rng.uniform([tall_px, tall_px], [width - tall_px, height - tall_px])
    count = len(figure)
    keypoints = np.empty((frames, count, 3))
    keypoints[..., :2] = place + figure * tall_px / REFERENCE_HEIGHT_M
    keypoints[..., :2] += 2.0 * rng.standard_normal((frames, count, 2))
    keypoints[..., 2] = rng.uniform(0.1, 0.5, (frames, count))
    shown = bursts(
        rng, frames, (), share=noise.spurious_share, mean_frames=noise.spurious_s * rate_hz
    )
    return keypoints, shown
