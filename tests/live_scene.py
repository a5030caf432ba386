"""The simulated demo scene, made longer, as samples of a live run whose sources come and go."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from functools import cache
from itertools import pairwise
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from fusecap.body.landmarks import landmark_set_named
from fusecap.body.motion_model import load_demo_motion
from fusecap.body.shape import REFERENCE_HEIGHT_M, BodyShape
from fusecap.body.skeleton import PAPER21
from fusecap.engine.engine import LiveStep
from fusecap.evaluate import simulated_session
from fusecap.evaluate.demo_scene import BYSTANDER_HEIGHT_M, SUBJECT_HEIGHTS_M, VOLUME_M
from fusecap.evaluate.imu_noise import IMUS_13
from fusecap.evaluate.simulator import (
    CameraTiming,
    Person,
    Simulation,
    camera_ring,
    placed,
    simulate,
)
from fusecap.setup import SessionSetup
from fusecap.sources.session_file import parse_session
from fusecap.types import CameraSample, ImuSample, Tick
from live_events import Sample

TIMING = tuple(
    CameraTiming(rate_hz=rate_hz, offset_s=offset_s)
    for rate_hz, offset_s in ((30.0, 0.0), (30.0, 0.011), (25.0, 0.007), (30.0, 0.019))
)
"""Cameras that nobody synchronised."""


def there_and_back(theta: np.ndarray, frames: int) -> np.ndarray:
    """A motion followed by itself backwards, and so on."""
    last = len(theta) - 1
    phase = np.arange(frames) % (2 * last)
    return theta[np.where(phase > last, 2 * last - phase, phase)]


@cache
def capture(
    seconds: float, *, synchronous: bool = False, imus: bool = True, seed: int = 0
) -> Simulation:
    """Two subjects with 13 sensors each and a bystander before four cameras."""
    motion = load_demo_motion()
    frames = round(seconds * motion.rate_hz)
    heights = {**SUBJECT_HEIGHTS_M, "bystander": BYSTANDER_HEIGHT_M}
    people = [
        Person(
            name=name,
            shape=BodyShape.from_height(PAPER21, height_m),
            theta=placed(
                there_and_back(motion.theta[index], frames), scale=height_m / REFERENCE_HEIGHT_M
            ),
            imu_bones=IMUS_13 if imus and name in SUBJECT_HEIGHTS_M else (),
            bystander=name not in SUBJECT_HEIGHTS_M,
        )
        for index, (name, height_m) in enumerate(heights.items())
    ]
    return _captured(people, motion.rate_hz, None if synchronous else TIMING, seed)


def standing(seconds: float, *, x_m: float = 0.0, facing_rad: float = 0.0) -> Simulation:
    """One subject with 13 sensors who stands in the T-pose."""
    shape = BodyShape.from_height(PAPER21, SUBJECT_HEIGHTS_M["anna"])
    theta = np.zeros((round(60.0 * seconds), PAPER21.pose_size))
    theta[:, 0], theta[:, 1], theta[:, 4] = x_m, shape.standing_root_height_m, facing_rad
    return _captured([Person(name="anna", shape=shape, theta=theta, imu_bones=IMUS_13)], 60.0, None)


def _captured(
    people: list[Person], rate_hz: float, timing: tuple[CameraTiming, ...] | None, seed: int = 0
) -> Simulation:
    return simulate(
        people,
        camera_ring(4, radius_m=5.0),
        landmark_set_named("body25"),
        rate_hz=rate_hz,
        seed=seed,
        name="live",
        volume_m=VOLUME_M,
        timing=timing,
    )


def simulated_setup(
    simulation: Simulation, folder: Path, change: Callable[[str], str] = str
) -> SessionSetup:
    """As its session file has it, once `change` has edited that; of the rest little is written."""
    views = tuple(
        replace(view, times_s=view.times_s[:0], people=(), person=()) for view in simulation.views
    )
    imus = {
        name: replace(
            worn,
            **{
                field: getattr(worn, field)[:1]
                for field in (
                    "times_s",
                    "received",
                    "world_from_imu",
                    "accel_m_s2",
                    "gyro_rad_s",
                    "heading_rad",
                )
            },
        )
        for name, worn in simulation.imus.items()
    }
    path = simulated_session.write_session(replace(simulation, views=views, imus=imus), folder)
    path.write_text(change(path.read_text()))
    return SessionSetup(
        session=parse_session(path),
        rig=simulation.rig,
        landmarks=simulation.landmark_set,
        simulated=True,
    )


def samples_of(simulation: Simulation) -> list[Sample]:
    """Everything that cameras and sensors deliver, in the order of time."""
    samples: list[Sample] = [
        CameraSample(camera=camera, timestamp_ns=round(float(time_s) * 1e9), people=people)
        for camera, view in enumerate(simulation.views)
        for time_s, people in zip(view.times_s, view.people, strict=True)
    ]
    for name, worn in simulation.imus.items():
        for sensor, bone in enumerate(worn.bones):
            orientation = worn.orientation_wxyz(sensor)
            samples += [
                ImuSample(
                    subject=name,
                    bone=bone,
                    timestamp_ns=round(float(worn.times_s[row]) * 1e9),
                    orientation_wxyz=orientation[row],
                    accel_m_s2=worn.accel_m_s2[row, sensor],
                )
                for row in np.flatnonzero(worn.received[:, sensor])
            ]
    return sorted(samples, key=lambda sample: sample.timestamp_ns)


def ticks_of(simulation: Simulation) -> list[Tick]:
    """The instants of the truth."""
    return [Tick(timestamp_ns=int(t)) for t in simulation.truth.timestamps_ns]


@dataclass(frozen=True)
class Phase:
    """From when on which cameras and whether sensors deliver."""

    start_s: float
    cameras: tuple[int, ...]
    imus: bool
    name: str


def kept(samples: Iterable[Sample], phases: list[Phase]) -> list[Sample]:
    """Without what is not delivered in its phase."""

    def delivered(sample: Sample) -> bool:
        phase = [p for p in phases if p.start_s <= sample.timestamp_ns * 1e-9][-1]
        return phase.imus if isinstance(sample, ImuSample) else sample.camera in phase.cameras

    return [sample for sample in samples if delivered(sample)]


@dataclass(frozen=True)
class PhaseScore:
    """One phase against the truth, both subjects together."""

    sent_share: float
    error_mm: float
    """Mean over joints, instants and people."""
    turn_deg: float
    """Mean orientation error of bones."""
    quality: float
    """Mean at the end of the phase."""


def score(simulation: Simulation, steps: list[LiveStep], phases: list[Phase]) -> list[PhaseScore]:
    truth = simulation.truth
    times_s = truth.timestamps_ns * 1e-9
    ends = [phase.start_s for phase in phases[1:]] + [np.inf]
    scores = []
    for phase, end_s in zip(phases, ends, strict=True):
        errors, turns, qualities, sent, asked = [], [], [], 0, 0
        for row in np.flatnonzero((times_s >= phase.start_s) & (times_s < end_s)):
            for subject, name in enumerate(truth.subject_names):
                asked += 1
                estimate = steps[row].people[name]
                if estimate is None:
                    continue
                sent += 1
                true_m = truth.bone_position_in_world_m[subject, row]
                away = np.linalg.norm(estimate.bone_position_in_world_m - true_m, axis=1)
                errors.append(1e3 * away.mean())
                w, x, y, z = truth.bone_rotation_in_world_wxyz[subject, row].T
                true = Rotation.from_quat(np.column_stack([x, y, z, w]))
                ours = Rotation.from_matrix(estimate.bone_rotation_in_world)
                turns.append(np.degrees((true.inv() * ours).magnitude()).mean())
                qualities.append(estimate.bone_quality.mean())
        scores.append(
            PhaseScore(
                sent_share=sent / max(asked, 1),
                error_mm=float(np.mean(errors or [np.nan])),
                turn_deg=float(np.mean(turns or [np.nan])),
                quality=float(np.mean(qualities[-2:] or [np.nan])),
            )
        )
    return scores


@dataclass(frozen=True)
class Fastest:
    """Between consecutive sent poses of one person."""

    root_m_s: float
    bone_rad_s: float
    joint_m_s: float


def fastest(steps: list[LiveStep], name: str) -> Fastest:
    root, bone, joint = 0.0, 0.0, 0.0
    for before, after in pairwise(steps):
        a, b = before.people[name], after.people[name]
        if a is None or b is None:
            continue
        dt_s = (after.timestamp_ns - before.timestamp_ns) * 1e-9
        root = max(root, float(np.linalg.norm(b.theta[:3] - a.theta[:3])) / dt_s)
        first = Rotation.from_rotvec(a.theta[3:].reshape(-1, 3))
        second = Rotation.from_rotvec(b.theta[3:].reshape(-1, 3))
        bone = max(bone, float((first.inv() * second).magnitude().max()) / dt_s)
        moved = np.linalg.norm(b.bone_position_in_world_m - a.bone_position_in_world_m, axis=1)
        joint = max(joint, float(moved.max()) / dt_s)
    return Fastest(root_m_s=root, bone_rad_s=bone, joint_m_s=joint)
