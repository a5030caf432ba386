"""Joint angles of solved twin sequences against the truth (simulated): error, stated sigma, NEES.

uv run python benchmarks/angles.py [--cameras 8] [--imus 13] [--frames 600] [--sequences "S1 FS3"]
"""

from __future__ import annotations

import argparse
from dataclasses import replace

import numpy as np

from fusecap.angles.joint_angles import joint_angles
from fusecap.evaluate.score import same_instants
from fusecap.evaluate.simulated_solve import solve_simulation
from fusecap.evaluate.twin import TWIN_VERSION, twin_sequence, twin_sequences, twin_simulation
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


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cameras", type=int, default=8)
    parser.add_argument("--imus", type=int, default=13)
    parser.add_argument("--frames", type=int, default=600)
    parser.add_argument("--sequences", nargs="*")
    arguments = parser.parse_args()
    sequences = [twin_sequence(key) for key in arguments.sequences or ()] or twin_sequences()
    parts = []
    for sequence in sequences:
        short = replace(sequence, theta=sequence.theta[: arguments.frames])
        simulation = twin_simulation(short, cameras=arguments.cameras, imus=arguments.imus)
        parts.append(errors(solve_simulation(simulation).take, simulation.truth))
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
