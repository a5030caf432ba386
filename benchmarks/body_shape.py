"""Bone lengths of people nobody has measured: errors and whether the stated ones hold (simulated).

    uv run python benchmarks/body_shape.py DATA/cmu_mocap [--bodies 2] [--part training]
        [--detector shipped]

Every sequence is ten seconds of CMU motion that trained no prior and is no part of the twin, worn
by bodies drawn here: statures of 1.50 to 1.95 m, bones 3 % off the proportions. By default every
body also meets a detector drawn for it, which puts everybody's landmarks elsewhere by as much as
the twin's does; `--detector shipped` is the twin's own, the same for all. `--part training` takes
other bodies over motion that trained the prior: to try changes on.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from fusecap.batch.solve import solve_instants
from fusecap.body.landmarks import LandmarkOffsets, LandmarkSet, landmark_set_named
from fusecap.body.motion_model import evaluate_series, theta_of_channels
from fusecap.body.pose import forward_kinematics
from fusecap.body.prior import load_prior
from fusecap.body.shape import REFERENCE_HEIGHT_M, BodyShape
from fusecap.body.skeleton import PAPER21
from fusecap.calibrate.shape import MeasuredBody, measure_bodies
from fusecap.evaluate.imu_noise import IMUS_13
from fusecap.evaluate.simulator import Person, Simulation, camera_ring, placed, simulate
from fusecap.evaluate.twin import (
    BONE_DEVIATION,
    CAMERAS,
    LANDMARK_SET,
    RING_RADIUS_M,
    TWIN_IMU_NOISE,
    TWIN_KEYPOINT_NOISE,
    TWIN_RIG_NOISE,
)
from fusecap.motion.clips import Clip, save_clips
from fusecap.setup import Setup
from fusecap.solve.estimator import SubjectModel
from fusecap.solve.pose_solver import ImuSites
from fusecap.types import Detections, ImuReading

DURATION_S = 10.0
TEST_CLIPS = (
    Clip(name="climb", take="asfamc/01/01_07", start_s=5.0),
    Clip(name="uneven walk 1", take="asfamc/03/03_03", start_s=5.0),
    Clip(name="uneven walk 2", take="asfamc/03/03_04", start_s=25.0),
    Clip(name="swordplay", take="asfamc/02/02_10", start_s=11.2),
    Clip(name="wash window", take="expmap/test/washwindow/washwindow_1", start_s=12.0),
    Clip(name="traffic", take="expmap/train/directing_traffic/directing_traffic_4", start_s=18.0),
    Clip(name="signals", take="expmap/train/basketball_signal/basketball_signal_5", start_s=14.0),
    Clip(name="basketball", take="bvh/06_12", speed=0.9),
)
"""Seconds that no twin sequence uses, of takes that never trained the prior."""
TRAINING_CLIPS = (
    Clip(name="climb", take="asfamc/01/01_02", start_s=5.0),
    Clip(name="punch", take="asfamc/02/02_05", start_s=4.5),
    Clip(name="kick", take="asfamc/02/02_07", start_s=8.0),
    Clip(name="climb 2", take="asfamc/01/01_05", start_s=10.0),
    Clip(name="signals", take="expmap/train/basketball_signal/basketball_signal_2", start_s=5.0),
    Clip(name="traffic", take="expmap/train/directing_traffic/directing_traffic_1", start_s=13.0),
)
SEEDS = {"test": 7100, "training": 3300}
SET_UPS = ((8, 13), (4, 0))
"""Cameras and IMUs."""
LIMBS = {"forearm": "upper arm", "hand": "forearm", "shank": "thigh", "foot": "shank"}
"""The bone whose frame sits at the limb's far end, and the limb."""


@dataclass(frozen=True, kw_only=True)
class Errors:
    """Of one body in one set-up [m]; rows are limbs, columns left and right."""

    unknown: np.ndarray
    """Measured, stature not stated."""
    known: np.ndarray
    """Measured, stature stated."""
    online: np.ndarray
    """As a solve without a stature measures."""
    proportions: np.ndarray
    """Of the true stature."""
    z_unknown: np.ndarray
    """In stated standard deviations; NaN where the length follows the stature."""
    z_known: np.ndarray
    stature: float
    stature_z: float
    stature_online: float


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--part", choices=("test", "training"), default="test")
    parser.add_argument("--detector", choices=("fresh", "shipped"), default="fresh")
    parser.add_argument("--bodies", type=int, default=2, help="of each sequence")
    arguments = parser.parse_args()
    clips = TEST_CLIPS if arguments.part == "test" else TRAINING_CLIPS
    motion = motions(arguments.folder, clips)
    found: dict[tuple[int, int], list[Errors]] = {set_up: [] for set_up in SET_UPS}
    print(f"simulated; {arguments.part} bodies, {arguments.detector} detector; mm")
    for index, clip in enumerate(clips):
        for body in range(arguments.bodies):
            started = time.perf_counter()
            seed = [SEEDS[arguments.part], index, body]
            full, landmarks = capture(motion[index], seed, arguments.detector)
            for cameras, imus in SET_UPS:
                worn = IMUS_13 if imus else ()
                seen = full.subset(cameras=full.rig.names[:cameras], imu_bones=worn)
                found[cameras, imus].append(errors(seen, landmarks))
            row = "   ".join(
                f"{c} cam {i} imu {rms(e[-1].unknown):5.1f} known {rms(e[-1].known):5.1f}"
                for (c, i), e in found.items()
            )
            height = full.people[0].shape.height_m
            took_s = time.perf_counter() - started
            print(f"{clip.name:14} {height:.2f} m  {row}   {took_s:.0f} s", flush=True)
    for (cameras, imus), each in found.items():
        print(f"\n{cameras} cameras, {imus} IMUs, {len(each)} bodies")
        report(each)


