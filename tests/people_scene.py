"""A small scene for association: people who walk, a ring of cameras, and a detector that errs."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from fusecap.body.landmarks import LANDMARK_SETS
from fusecap.body.pose import forward_kinematics, landmarks_in_world
from fusecap.body.shape import BodyShape
from fusecap.body.skeleton import PAPER21
from fusecap.geometry.camera import Camera, Rig
from fusecap.types import Detections, TrackState, TrackUpdate

BODY25 = LANDMARK_SETS["body25"]
RATE_HZ = 30.0


def ring_of_cameras(count: int, radius_m: float = 5.0) -> Rig:
    """Full-HD cameras with some distortion, 2.2 m up, all looking at the middle."""
    cameras = []
    for c in range(count):
        angle = 2 * np.pi * c / count + 0.3
        position = np.array([radius_m * np.sin(angle), 2.2, radius_m * np.cos(angle)])
        forward = np.array([0.0, 1.0, 0.0]) - position
        forward /= np.linalg.norm(forward)
        right = np.cross(forward, [0.0, 1.0, 0.0])
        right /= np.linalg.norm(right)
        rotation = np.stack([right, np.cross(forward, right), forward])
        cameras.append(
            Camera(
                name=f"cam{c}",
                size_px=(1920, 1080),
                matrix=np.array([[1000.0, 0, 960], [0, 1000.0, 540], [0, 0, 1]]),
                distortion=np.array([-0.05, 0.01, 0.0005, -0.0005, 0.0]),
                rotation=rotation,
                translation=-rotation @ position,
            )
        )
    return Rig(cameras=tuple(cameras))


def walker(
    path: Callable[[np.ndarray], tuple[np.ndarray, np.ndarray, np.ndarray]],
    times_s: np.ndarray,
    height_m: float = 1.75,
) -> np.ndarray:
    """Landmarks (t, k, 3) of somebody on `path(times) -> x, z, heading`, swinging arms and legs."""
    return walker_with_turns(path, times_s, height_m)[0]


def walker_with_turns(
    path: Callable[[np.ndarray], tuple[np.ndarray, np.ndarray, np.ndarray]],
    times_s: np.ndarray,
    height_m: float = 1.75,
) -> tuple[np.ndarray, np.ndarray]:
    """A `walker`, and how its bones are turned in the world (t, b, 3, 3)."""
    shape = BodyShape.from_height(PAPER21, height_m)
    theta = np.zeros((len(times_s), PAPER21.pose_size))
    x, z, heading = path(times_s)
    theta[:, 0], theta[:, 1], theta[:, 2] = x, shape.standing_root_height_m, z
    theta[:, 4] = heading
    swing = 0.5 * np.sin(2 * np.pi * times_s + 3 * height_m)

    def turn(bone: str, axis: int, angle: np.ndarray | float) -> None:
        theta[:, 3 + 3 * PAPER21.bone(bone) + axis] = angle

    turn("left_thigh", 0, swing)
    turn("right_thigh", 0, -swing)
    turn("left_shank", 0, 0.3 + 0.3 * swing)
    turn("right_shank", 0, 0.3 - 0.3 * swing)
    turn("left_upper_arm", 2, -1.3)
    turn("right_upper_arm", 2, 1.3)
    turn("left_forearm", 1, -0.6 + 0.4 * swing)
    turn("right_forearm", 1, 0.6 + 0.4 * swing)
    position, rotation = forward_kinematics(shape, theta)
    bones, offsets = BODY25.bones(PAPER21), BODY25.offsets_m(shape)
    return landmarks_in_world(position, rotation, bones, offsets), rotation


def straight(start: tuple[float, float], velocity: tuple[float, float]):
    """A path at constant velocity [m, m/s], looking ahead."""

    def path(t: np.ndarray):
        heading = np.arctan2(velocity[0], velocity[1]) if any(velocity) else 0.0
        return start[0] + velocity[0] * t, start[1] + velocity[1] * t, np.full_like(t, heading)

    return path


def circle(radius_m: float, phase: float, speed_rad_s: float, middle=(0.0, 0.0)):
    """A path round `middle`."""

    def path(t: np.ndarray):
        angle = phase + speed_rad_s * t
        x, z = middle[0] + radius_m * np.sin(angle), middle[1] + radius_m * np.cos(angle)
        return x, z, angle + np.sign(speed_rad_s) * np.pi / 2

    return path


@dataclass(frozen=True)
class Scene:
    """Detections of every instant, and whose they are."""

    detections: list[Detections]
    owner: list[list[np.ndarray]]
    """Per instant and camera the person behind each detection; -1 for a spurious one."""


def observe(
    rig: Rig,
    people: Sequence[np.ndarray],
    rng: np.random.Generator,
    *,
    noise_m: float = 0.02,
    miss: float = 0.05,
    keypoint_miss: float = 0.1,
    outlier: float = 0.02,
    spurious: float = 0.1,
    mirrored: float = 0.0,
    hidden: Callable[[int, int, int], bool] = lambda person, camera, frame: False,
) -> Scene:
    """What a detector makes of `people`, each (t, k, 3), in shuffled order.

    Noise is Gaussian and, like a detector's, grows with the person in the image; `outlier` is
    the share of keypoints that lie anywhere within half a metre; a spurious detection is half a
    person at a random place of the image.
    """
    all_detections, all_owners = [], []
    for frame in range(len(people[0])):
        views, owners = [], []
        for c, camera in enumerate(rig.cameras):
            found, owner = [], []
            for p, landmarks in enumerate(people):
                if rng.random() < miss or hidden(p, c, frame):
                    continue
                point = landmarks[frame]
                pixels = camera.project(point)
                depth = point @ camera.rotation[2] + camera.translation[2]
                px_per_m = camera.matrix[0, 0] / depth
                sigma = np.where(rng.random(len(point)) < outlier, 0.25, noise_m) * px_per_m
                pixels = pixels + rng.normal(size=pixels.shape) * sigma[:, None]
                inside = ((pixels >= 0) & (pixels < camera.size_px)).all(axis=1)
                seen = inside & (rng.random(len(point)) >= keypoint_miss)
                if seen.sum() < 4:
                    continue
                keypoints = np.zeros((len(point), 3))
                keypoints[seen, :2] = pixels[seen]
                keypoints[seen, 2] = rng.uniform(0.4, 1.0, seen.sum())
                if rng.random() < mirrored:
                    keypoints = keypoints[BODY25.mirror]
                found.append(keypoints)
                owner.append(p)
            if rng.random() < spurious:
                keypoints = np.zeros((len(people[0][0]), 3))
                some = rng.random(len(keypoints)) < 0.5
                middle = rng.uniform([0, 0], camera.size_px)
                keypoints[some, :2] = middle + rng.normal(size=(some.sum(), 2)) * 80
                keypoints[some, 2] = 0.4
                found.append(keypoints)
                owner.append(-1)
            order = rng.permutation(len(found))
            empty = np.zeros((0, len(people[0][0]), 3))
            views.append(np.stack(found)[order] if found else empty)
            owners.append(np.array(owner, dtype=int)[order])
        time_ns = round(frame * 1e9 / RATE_HZ)
        all_detections.append(Detections(timestamp_ns=time_ns, people=tuple(views)))
        all_owners.append(owners)
    return Scene(detections=all_detections, owner=all_owners)


@dataclass
class Score:
    """How well reported subjects are the people who are there."""

    assigned: int = 0
    wrong: int = 0
    """Detections given to a subject that most of the time is somebody else."""
    person_of: dict[int, int] | None = None
    """Who each track is most of the time."""
    switches: int = 0
    """Changes of the person whom most of a subject's detections show."""
    names: set[str] | None = None
    seen_share: float = 0.0
    """Detections of people who are subjects that were assigned, of all of them."""


def run(tracker, scene: Scene) -> tuple[list[list[TrackUpdate]], Score]:
    """Track a scene without a solver and score the reported subjects."""
    history = [tracker.update(d, {}, d.timestamp_ns) for d in scene.detections]
    given: dict[int, Counter] = {}
    last: dict[int, int] = {}
    score = Score(names=set())
    for updates, owner in zip(history, scene.owner, strict=True):
        for update in updates:
            if update.state is TrackState.TENTATIVE:
                continue
            score.names.add(update.name)
            people = [int(owner[c][n]) for c, n in enumerate(update.person) if n >= 0]
            given.setdefault(update.track_id, Counter()).update(people)
            if people:
                who = Counter(people).most_common(1)[0][0]
                score.switches += last.get(update.track_id, who) != who
                last[update.track_id] = who
    score.person_of = {t: c.most_common(1)[0][0] for t, c in given.items() if c}
    score.assigned = sum(c.total() for c in given.values())
    right = sum(c[score.person_of[t]] for t, c in given.items() if c)
    score.wrong = score.assigned - right
    subjects = set(score.person_of.values())
    there = sum(int(np.isin(o, list(subjects)).sum()) for owner in scene.owner for o in owner)
    score.seen_share = right / there if there else 0.0
    return history, score
