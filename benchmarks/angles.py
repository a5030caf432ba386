"""Joint angles of solved twin sequences against the truth (simulated): error, stated sigma, NEES.

    uv run python benchmarks/angles.py [--cameras 8] [--imus 13] [--sequences "S1 FS3"]
    uv run python benchmarks/angles.py --fit       prints the table of fusecap.angles.constants

The fit takes the training sequences by all of `FITTED`. Per joint and axis it chooses the constant
whose NEES is nearest to 1: least sum, over set-ups, of the squared logarithm of the mean of error²
over variance. Errors about outer axes count as what turns about them, so that hanging arms do not
decide.
"""

from __future__ import annotations

import argparse
from dataclasses import replace

import numpy as np

from fusecap.angles.joint_angles import joint_angles
from fusecap.angles.joints import JOINTS
from fusecap.evaluate.score import same_instants
from fusecap.evaluate.simulated_solve import solve_simulation
from fusecap.evaluate.twin import (
    TWIN_VERSION,
    TwinSequence,
    twin_sequence,
    twin_sequences,
    twin_simulation,
    twin_training_sequences,
)
from fusecap.take import Take

SHOWN = (
    *("hip_flexion", "hip_adduction", "hip_rotation"),
    *("knee_flexion", "knee_adduction", "knee_rotation", "ankle_dorsiflexion"),
    *("arm_flexion", "arm_adduction", "arm_rotation"),
    *("shoulder_plane", "shoulder_elevation", "shoulder_rotation"),
    *("elbow_flexion", "elbow_pronation", "trunk_flexion", "trunk_rotation", "neck_flexion"),
)


def errors(take: Take, truth: Take) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Per angle, both sides together: errors and stated standard deviations [deg]."""
    rows, true_rows = same_instants(take.timestamps_ns, truth.timestamps_ns)
    found, true = joint_angles(take), joint_angles(truth)
    result = {}
    for kind in SHOWN:
        parts = []
        for column, name in enumerate(found.names):
            if name.removeprefix("left_").removeprefix("right_") == kind:
                apart = found.deg[0, rows, column] - true.deg[0, true_rows, column]
                seen = np.isfinite(apart)
                error = (apart[seen] + 180.0) % 360.0 - 180.0
                parts.append((error, found.sd_deg[0, rows, column][seen]))
        result[kind] = tuple(np.concatenate(each) for each in zip(*parts, strict=True))
    return result


FITTED = ((8, 13), (4, 6), (4, 0), (0, 13))
"""Cameras, sensors."""
_GRID_DEG = np.arange(0.0, 15.05, 0.1)


def turned(take: Take, truth: Take) -> dict[tuple[str, int], tuple[np.ndarray, np.ndarray]]:
    """Per joint and axis: errors about it and standard deviations without constants [deg]."""
    rows, true_rows = same_instants(take.timestamps_ns, truth.timestamps_ns)
    found, true = joint_angles(take, constants={}), joint_angles(truth)
    result: dict[tuple[str, int], tuple[np.ndarray, np.ndarray]] = {}
    for joint in JOINTS:
        for side in ("left_", "right_") if joint.sided else ("",):
            first = found.names.index(f"{side}{joint.name}_{joint.angles[0]}")
            sd = found.sd_deg[0, rows, first : first + 3]
            apart = (
                found.deg[0, rows, first : first + 3] - true.deg[0, true_rows, first : first + 3]
            )
            error = ((apart + 180.0) % 360.0 - 180.0) * sd[:, [1]] / sd
            seen = np.isfinite(error).all(axis=1)
            for axis in range(3):
                before = result.get((joint.name, axis), (np.zeros(0), np.zeros(0)))
                result[joint.name, axis] = (
                    np.concatenate([before[0], error[seen, axis]]),
                    np.concatenate([before[1], sd[seen, 1]]),
                )
    return result


def fitted(
    setups: list[list[dict[tuple[str, int], tuple[np.ndarray, np.ndarray]]]],
) -> dict[str, tuple[float, ...]]:
    """Constants [deg] per joint, by `turned` of every sequence of every set-up."""

    def constant(name: str, axis: int) -> float:
        cost = np.zeros(len(_GRID_DEG))
        for sequences in setups:
            error, sd = (
                np.concatenate([each[name, axis][k] for each in sequences]) for k in (0, 1)
            )
            nees = [np.mean(error**2 / (sd**2 + c**2)) for c in _GRID_DEG]
            cost += np.square(np.log(nees))
        return round(float(_GRID_DEG[cost.argmin()]), 1)

    return {joint.name: tuple(constant(joint.name, axis) for axis in range(3)) for joint in JOINTS}


def solved(sequence: TwinSequence, cameras: int, imus: int) -> tuple[Take, Take]:
    """As solved, and the truth."""
    simulation = twin_simulation(sequence, cameras=cameras, imus=imus)
    return solve_simulation(simulation).whole_take, simulation.truth


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cameras", type=int, default=8)
    parser.add_argument("--imus", type=int, default=13)
    parser.add_argument("--frames", type=int, default=600)
    parser.add_argument("--sequences", nargs="*")
    parser.add_argument("--fit", action="store_true")
    arguments = parser.parse_args()
    if arguments.fit:
        every = twin_training_sequences()
        table = fitted([[turned(*solved(each, *setup)) for each in every] for setup in FITTED])
        for name, constants in table.items():
            print(f'    "{name}": {constants},')
        return
    sequences = [twin_sequence(key) for key in arguments.sequences or ()] or twin_sequences()
    parts = []
    for sequence in sequences:
        short = replace(sequence, theta=sequence.theta[: arguments.frames])
        parts.append(errors(*solved(short, arguments.cameras, arguments.imus)))
    print(f"twin {TWIN_VERSION} (simulated), {arguments.cameras} cameras, {arguments.imus} IMUs")
    print(f"{len(sequences)} sequences: {', '.join(each.key for each in sequences)}")
    print("| angle | RMSE [deg] | bias | stated sd, RMS | NEES | within 2 sd [%] |")
    print("|---|---|---|---|---|---|")
    for kind in SHOWN:
        error, sd = (np.concatenate([part[kind][k] for part in parts]) for k in (0, 1))
        rms, stated = (np.sqrt(np.square(each).mean()) for each in (error, sd))
        nees = np.square(error / sd).mean()
        within = 100 * (np.abs(error) < 2 * sd).mean()
        figures = f"{rms:.1f} | {error.mean():+.1f} | {stated:.1f} | {nees:.2f} | {within:.0f}"
        print(f"| {kind} | {figures} |")


if __name__ == "__main__":
    main()