def motions(folder: Path, clips: Sequence[Clip]) -> np.ndarray:
    """(s, t, 66) over the reference body, from the archives in `folder`."""
    with tempfile.TemporaryDirectory() as out:
        path = Path(out) / "motion.npz"
        save_clips(folder, path, clips, duration_s=DURATION_S)
        with np.load(path) as stored:
            frames, rate_hz = int(stored["frames"]), float(stored["rate_hz"])
            time_s = float(stored["start_s"]) + np.arange(frames) / rate_hz
            interval_s = float(stored["interval_s"])
            channels = [evaluate_series(c, interval_s, time_s) for c in stored["coefficients"]]
    return theta_of_channels(np.stack(channels))


def capture(theta: np.ndarray, seed: list[int], detector: str) -> tuple[Simulation, LandmarkSet]:
    """A fresh body in that motion before all cameras, and the landmarks a user believes in."""
    rng = np.random.default_rng(seed)
    shape = _body(rng)
    believed = seen = landmark_set_named(LANDMARK_SET)
    noise = TWIN_KEYPOINT_NOISE
    if detector == "fresh":
        seen = _biased(rng, believed, noise.detector_bias)
        noise = replace(noise, detector_bias=0.0)
    person = Person(name="anna", shape=shape, theta=_on_body(theta, shape), imu_bones=IMUS_13)
    simulation = simulate(
        [person],
        camera_ring(CAMERAS, radius_m=RING_RADIUS_M),
        seen,
        rate_hz=60.0,
        seed=int(rng.integers(1 << 31)),
        keypoint_noise=noise,
        imu_noise=TWIN_IMU_NOISE,
        rig_noise=TWIN_RIG_NOISE,
    )
    return simulation, believed


def _body(rng: np.random.Generator) -> BodyShape:
    shape = BodyShape.from_height(PAPER21, float(rng.uniform(1.50, 1.95)))
    deviation = BONE_DEVIATION * np.clip(rng.standard_normal(PAPER21.bone_count), -2.0, 2.0)
    lengths = {}
    for bone, name in enumerate(PAPER21.bone_names[1:], start=1):
        alike = PAPER21.bone(name.replace("right_", "left_"))
        proportion = float(np.linalg.norm(shape.offsets_m[bone]))
        lengths[name] = proportion * (1.0 + float(deviation[alike]))
    return shape.with_lengths(lengths)


def _biased(rng: np.random.Generator, landmarks: LandmarkSet, bias: float) -> LandmarkSet:
    """Landmarks elsewhere by `bias` statures per axis, alike on both sides of the body."""
    moved = {}
    for name, fraction in zip(landmarks.landmark_names, landmarks.fractions, strict=True):
        side, _, part = name.partition("_")
        x, y, z = bias * rng.standard_normal(3)
        if side == "left":
            moved[name] = (fraction[0] + x, fraction[1] + y, fraction[2] + z)
            moved[f"right_{part}"] = (-fraction[0] - x, fraction[1] + y, fraction[2] + z)
        elif side != "right":
            moved[name] = (float(fraction[0]), fraction[1] + y, fraction[2] + z)
    return landmarks.calibrated(LandmarkOffsets(everyone=moved))


def _on_body(theta: np.ndarray, shape: BodyShape) -> np.ndarray:
    """Steps as long as the body's legs, its lowest joint as high as it was."""
    reference = BodyShape.from_height(PAPER21, REFERENCE_HEIGHT_M)
    scale = shape.standing_root_height_m / reference.standing_root_height_m
    moved = placed(theta, scale=scale, centre_m=(0.0, 0.0))
    moved[:, 1] += scale * _lowest_m(reference, theta) - _lowest_m(shape, moved)
    return moved


def _lowest_m(shape: BodyShape, theta: np.ndarray) -> float:
    position, _ = forward_kinematics(shape, theta)
    return float(position[..., 1].min())


