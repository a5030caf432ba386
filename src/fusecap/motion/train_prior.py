"""Train the PCA pose prior on a folder of motion [1, sec. 3.2.4].

Frames at 60 a second, the rate of the paper's corpus, are clustered into one centre per hundred
frames, so that long stretches of standing and walking count once; the principal components that
keep 95 % of the centres' variance are the prior. The takes are split first: whole subjects, whole
activities and some takes of every remaining activity are held out and only measure the result.

Two departures from the paper. Every training frame also counts in its mirror image, since a handful
of right-handed subjects is no reason to expect right-handed poses. And frames with a joint turned
further than joints turn, where markers were swapped, are left out.

[1] Malleson, Collomosse, Hilton, IJCV 128 (2020).
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from fnmatch import fnmatch
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float
from scipy.cluster.vq import vq
from scipy.signal import butter, sosfiltfilt
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from fusecap.body.prior import PosePrior
from fusecap.body.skeleton import Skeleton
from fusecap.errors import InputError
from fusecap.motion.motion import Motion
from fusecap.motion.motion_folder import MotionFolder
from fusecap.motion.retarget import retarget
from fusecap.progress import Progress

ACKNOWLEDGEMENT = (
    "The data used in this project was obtained from mocap.cs.cmu.edu. The database was created "
    "with funding from NSF EIA-0196217."
)

CMU_HELD_OUT = (
    "asfamc/03/*",  # subject 03, uneven terrain
    "bvh/12_*",  # subject 12: this take and the next three
    "expmap/train/walking_extra/walking_19",
    "expmap/train/walking_extra/walking_20",
    "expmap/train/walking_extra/walking_21",
    "bvh/14_*",  # subject 14, reaching overhead
    "expmap/test/*",  # among them the only window washing
    "asfamc/01/01_07",
    "asfamc/02/02_08",
    "asfamc/02/02_10",
    "bvh/06_12",
    "expmap/train/basketball_signal/basketball_signal_5",
    "expmap/train/directing_traffic/directing_traffic_4",
    "expmap/train/jumping/jumping_3",
    "expmap/train/running/running_3",
    "expmap/train/walking/walking_2",
    "expmap/train/walking_extra/walking_24",
    "expmap/train/walking_extra/walking_33",
    "expmap/train/walking_extra/walking_40",
    "expmap/train/walking_extra/walking_50",
)
"""Takes of the CMU archives that never train: patterns on the keys of `MotionFolder`."""

_RATE_HZ = 60.0
_FRAMES_PER_CLUSTER = 100
_ITERATIONS = 20
_KEPT_VARIANCE = 0.95
_WITHIN_SHARE = 0.95
_HELD_OUT_EVERY = 5
"""Where no pattern matches a key, every fifth take is held out."""

_CUTOFF_HZ = 8.0
_ACCELERATION_SHARE = 0.98
"""Of frames whose accelerations are usual; beyond, markers were swapped."""
_SHORTEST_TAKE = 30
"""Frames from which accelerations are taken."""
_MAX_ANGLE_DEG = {"upper_arm": 160.0, "forearm": 155.0, "hand": 100.0}


@dataclass(frozen=True, kw_only=True)
class TakeReport:
    """How well the prior covers one held-out take."""

    key: str
    frames: int
    explained: float
    """Share of the variance about the prior's mean that lies in its subspace."""
    within: float
    """Share of frames whose squared deviation [1, eq. 15] is below the 95 % quantile of χ²(r)."""


@dataclass(frozen=True, kw_only=True)
class PriorReport:
    """What went in, and how well the result covers what was held out."""

    skeleton: str
    training_takes: int
    training_frames: int
    """At 60 Hz, without mirror images."""
    dropped_frames: int
    """Of the training takes, for joint angles beyond human range."""
    duplicate_takes: tuple[str, ...]
    """Takes that repeat another one in a second format, and were left out."""
    clusters: int
    components: int
    explained_training: float
    explained_held_out: float
    within_training: float
    within_held_out: float
    held_out_frames: int
    held_out: tuple[TakeReport, ...]


