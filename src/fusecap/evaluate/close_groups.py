"""Twin v2: people who touch, cross, dance and crowd, for the question who is who.

**All of it is simulated.** Bodies, faults and cameras are those of the twin (`evaluate/twin.py`),
whose figures these scenes do not touch. Motion is that of its clips, moved along paths: arms and
legs are real, where people are is designed, and feet slide. Scenes exist of test bodies and clips,
and of training ones, for tuning.

    simulation = with_losses(close_group_simulation("cross 2 m/s", cameras=4), share=0.3, seed=1)
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from jaxtyping import Bool, Complex, Float
from scipy.spatial.transform import Rotation

from fusecap.body.motion_model import load_twin_motion
from fusecap.errors import InputError, nearest
from fusecap.evaluate.imu_noise import IMUS_13
from fusecap.evaluate.simulator import Person, Simulation
from fusecap.evaluate.twin import body_of, captured, left_out, on_body

CLOSE_GROUPS_VERSION = "1"
"""Changes whenever any figure measured on these scenes would."""

STRETCH_S = 0.5
"""For which a camera loses a person."""
_CABIN_M = 0.8
"""Radius about the middle within which nobody is seen in "behind an occluder"."""
_SECONDS = 10.0

_CASTS = {
    False: (
        ("S1", "S2", "S3", "S4", "S5"),
        ("S3 FS1", "S5 A3", "S3 FS3", "S4 FS3", "S2 ROM3", "S5 FS1", "group signals"),
    ),
    True: (
        ("T1", "T2", "T3", "T4", "T5"),
        ("T1 FS1", "T5 A1", "T3 FS1", "T1 FS2", "T3 FS2", "T2 ROM1", "T4 FS1"),
    ),
}
"""Test and training bodies and clips."""

_Path = Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]
"""Of times (t,) the places x + i z (t,) [m] and the headings (t,) [rad], 0 along +z."""


@dataclass(frozen=True, kw_only=True)
class _Scene:
    paths: Sequence[_Path]
    """Subjects first."""
    bystanders: int = 0
    alike: bool = False
    """One body, one clip: uniforms of one height and pose."""
    hidden: bool = False


def _to_and_fro(speed_m_s: float, half_m: float, turn_rad: float, lag_s: float) -> _Path:
    """Straight through the middle and back, turned about it."""

    def path(t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        phase = ((t + lag_s) * speed_m_s / (2 * half_m)) % 2.0
        along = half_m * (1.0 - 2.0 * np.abs(1.0 - phase))
        heading = turn_rad + np.where(phase < 1.0, 0.0, np.pi)
        return along * np.exp(1j * (np.pi / 2 - turn_rad)), heading

    return path


def _around(
    radius_m: float, phase_rad: float, rad_s: float, middle: complex = 0.0, inward: bool = False
) -> _Path:
    """Round a middle, looking ahead or inward."""

    def path(t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        angle = phase_rad + rad_s * t
        ahead = angle + np.sign(rad_s) * np.pi / 2
        direction = angle + np.pi if inward else ahead
        return middle + radius_m * np.exp(1j * angle), np.pi / 2 - direction

    return path


def _hug(side: float, apart_m: float) -> _Path:
    """Towards somebody, half the time in their arms, and back."""

    def path(t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        far = np.clip(np.abs(t / _SECONDS - 0.5) * 4.0 - 1.0, 0.0, 1.0)
        x = side * (apart_m / 2 + 1.2 * far)
        return x + 0j, np.full(len(t), -side * np.pi / 2)

    return path


def _dance(pair: int, partner: int) -> _Path:
    """Two turn about each other while the pair goes round the room."""

    def path(t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        middle, _ = _around(1.1, np.pi * pair, 0.5)(t)
        own, heading = _around(0.22, np.pi * partner, 2.4, inward=True)(t)
        return middle + own, heading

    return path


def _in_line(place_m: float, lag_s: float) -> _Path:
    def path(t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return place_m + 1j * 0.8 * np.sin(0.9 * (t + lag_s)), np.zeros(len(t))

    return path


CLOSE_GROUPS: dict[str, _Scene] = {
    "hug 0.3 m": _Scene(paths=[_hug(-1.0, 0.3), _hug(1.0, 0.3)]),
    "wrestle": _Scene(paths=[_around(0.18, np.pi * k, 3.0, inward=True) for k in range(2)]),
    "dance": _Scene(paths=[_dance(k // 2, k % 2) for k in range(4)]),
    "cross 2 m/s": _Scene(
        paths=[_to_and_fro(2.0, 1.9, np.pi * k / 3, 0.17 * k) for k in range(6)],
    ),
    "cross 4 m/s": _Scene(
        paths=[_to_and_fro(4.0, 2.2, np.pi * k / 2, 0.11 * k) for k in range(4)],
    ),
    "behind an occluder": _Scene(
        paths=[_to_and_fro(1.2, 1.8, np.pi * k, 0.0) for k in range(2)],
        hidden=True,
    ),
    "uniforms": _Scene(paths=[_in_line(0.6 * k - 0.9, 0.05 * k) for k in range(4)], alike=True),
    "crowd": _Scene(
        paths=[
            *(_around(0.9 + 0.9 * (k % 2), np.pi * k / 4, 0.9 - 1.5 * (k % 2)) for k in range(8)),
            *(_around(1.35, np.pi * k / 2 + 0.4, -0.5) for k in range(4)),
        ],
        bystanders=4,
    ),
}
"""By name; in "uniforms" body and clip are one, and steps a twentieth of a second apart."""


def close_group_simulation(
    name: str, *, cameras: int = 4, imus: int = 13, seed: int = 0, training: bool = False
) -> Simulation:
    """One of `CLOSE_GROUPS` for ten seconds. Raises `InputError` for another name."""
    if name not in CLOSE_GROUPS:
        raise InputError(f"there is no scene '{name}'{nearest(name, CLOSE_GROUPS)}")
    return left_out(_full(name, seed, training), cameras, imus)


@lru_cache(maxsize=2)
def _full(name: str, seed: int, training: bool) -> Simulation:
    scene, motion = CLOSE_GROUPS[name], load_twin_motion()
    bodies, clips = _CASTS[training]
    times_s = np.arange(round(_SECONDS * motion.rate_hz)) / motion.rate_hz
    people = []
    for row, path in enumerate(scene.paths):
        bystander = row >= len(scene.paths) - scene.bystanders
        shape = body_of(bodies[0 if scene.alike else row % len(bodies)])
        clip = on_body(motion, clips[0 if scene.alike else row % len(clips)], shape)
        people.append(
            Person(
                name=f"P{row + 1}",
                shape=shape,
                theta=_along(clip[: len(times_s)], *path(times_s)),
                imu_bones=() if bystander else IMUS_13,
                bystander=bystander,
            )
        )
    kind = "training" if training else "test"
    simulation = captured(people, f"close {kind} {name}", seed, rate_hz=motion.rate_hz)
    if scene.hidden:
        roots_m = np.stack([person.theta[:, [0, 2]] for person in people])
        inside = np.linalg.norm(roots_m, axis=2) < _CABIN_M
        simulation = _without(simulation, np.stack([inside] * len(simulation.views)))
    return simulation


def _along(
    theta: Float[np.ndarray, "t p"],
    place: Complex[np.ndarray, " t"],
    heading_rad: Float[np.ndarray, " t"],
) -> Float[np.ndarray, "t p"]:
    """A clip whose root goes to `place` (x + i z) and whose hips face a heading."""
    moved = theta.copy()
    root = Rotation.from_rotvec(theta[:, 3:6])
    facing = root.apply([0.0, 0.0, 1.0])
    turn = np.zeros((len(theta), 3))
    turn[:, 1] = heading_rad - np.arctan2(facing[:, 0], facing[:, 2])
    moved[:, 0], moved[:, 2] = np.real(place), np.imag(place)
    moved[:, 3:6] = (Rotation.from_rotvec(turn) * root).as_rotvec()
    return moved


def with_losses(simulation: Simulation, *, share: float, seed: int) -> Simulation:
    """Each camera does not detect each person in a `share` of half-second stretches."""
    rng = np.random.default_rng(seed)
    stretch = max(round(STRETCH_S * simulation.rate_hz), 1)
    instants = len(simulation.truth.timestamps_ns)
    count = instants // stretch + 1
    gone = rng.random((len(simulation.views), len(simulation.people), count)) < share
    return _without(simulation, np.repeat(gone, stretch, axis=2)[:, :, :instants])


def _without(simulation: Simulation, gone: Bool[np.ndarray, "c p t"]) -> Simulation:
    """The capture in which cameras do not detect these people at these instants."""
    views = []
    for view, lost in zip(simulation.views, gone, strict=True):
        kept = [
            (who < 0) | ~lost[np.maximum(who, 0), frame] for frame, who in enumerate(view.person)
        ]
        views.append(
            replace(
                view,
                people=tuple(found[k] for found, k in zip(view.people, kept, strict=True)),
                person=tuple(who[k] for who, k in zip(view.person, kept, strict=True)),
            )
        )
    return replace(simulation, views=tuple(views))