def errors(simulation: Simulation, landmarks: LandmarkSet) -> Errors:
    """Measured with the stature stated and not, and while solving."""
    truth = simulation.people[0].shape
    instants = _Instants(simulation)

    def measured(heights_m: dict[str, float]) -> MeasuredBody:
        height_m = heights_m.get("anna")
        told = BodyShape.from_height(PAPER21, height_m) if height_m else None
        setup = _setup(simulation, landmarks, told)
        (body,) = measure_bodies(setup, instants, heights_m=heights_m)
        return body

    unknown, known = measured({}), measured({"anna": truth.height_m})
    take = solve_instants(_setup(simulation, landmarks, None), instants).whole_take
    true = _lengths(truth)
    return Errors(
        unknown=_lengths(unknown.shape) - true,
        known=_lengths(known.shape) - true,
        online=_lengths(take.shape(0)) - true,
        proportions=_lengths(BodyShape.from_height(PAPER21, truth.height_m)) - true,
        z_unknown=(_lengths(unknown.shape) - true) / _sigmas(unknown),
        z_known=(_lengths(known.shape) - true) / _sigmas(known),
        stature=unknown.height_m - truth.height_m,
        stature_z=(unknown.height_m - truth.height_m) / unknown.height_sigma_m,
        stature_online=float(take.heights_m[0]) - truth.height_m,
    )


def _lengths(shape: BodyShape) -> np.ndarray:
    length = np.linalg.norm(shape.offsets_m, axis=1)
    return np.array([[length[PAPER21.bone(f"{s}_{b}")] for s in ("left", "right")] for b in LIMBS])


def _sigmas(body: MeasuredBody) -> np.ndarray:
    sigma = {bone.bone: bone.sigma_m if bone.told else np.nan for bone in body.bones}
    return np.array([[sigma[f"{side}_{bone}"] for side in ("left", "right")] for bone in LIMBS])


def _setup(simulation: Simulation, landmarks: LandmarkSet, told: BodyShape | None) -> Setup:
    person = simulation.people[0]
    imus = simulation.imus.get(person.name)
    sites = ImuSites.none()
    if imus is not None:
        sites = ImuSites(
            bone=tuple(PAPER21.bone(name) for name in imus.bones),
            position_m=np.ascontiguousarray(imus.position_in_bone_m, dtype=np.float64),
        )
    start_m = (float(person.theta[0, 0]), float(person.theta[0, 2]))
    return Setup(
        rig=simulation.rig,
        landmarks=landmarks,
        skeleton=PAPER21,
        prior=load_prior(PAPER21),
        rate_hz=simulation.rate_hz,
        subjects=(SubjectModel(name=person.name, shape=told, sites=sites, start_m=start_m),),
    )


class _Instants:
    def __init__(self, simulation: Simulation) -> None:
        self._simulation = simulation
        self._detections = simulation.detections
        self._readings = simulation.imu_readings

    def __len__(self) -> int:
        return len(self._detections)

    def detections(self, instant: int) -> Detections:
        return self._detections[instant]

    def readings(self, instant: int) -> Mapping[str, ImuReading]:
        return {name: readings[instant] for name, readings in self._readings.items()}


def report(each: Sequence[Errors]) -> None:
    """Rows: limbs; root mean square, mean in brackets."""
    ways = ("unknown", "known", "online", "proportions")
    print(f"{'':12}" + "".join(f"{way:>16}" for way in ways))
    for row, limb in enumerate(LIMBS.values()):
        cells = []
        for way in ways:
            off = np.array([getattr(e, way)[row] for e in each])
            cells.append(f"{rms(off):8.1f} ({1e3 * off.mean():+5.1f})")
        print(f"{limb:12}" + "".join(f"{cell:>16}" for cell in cells))
    print(f"{'all':12}", end="")
    print("".join(f"{rms(np.array([getattr(e, w) for e in each])):16.1f}" for w in ways))
    for name in ("z_unknown", "z_known"):
        z = np.abs(np.array([getattr(e, name) for e in each]))
        told = z[np.isfinite(z)]
        print(
            f"{name}: within 1 sd {100 * np.mean(told < 1):.0f} %, 2 sd "
            f"{100 * np.mean(told < 2):.0f} %, of {len(told)} lengths told by data of {z.size}"
        )
    stature_z = np.abs([e.stature_z for e in each])
    print(
        f"stature rms {rms(np.array([e.stature for e in each])):.0f} mm, online "
        f"{rms(np.array([e.stature_online for e in each])):.0f}; within 1 sd "
        f"{100 * np.mean(stature_z < 1):.0f} %, 2 sd {100 * np.mean(stature_z < 2):.0f} %"
    )


def rms(off_m: np.ndarray) -> float:
    """Root mean square in mm."""
    return 1e3 * float(np.sqrt(np.mean(off_m**2)))


if __name__ == "__main__":
    main()