def train_prior(
    motion_folder: Path,
    skeleton: Skeleton,
    *,
    progress: Progress | None = None,
    held_out: Sequence[str] = CMU_HELD_OUT,
    mirror: bool = True,
    seed: int = 0,
) -> tuple[PosePrior, PriorReport]:
    """Train on every take of `motion_folder` that matches no pattern of `held_out`.

    The folder holds motion files or tar archives of them. Raises `InputError` for a broken file, or
    where too few frames are left.
    """
    folder = MotionFolder(motion_folder)
    steps = len(folder.keys) + _ITERATIONS
    report_step = progress or (lambda what, done, total: None)

    takes: list[_Take] = []
    for done, key in enumerate(folder.keys):
        report_step("reading motion", done, steps)
        takes.append(_prepare(key, folder[key], skeleton))
    takes, duplicates = _without_duplicates(takes)
    test = _is_held_out([take.keys for take in takes], held_out)
    training = [take for take, is_test in zip(takes, test, strict=True) if not is_test]
    testing = [take for take, is_test in zip(takes, test, strict=True) if is_test]

    frames = np.concatenate([take.poses for take in training]) if training else np.zeros((0, 1))
    clusters = len(frames) // _FRAMES_PER_CLUSTER
    if clusters < 2:
        raise InputError(
            f"{motion_folder}: {len(frames)} frames are left to train on; at least "
            f"{2 * _FRAMES_PER_CLUSTER} are needed at {_RATE_HZ:g} a second"
        )
    both = np.concatenate([frames, mirrored(skeleton, frames)]) if mirror else frames
    centres = _cluster_centres(
        both,
        clusters * (2 if mirror else 1),
        np.random.default_rng(seed),
        lambda i: report_step("clustering poses", len(folder.keys) + i, steps),
    )
    mean, basis, sigma = _principal_components(centres)
    report_step("clustering poses", steps, steps)

    reports = tuple(
        TakeReport(key=take.key, frames=len(take.poses), explained=e, within=w)
        for take in testing
        for e, w in [_coverage(take.poses, mean, basis, sigma)]
    )
    trained = _coverage(frames, mean, basis, sigma)
    unseen = (
        _coverage(np.concatenate([take.poses for take in testing]), mean, basis, sigma)
        if testing
        else (float("nan"), float("nan"))
    )
    report = PriorReport(
        skeleton=skeleton.name,
        training_takes=len(training),
        training_frames=len(frames),
        dropped_frames=sum(take.dropped for take in training),
        duplicate_takes=duplicates,
        clusters=len(centres),
        components=len(sigma),
        explained_training=trained[0],
        explained_held_out=unseen[0],
        within_training=trained[1],
        within_held_out=unseen[1],
        held_out_frames=sum(len(take.poses) for take in testing),
        held_out=reports,
    )
    recipe = {
        "acknowledgement": ACKNOWLEDGEMENT,
        "method": "k-means centres, then PCA; Malleson et al., IJCV 128 (2020), sec. 3.2.4",
        "rate_hz": _RATE_HZ,
        "frames_per_cluster": _FRAMES_PER_CLUSTER,
        "iterations": _ITERATIONS,
        "kept_variance": _KEPT_VARIANCE,
        "mirrored": mirror,
        "max_angle_deg": _MAX_ANGLE_DEG,
        "acceleration_share": _ACCELERATION_SHARE,
        "acceleration_cutoff_hz": _CUTOFF_HZ,
        "seed": seed,
        "training_takes": [take.key for take in training],
        "held_out_patterns": list(held_out),
        "report": asdict(report),
    }
    prior = PosePrior(
        skeleton_name=skeleton.name,
        mean=mean,
        basis=basis,
        sigma=sigma,
        acceleration=_typical_acceleration(
            skeleton, np.concatenate([take.acceleration for take in training])
        ),
        recipe=recipe,
    )
    return prior, report


def max_angles_rad(skeleton: Skeleton) -> Float[np.ndarray, " b"]:
    """How far each bone after the root can turn; beyond it, markers were swapped."""
    parts = [re.sub("^(left|right)_", "", bone) for bone in skeleton.bone_names[1:]]
    return np.deg2rad([_MAX_ANGLE_DEG.get(part, 180.0) for part in parts])


