"""How long a right person stays in a wrong pose, with and without the watchdog. Simulated.

    uv run python benchmarks/wrong_poses.py

The twin's training sequences, each person alone and rightly assigned; after a second the pose is
turned about, put upside down, its left arm, knees or thighs bent wrongly, or set 1.4 m away.
Counted are trials that are still 20 mm (mean over joints) worse than undisturbed a second later,
and poses that the watchdog replaced in undisturbed runs.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from fusecap.evaluate.simulated_solve import setup_of_simulation
from fusecap.evaluate.simulator import Simulation
from fusecap.evaluate.twin import twin_simulation, twin_training_sequences
from fusecap.geometry.triangulation import triangulate
from fusecap.pipeline import make_estimator
from fusecap.solve import watchdog
from fusecap.types import Observation

CELLS = ((8, 13), (2, 6), (1, 13), (4, 0), (2, 0), (1, 0))
"""Cameras, sensors."""
AT, END, STILL_WRONG_MM = 60, 180, 20.0
_TURNS = {
    "turned about": (("hips", (0.0, np.pi, 0.0)),),
    "upside down": (("hips", (np.pi, 0.0, 0.0)),),
    "an arm": (("left_upper_arm", (0.0, 0.0, 2.5)),),
    "knees": tuple(
        (f"{side}_{bone}", (angle, 0.0, 0.0))
        for side in ("left", "right")
        for bone, angle in (("thigh", 1.0), ("shank", -2.0))
    ),
    "thighs": tuple((f"{side}_thigh", (0.0, np.pi, 0.0)) for side in ("left", "right")),
    "elsewhere": (),
}


def spoilt(theta: np.ndarray, how: str, bones: dict[str, int]) -> np.ndarray:
    spoilt = theta.copy()
    if how == "elsewhere":
        spoilt[[0, 2]] += 1.0
    for name, turn in _TURNS[how]:
        at = slice(3 + 3 * bones.get(name, 0), 6 + 3 * bones.get(name, 0))
        before, by = Rotation.from_rotvec(theta[at]), Rotation.from_rotvec(turn)
        spoilt[at] = (by * before if name == "hips" else before * by).as_rotvec()
    return spoilt


def seen(simulation: Simulation) -> list[tuple[Observation, np.ndarray]]:
    """Observations of the first person, and what two cameras and more triangulate."""
    readings = simulation.imu_readings.get(simulation.subjects[0].name)
    found = []
    for t, detections in enumerate(simulation.detections):
        keypoints = np.full((len(simulation.rig), 25, 3), np.nan)
        keypoints[:, :, 2] = 0.0
        for camera, who in enumerate(simulation.detected_person[t]):
            for person in np.flatnonzero(who == 0):
                keypoints[camera] = detections.people[camera][person]
        points = np.full((25, 3), np.nan)
        if len(simulation.rig) > 1:
            points, _ = triangulate(simulation.rig, keypoints)
        observation = Observation(
            timestamp_ns=detections.timestamp_ns,
            keypoints=keypoints,
            imu=None if readings is None else readings[t],
        )
        found.append((observation, points))
    return found


def errors_mm(simulation: Simulation, how: str = "") -> tuple[np.ndarray, int]:
    """Mean over joints at every instant, and how many poses were replaced."""
    setup = setup_of_simulation(simulation)
    estimator = make_estimator(setup, setup.subjects[0])
    bones = {name: row for row, name in enumerate(setup.skeleton.bone_names)}
    errors = np.full(END, np.nan)
    for t, (observation, points) in enumerate(seen(simulation)[:END]):
        known = estimator._solution
        if t == AT and how and known is not None:
            theta = spoilt(known.theta, how, bones)
            position, rotation = estimator.solver.posed(theta)
            estimator._solution = replace(
                known, theta=theta, position_in_world_m=position, rotation_in_world=rotation
            )
            estimator._begin_motion()
        estimate = estimator.follow(0, observation, points)
        if estimate is not None:
            away = estimate.bone_position_in_world_m
            away = away - simulation.truth.bone_position_in_world_m[0, t]
            errors[t] = 1e3 * np.linalg.norm(away, axis=1).mean()
    return errors, estimator.found_anew


def main() -> None:
    poor = watchdog.POOR
    print("| cameras, sensors | still wrong, without | with | replaced undisturbed |")
    print("|---|---|---|---|")
    for cameras, imus in CELLS:
        wrong, trials, replaced = {False: 0, True: 0}, 0, 0
        for sequence in twin_training_sequences():
            simulation = twin_simulation(sequence, cameras=cameras, imus=imus)
            undisturbed, count = errors_mm(simulation)
            replaced += count
            for how in _TURNS:
                trials += 1
                for watched in wrong:
                    watchdog.POOR = poor if watched else np.inf
                    errors, _ = errors_mm(simulation, how)
                    later = (errors - undisturbed)[AT + 60 :]
                    wrong[watched] += bool(np.nanmean(later) > STILL_WRONG_MM)
                watchdog.POOR = poor
        print(
            f"| {cameras}, {imus} | {wrong[False]} of {trials} | {wrong[True]} | {replaced} |",
            flush=True,
        )


if __name__ == "__main__":
    main()
