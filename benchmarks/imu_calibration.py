"""How far calibrated sensors are from the truth, and how often faults are named. Simulated.

    uv run python benchmarks/imu_calibration.py [--seeds 2] [--first-seed 20] [--cameras 4]
        [--no-bias] [--no-faults]

Five subjects of the twin whose two clips are played one after the other: 20.7 s of ordinary motion,
with the twin's faults of keypoints, sensors and rig. The error of a calibration is the mean angle
between a bone as the found mounting and heading give it and as the true ones do, from the same
sensor data, so the sensor's own wander does not count; its part across the bone's length is what
cameras observe. The second half of the table adds a T-pose whose bones are off by 7 deg about each
axis (an assumption). `--no-bias` takes away the constant distances of the detector's landmarks.

Faults, per scene: each of two pairs of sensors exchanged, and one sensor turned by 30 deg half way.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from fusecap.body.landmarks import landmark_set_named
from fusecap.calibrate.imus.checks import Worn, sensor_rotations
from fusecap.calibrate.imus.identify import identify
from fusecap.calibrate.imus.joint_centres import landmarks_seen
from fusecap.calibrate.imus.motion import calibrate_subject
from fusecap.calibrate.imus.reference import ReferenceMotion, reference_motion
from fusecap.calibrate.imus.sensor_report import SensorCalibration
from fusecap.calibrate.imus.tpose import TPose
from fusecap.evaluate.imu_noise import IMUS_13
from fusecap.evaluate.simulated_solve import solve_simulation
from fusecap.evaluate.simulator import Person, Simulation, at_times, camera_ring, placed, simulate
from fusecap.evaluate.twin import (
    TWIN_IMU_NOISE,
    TWIN_KEYPOINT_NOISE,
    TWIN_RIG_NOISE,
    twin_sequences,
    twin_training_sequences,
)
from fusecap.sources.imu_files.track import ImuTrack
from fusecap.sources.session import ImuSettings

SUBJECTS = ("S3", "S5", "T1", "T2", "T3")
TURN_DEG = 30.0
_LONG_AXIS = {"forearm": 0, "upper_arm": 0, "foot": 2}


def joined(first: np.ndarray, second: np.ndarray, rate_hz: float) -> np.ndarray:
    """Two motions about one place, with 0.7 s of turning from one to the other."""
    ahead = [
        Rotation.from_rotvec(row[3:6]).apply([0.0, 0.0, 1.0]) for row in (first[-1], second[0])
    ]
    turn = np.arctan2(ahead[0][0], ahead[0][2]) - np.arctan2(ahead[1][0], ahead[1][2])
    first = placed(first, centre_m=(0.0, 0.0))
    second = placed(second, turn_rad=float(turn), centre_m=(0.0, 0.0))
    count = round(0.7 * rate_hz)
    between = at_times(np.stack([first[-1], second[0]]), 1.0, np.arange(1, count) / count)
    return np.concatenate([first, between, second])


def scenes(seeds: range, cameras: int, bias: bool) -> Iterator[Simulation]:
    noise = TWIN_KEYPOINT_NOISE
    if not bias:
        noise = replace(noise, detector_bias=0.0, landmark_bias_m=0.0)
    every = (*twin_sequences(), *twin_training_sequences())
    for subject in SUBJECTS:
        own = [sequence for sequence in every if sequence.subject == subject]
        person = Person(
            name=subject,
            shape=own[0].shape,
            theta=joined(own[0].theta, own[1].theta, own[0].rate_hz),
            imu_bones=IMUS_13,
        )
        for seed in seeds:
            yield simulate(
                [person],
                camera_ring(cameras, radius_m=5.0),
                landmark_set_named("body25"),
                rate_hz=own[0].rate_hz,
                seed=1000 * seed + len(subject) + ord(subject[1]),
                keypoint_noise=noise,
                imu_noise=TWIN_IMU_NOISE,
                rig_noise=TWIN_RIG_NOISE,
            )


def worn(simulation: Simulation, tpose: np.random.Generator | None) -> list[Worn]:
    imus = simulation.imus[simulation.people[0].name]
    found = []
    for sensor, bone in enumerate(imus.bones):
        kept = imus.received[:, sensor]
        track = ImuTrack(
            times_s=imus.times_s[kept],
            orientation_wxyz=imus.orientation_wxyz(sensor)[kept],
            accel_m_s2=imus.accel_m_s2[kept, sensor],
        )
        pose = None
        if tpose is not None:
            off = Rotation.from_rotvec(np.radians(7.0) * tpose.standard_normal(3)).as_matrix()
            heading = Rotation.from_rotvec([0.0, imus.heading_rad[0, sensor], 0.0]).as_matrix()
            seen = heading @ off @ imus.mounting[sensor]
            pose = TPose(
                time_s=0.0,
                bone_in_world=np.eye(3),
                sensor_in_imu_world=seen,
                bone_from_imu=seen,
                moved_deg=0.0,
                gravity_deg=0.0,
            )
        settings = ImuSettings(bone=bone, file=Path(f"{bone}.csv"), imu_up="y")
        found.append(Worn(settings=settings, track=track, tpose=pose))
    return found


def error_deg(
    simulation: Simulation, sensor: int, found: SensorCalibration, rotations: np.ndarray, times_s
) -> tuple[float, float, np.ndarray]:
    """Whole, across the bone's length, and the mean error about x, y, z."""
    imus = simulation.imus[simulation.people[0].name]
    known = np.isfinite(rotations[sensor][:, 0, 0])
    seen, when_s = rotations[sensor][known], times_s[known]
    heading = np.interp(when_s, imus.times_s, imus.heading_rad[:, sensor])
    true = Rotation.from_rotvec(np.outer(-heading, [0, 1, 0])).as_matrix() @ seen
    true = true @ imus.mounting[sensor].T
    w, x, y, z = found.bone_from_imu_wxyz
    ours = Rotation.from_euler("y", found.heading_deg, degrees=True).as_matrix() @ seen
    ours = ours @ Rotation.from_quat([x, y, z, w]).as_matrix().T
    error = np.degrees(Rotation.from_matrix(np.swapaxes(true, 1, 2) @ ours).as_rotvec())
    part = found.bone.removeprefix("left_").removeprefix("right_")
    across = np.delete(error, _LONG_AXIS.get(part, 1), axis=1)
    return (
        float(np.linalg.norm(error, axis=1).mean()),
        float(np.linalg.norm(across, axis=1).mean()),
        error.mean(axis=0),
    )