def mirrored(skeleton: Skeleton, poses: Float[np.ndarray, "n d"]) -> Float[np.ndarray, "n d"]:
    """The poses (`theta[6:]`) as a mirror would show them, left and right exchanged."""
    order = [bone - 1 for bone in _other_side(skeleton)[1:]]
    vectors = poses.reshape(len(poses), -1, 3)[:, order] * [1.0, -1.0, -1.0]
    return vectors.reshape(poses.shape)


@dataclass(frozen=True, kw_only=True)
class _Take:
    key: str
    poses: Float[np.ndarray, "n d"]
    """`theta[6:]` at 60 Hz, frames beyond human range left out."""
    acceleration: Float[np.ndarray, "m n"]
    """(m, 1 + B) magnitudes: of the root's place [m/s²], of every joint [rad/s²]."""
    dropped: int
    path_m: Float[np.ndarray, "t 3"]
    """Of the root in the file's own world, to recognise a take in another format."""
    keys: tuple[str, ...]
    """Its own and those of its duplicates."""


def _prepare(key: str, motion: Motion, skeleton: Skeleton) -> _Take:
    slower = motion[:: max(1, round(motion.rate_hz / _RATE_HZ))]
    theta = retarget(slower, skeleton)
    poses = theta[:, 6:]
    angles = np.linalg.norm(poses.reshape(len(poses), -1, 3), axis=-1)
    possible = np.all(angles <= max_angles_rad(skeleton), axis=1)
    return _Take(
        key=key,
        poses=poses[possible],
        acceleration=_accelerations(theta, slower.rate_hz),
        dropped=int(np.sum(~possible)),
        path_m=motion.root_position_m,
        keys=(key,),
    )


def _accelerations(theta: Float[np.ndarray, "t p"], rate_hz: float) -> Float[np.ndarray, "m n"]:
    """Magnitudes between the first and the last instant, as the motion term sees them.

    Of what is slower than 8 Hz, as people move: the rest is the markers' noise.
    """
    count, bones = len(theta), theta.shape[1] // 3 - 1
    if count < _SHORTEST_TAKE:
        return np.empty((0, 1 + bones))
    turns = Rotation.from_rotvec(theta[:-1, 3:].reshape(-1, 3)).inv()
    turns *= Rotation.from_rotvec(theta[1:, 3:].reshape(-1, 3))
    joints = turns.as_rotvec().reshape(count - 1, bones, 3)
    velocity = np.concatenate([np.diff(theta[:, None, :3], axis=0), joints], axis=1) * rate_hz
    slow = sosfiltfilt(butter(2, _CUTOFF_HZ, fs=rate_hz, output="sos"), velocity, axis=0)
    return np.linalg.norm(np.diff(slow, axis=0), axis=2) * rate_hz


def _typical_acceleration(
    skeleton: Skeleton, accelerations: Float[np.ndarray, "m n"]
) -> Float[np.ndarray, " n"]:
    """(1 + B,) root mean squares without the largest, left and right alike.

    Bones that never move in the takes count as the calmest of the others.
    """
    usual = [one[one <= np.quantile(one, _ACCELERATION_SHARE)] for one in accelerations.T]
    typical = np.array([np.square(one).mean() for one in usual])
    typical = np.maximum(typical, typical[typical > 1e-9 * typical.max()].min())
    other = [0, *(1 + bone for bone in _other_side(skeleton))]
    return np.sqrt(0.5 * (typical + typical[other]))


def _other_side(skeleton: Skeleton) -> list[int]:
    """Per bone its mirror image."""
    swap = {"left": "right", "right": "left"}
    bones = []
    for name in skeleton.bone_names:
        side, _, part = name.partition("_")
        bones.append(skeleton.bone(f"{swap[side]}_{part}" if side in swap else name))
    return bones


