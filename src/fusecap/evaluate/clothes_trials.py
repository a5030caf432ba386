"""Who is who by clothes, tried on simulated people: who leaves and returns, who hides with whom.

People of nearly one stature walk in circles before a ring of cameras. Their pictures are painted
(`fusecap.evaluate.painted_people`), their keypoints simulated with noise and losses, and what
clothes show is read out of the pictures by the code that reads real ones. One trial is one seed.
All of it is simulated; painted clothes have no folds and no patterns.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from fusecap.associate.options import TrackerOptions
from fusecap.associate.tracker import Tracker
from fusecap.body.landmarks import landmark_set_named
from fusecap.body.pose import forward_kinematics, landmarks_in_world
from fusecap.body.shape import BodyShape
from fusecap.body.skeleton import PAPER21
from fusecap.detect.clothes import ClothesReader
from fusecap.evaluate.painted_people import Painter, drawn_wardrobe
from fusecap.evaluate.simulator import camera_ring
from fusecap.geometry.camera import Camera, Rig
from fusecap.types import Detections, TrackState

RATE_HZ = 15.0
PICTURE_EVERY = 3
"""Instants between painted pictures: these cost the most time."""
AWAY_S = 10.0
"""How long who leaves is away."""
CAMERAS, RADIUS_M = 4, 5.0
SIZE_PX, FOCAL_PX = (640, 360), 330.0
NOISE_M, MISSED, MISSED_KEYPOINTS = 0.02, 0.05, 0.05
OCCLUDER_M = 0.9
"""Within so much of the middle nobody is seen, where there is an occluder."""
_LANDMARKS = landmark_set_named("body25")


@dataclass(frozen=True, slots=True, kw_only=True)
class Trial:
    """What came of one."""

    people: int
    """Whose name could be exchanged."""
    right: int
    """Of these, who had at the end the name of the beginning; a stranger, who had another."""
    moved: int
    """Names that clothes put right on the way."""


def re_entry(seed: int, *, clothes: bool = True, alike: bool = False) -> Trial:
    """Three people; all leave, and return 10 s later in another order at other places.

    Without `clothes` nothing is read out of the pictures; `alike` dresses all the same.
    """
    rng = np.random.default_rng(seed)
    leave_s, count = 4.0, 3
    back_s = leave_s + AWAY_S + 1.2 * rng.permutation(count)
    times_s = np.arange(0.0, leave_s + AWAY_S + 1.2 * count + 3.0, 1.0 / RATE_HZ)
    people = []
    for n in range(count):
        before, after = 2 * np.pi * (n + rng.random(2)) / count
        turn = rng.choice([-0.5, 0.5])
        angle = np.where(times_s < leave_s, before, after) + turn * times_s
        body = _walker(1.6 * np.sin(angle), 1.6 * np.cos(angle), angle + turn * np.pi, times_s, rng)
        body[(times_s >= leave_s) & (times_s < back_s[n])] = np.nan
        people.append(body)
    names, notes = _follow(np.stack(people), times_s, rng, clothes=clothes, alike=alike)
    first = names[round(3.5 * RATE_HZ)]
    right = sum(bool(first[n]) and first[n] == names[-1][n] for n in range(count))
    return Trial(people=count, right=right, moved=notes)


def stranger(seed: int, *, clothes: bool = True) -> Trial:
    """Two people, and two places; one leaves, a stranger comes, and 5 s later who had left."""
    rng = np.random.default_rng(seed)
    times_s = np.arange(0.0, 24.0, 1.0 / RATE_HZ)
    people = []
    for n, (begin_s, end_s) in enumerate(((0.0, 4.0), (0.0, 99.0), (14.0, 99.0))):
        angle = 2 * np.pi * n / 3 + 0.5 * times_s + 0.3 * rng.random()
        body = _walker(1.6 * np.sin(angle), 1.6 * np.cos(angle), angle + np.pi / 2, times_s, rng)
        here = (times_s >= begin_s) & ((times_s < end_s) | (times_s >= end_s + 15.0))
        body[~here] = np.nan
        people.append(body)
    names, notes = _follow(np.stack(people), times_s, rng, clothes=clothes, places=2)
    first, last = names[round(3.5 * RATE_HZ)], names[-1]
    right = (bool(first[0]) and first[0] == last[0]) + (last[2] not in first[:2])
    return Trial(people=2, right=right, moved=notes)


def occluder(seed: int, *, clothes: bool = True, alike: bool = False) -> Trial:
    """Two people walk behind what nobody sees through, and on, or turn round there, by chance."""
    rng = np.random.default_rng(seed)
    times_s = np.arange(0.0, 10.0, 1.0 / RATE_HZ)
    heading, turns = 2 * np.pi * rng.random(), rng.random() < 0.5
    along = 0.9 * (times_s - 4.0)
    people = []
    for side in (1.0, -1.0):
        way = side * np.where(times_s > 4.0, -along if turns else along, along)
        x = way * np.sin(heading) + side * 0.3 * np.cos(heading)
        z = way * np.cos(heading) - side * 0.3 * np.sin(heading)
        facing = heading + (0.0 if side > 0 else np.pi) + np.pi * (turns & (times_s > 4.0))
        people.append(_walker(x, z, facing, times_s, rng))
    names, notes = _follow(
        np.stack(people), times_s, rng, clothes=clothes, alike=alike, hidden_m=OCCLUDER_M
    )
    first = names[round(2.5 * RATE_HZ)]
    right = sum(bool(first[n]) and first[n] == names[-1][n] for n in range(2))
    return Trial(people=2, right=right, moved=notes)


TRIALS: dict[str, Callable[..., Trial]] = {
    "re-entry after 10 s": re_entry,
    "a stranger in the place of who left": stranger,
    "behind an occluder": occluder,
}


def small_ring(cameras: int) -> Rig:
    """A ring with small pictures, which paint fast."""
    matrix = np.array([[FOCAL_PX, 0.0, 319.5], [0.0, FOCAL_PX, 179.5], [0.0, 0.0, 1.0]])
    return Rig(
        cameras=tuple(
            Camera(
                name=camera.name,
                size_px=SIZE_PX,
                matrix=matrix,
                distortion=np.zeros(5),
                rotation=camera.rotation,
                translation=camera.translation,
            )
            for camera in camera_ring(cameras, radius_m=RADIUS_M).cameras
        )
    )


def _walker(
    x: np.ndarray,
    z: np.ndarray,
    heading_rad: np.ndarray,
    times_s: np.ndarray,
    rng: np.random.Generator,
) -> Float[np.ndarray, "t k 3"]:
    """Landmarks of somebody of about 1.75 m who swings arms and legs."""
    shape = BodyShape.from_height(PAPER21, 1.75 + 0.02 * rng.standard_normal())
    theta = np.zeros((len(times_s), PAPER21.pose_size))
    theta[:, 0], theta[:, 1], theta[:, 2] = x, shape.standing_root_height_m, z
    theta[:, 4] = heading_rad
    swing = 0.4 * np.sin(2 * np.pi * (0.9 * times_s + rng.random()))
    for bone, axis, angle in (
        ("left_thigh", 0, swing),
        ("right_thigh", 0, -swing),
        ("left_shank", 0, 0.3 + 0.3 * swing),
        ("right_shank", 0, 0.3 - 0.3 * swing),
        ("left_upper_arm", 2, -1.2),
        ("right_upper_arm", 2, 1.2),
        ("left_forearm", 1, -0.6 + 0.4 * swing),
        ("right_forearm", 1, 0.6 + 0.4 * swing),
    ):
        theta[:, 3 + 3 * PAPER21.bone(bone) + axis] = angle
    position, rotation = forward_kinematics(shape, theta)
    bones, offsets = _LANDMARKS.bones(PAPER21), _LANDMARKS.offsets_m(shape)
    return landmarks_in_world(position, rotation, bones, offsets)


def _follow(
    people: Float[np.ndarray, "n t k 3"],
    times_s: np.ndarray,
    rng: np.random.Generator,
    *,
    clothes: bool,
    alike: bool = False,
    places: int | None = None,
    hidden_m: float = 0.0,
) -> tuple[list[list[str]], int]:
    """Per instant the name under which each person is followed, empty for nobody's; names moved."""
    rig, reader = small_ring(CAMERAS), ClothesReader(_LANDMARKS)
    worn = drawn_wardrobe(rng, len(people))
    painter = Painter(
        rig, _LANDMARKS, worn[:1] * len(people) if alike else worn, seed=int(1e6 * rng.random())
    )
    tracker = Tracker(rig, _LANDMARKS, TrackerOptions(max_subjects=places))
    names, moved = [], 0
    for instant, time_s in enumerate(times_s):
        bodies = people[:, instant]
        views, looks, owners = [], [], []
        for c, camera in enumerate(rig.cameras):
            found, owner = _detected(camera, bodies, rng, hidden_m)
            views.append(found)
            owners.append(owner)
            if clothes and instant % PICTURE_EVERY == 0:
                shown = np.where(_is_hidden(bodies, hidden_m)[:, None, None], np.nan, bodies)
                looks.append(reader.read(painter.picture(c, camera, shown), found))
        detections = Detections(
            timestamp_ns=round(time_s * 1e9),
            people=tuple(views),
            appearance=tuple(looks) if looks else None,
        )
        updates = tracker.update(detections, {}, detections.timestamp_ns)
        moved += sum("clothes" in note for note in tracker.notes)
        called = [""] * len(people)
        for update in updates:
            if update.state is not TrackState.TENTATIVE:
                seen = [owners[c][n] for c, n in enumerate(update.person) if n >= 0]
                if seen:
                    called[int(np.bincount(seen).argmax())] = update.name
        names.append(called)
    return names, moved