def swapped_found(
    reference: ReferenceMotion, rotations: np.ndarray, first: str, second: str
) -> bool:
    a, b = IMUS_13.index(first), IMUS_13.index(second)
    order = list(range(len(IMUS_13)))
    order[a], order[b] = b, a
    said = identify(reference, IMUS_13, rotations[order], among=())
    named = {each.stated for each in said if each.contradicts}
    return named == {first, second}


def turned(each: Worn, axis: np.ndarray) -> Worn:
    """The sensor turned on its bone for the second half."""
    quaternion = each.track.orientation_wxyz.copy()
    later = each.track.times_s > each.track.times_s.mean()
    turn = Rotation.from_rotvec(np.radians(TURN_DEG) * axis / np.linalg.norm(axis))
    moved = Rotation.from_quat(quaternion[later][:, [1, 2, 3, 0]]) * turn
    quaternion[later] = np.roll(moved.as_quat(canonical=True), 1, axis=1)
    return replace(each, track=replace(each.track, orientation_wxyz=quaternion))


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--seeds", type=int, default=2)
    parser.add_argument("--first-seed", type=int, default=20, help="0 to 15 served for tuning")
    parser.add_argument("--cameras", type=int, default=4)
    parser.add_argument("--no-bias", action="store_true")
    parser.add_argument("--no-faults", action="store_true", help="errors only, quicker")
    arguments = parser.parse_args()
    rng = np.random.default_rng(arguments.first_seed)
    errors: dict[tuple[bool, str], list[tuple[float, float]]] = {
        (tpose, bone): [] for tpose in (False, True) for bone in IMUS_13
    }
    scores: list[np.ndarray] = []
    alarms = sensors = swaps = swaps_found = turns = turns_found = 0
    seeds = range(arguments.first_seed, arguments.first_seed + arguments.seeds)
    for simulation in scenes(seeds, arguments.cameras, not arguments.no_bias):
        take = solve_simulation(simulation.subset(imu_bones=())).take
        reference = reference_motion(take, 0, simulation.landmark_set)
        seen = landmarks_seen(
            simulation.rig, simulation.landmark_set, take, 0, simulation.detections
        )
        carried = worn(simulation, None)
        rotations = sensor_rotations(carried, reference.times_s)
        for tpose in (False, True):
            posed = worn(simulation, rng) if tpose else carried
            for index, sensor in enumerate(calibrate_subject(reference, posed, seen).sensors):
                total, part, mean = error_deg(
                    simulation, index, sensor, rotations, reference.times_s
                )
                errors[tpose, sensor.bone].append((total, part))
                if tpose:
                    continue
                sensors += 1
                scores.append(mean / np.array(sensor.sigma_deg))
                if not sensor.usable:
                    alarms += 1
                    print(f"false alarm: {sensor.bone}, {sensor.fault}: {sensor.remedy[:60]}")
        if arguments.no_faults:
            continue
        for pair in (("left_shank", "right_shank"), ("left_forearm", "right_forearm")):
            swaps += 1
            swaps_found += swapped_found(reference, rotations, *pair)
        slipped = int(rng.integers(len(carried)))
        carried[slipped] = turned(carried[slipped], rng.standard_normal(3))
        turns += 1
        again = calibrate_subject(reference, carried, seen).sensors
        turns_found += again[slipped].fault == "moved"
        print(f"{simulation.people[0].name}: turned {IMUS_13[slipped]}: {again[slipped].fault}")
    print("degrees, median and worst: whole rotation, across the length; the same with a T-pose")
    for bone in IMUS_13:
        cells = [
            f"{np.median(column):9.1f} {max(column):5.1f}"
            for tpose in (False, True)
            for column in zip(*errors[tpose, bone], strict=True)
        ]
        print(f"{bone:<16}", *cells)
    z = np.abs(np.array(scores))
    print(
        f"error over its sigma: rms {np.sqrt((z**2).mean()):.2f}, "
        f"below 2 in {100 * (z < 2).mean():.0f} %"
    )
    print(f"false alarms {alarms} of {sensors} sensors")
    print(f"swaps named {swaps_found} of {swaps}, turned sensors {turns_found} of {turns}")


if __name__ == "__main__":
    main()