def _without_duplicates(takes: Sequence[_Take]) -> tuple[list[_Take], tuple[str, ...]]:
    """Takes that move the root the same way, or share a CMU number, count once."""
    kept: list[_Take] = []
    duplicates: list[str] = []
    for take in takes:
        for index, other in enumerate(kept):
            if _same(take, other):
                kept[index] = _Take(
                    key=other.key,
                    poses=other.poses,
                    acceleration=other.acceleration,
                    dropped=other.dropped,
                    path_m=other.path_m,
                    keys=(*other.keys, take.key),
                )
                duplicates.append(take.key)
                break
        else:
            kept.append(take)
    return kept, tuple(duplicates)


def _same(a: _Take, b: _Take) -> bool:
    numbers = [re.search(r"(?:^|/)(\d+_\d+)$", take.key) for take in (a, b)]
    if numbers[0] and numbers[1] and numbers[0][1] == numbers[1][1]:
        return True
    frames = min(len(a.path_m), len(b.path_m))
    if abs(len(a.path_m) - len(b.path_m)) > 1:
        return False
    # A format that dropped its rest pose lines up at the end.
    return bool(np.allclose(a.path_m[-frames:], b.path_m[-frames:], atol=1e-4, rtol=0.0))


def _is_held_out(keys: Sequence[Sequence[str]], patterns: Sequence[str]) -> list[bool]:
    held = [any(fnmatch(key, p) for key in names for p in patterns) for names in keys]
    if any(held) or not patterns:
        return held
    return [i % _HELD_OUT_EVERY == _HELD_OUT_EVERY - 1 for i in range(len(keys))]


def _cluster_centres(
    points: Float[np.ndarray, "n d"],
    count: int,
    rng: np.random.Generator,
    on_iteration: Callable[[int], None],
) -> Float[np.ndarray, "k d"]:
    """k-means, seeded by k-means++: each seed is drawn by its distance to those before it."""
    centres = np.empty((count, points.shape[1]))
    centres[0] = points[rng.integers(len(points))]
    distance = np.full(len(points), np.inf)
    for k in range(1, count):
        distance = np.minimum(distance, np.square(points - centres[k - 1]).sum(axis=1))
        centres[k] = points[np.searchsorted(np.cumsum(distance), rng.random() * distance.sum())]
    for iteration in range(_ITERATIONS):
        on_iteration(iteration)
        label, _ = vq(points, centres, check_finite=False)
        size = np.bincount(label, minlength=count)
        total = np.zeros_like(centres)
        np.add.at(total, label, points)
        filled = size > 0
        centres[filled] = total[filled] / size[filled, None]
    return centres


def _principal_components(
    centres: Float[np.ndarray, "k d"],
) -> tuple[Float[np.ndarray, " d"], Float[np.ndarray, "d r"], Float[np.ndarray, " r"]]:
    """Mean, basis and deviations that keep 95 % of the variance; signs are fixed."""
    mean = centres.mean(axis=0)
    _, singular, rows = np.linalg.svd(centres - mean, full_matrices=False)
    variance = np.square(singular) / (len(centres) - 1)
    share = np.cumsum(variance) / variance.sum()
    rank = int(np.searchsorted(share, _KEPT_VARIANCE)) + 1
    basis = rows[:rank].T
    signs = np.sign(basis[np.abs(basis).argmax(axis=0), np.arange(rank)])
    return mean, basis * signs, np.sqrt(variance[:rank])


def _coverage(
    poses: Float[np.ndarray, "n d"],
    mean: Float[np.ndarray, " d"],
    basis: Float[np.ndarray, "d r"],
    sigma: Float[np.ndarray, " r"],
) -> tuple[float, float]:
    """Share of the variance explained, and share of frames within the deviation."""
    centred = poses - mean
    coordinates = centred @ basis
    total = float(np.square(centred).sum())
    explained = float(np.square(coordinates).sum()) / total if total > 0 else 1.0
    deviation = np.square(coordinates / sigma).sum(axis=1)
    inside: Bool[np.ndarray, " n"] = deviation <= chi2.ppf(_WITHIN_SHARE, len(sigma))
    return explained, float(np.mean(inside))