def _is_hidden(bodies: np.ndarray, hidden_m: float) -> np.ndarray:
    middle = bodies[:, :, [0, 2]].mean(axis=1)
    return np.hypot(middle[:, 0], middle[:, 1]) < hidden_m


def _detected(
    camera: Camera, bodies: np.ndarray, rng: np.random.Generator, hidden_m: float
) -> tuple[np.ndarray, list[int]]:
    """What a detector makes of the people, in drawn order, and whose each is."""
    found, owner = [], []
    hidden = _is_hidden(bodies, hidden_m)
    for n in rng.permutation(len(bodies)).tolist():
        if not np.isfinite(bodies[n]).all() or hidden[n] or rng.random() < MISSED:
            continue
        pixels = camera.project(bodies[n])
        depth_m = float((bodies[n] @ camera.rotation[2] + camera.translation[2]).mean())
        pixels = pixels + rng.normal(size=pixels.shape) * NOISE_M * FOCAL_PX / depth_m
        inside = ((pixels >= 0) & (pixels < camera.size_px)).all(axis=1)
        seen = inside & (rng.random(len(pixels)) >= MISSED_KEYPOINTS)
        if seen.sum() < 4:
            continue
        sure = np.where(seen, rng.uniform(0.5, 1.0, len(pixels)), 0.0)
        found.append(np.column_stack([np.where(seen[:, None], pixels, np.nan), sure]))
        owner.append(n)
    landmarks = len(_LANDMARKS.landmark_names)
    return np.array(found).reshape(-1, landmarks, 3), owner
