"""What calibrated landmark offsets gain: the twin (simulated), Shelf and Pose2Sim's demo (real).

    uv run python benchmarks/landmark_offsets.py twin [--cameras 8] [--imus 13]
    uv run python benchmarks/landmark_offsets.py shelf DATA/shelf
    uv run python benchmarks/landmark_offsets.py pose2sim DATA/pose2sim_demo/v0.8.4_openpose_body25b

The twin: eq. 17-18 with truth on the training sequences, self-calibration on each test sequence (it
sees no truth), and for comparison eq. 17-18 with the sequence's own truth; all scored on the test
sequences. Shelf: self-calibration on frames 150-300, 3D PCP on 0-149. Pose2Sim: self-calibration on
the first three quarters, reprojection on the last.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from fusecap.batch.solve import SessionInstants, solve_instants
from fusecap.body.landmarks import LandmarkSet
from fusecap.calibrate.offset_samples import OffsetSamples, measure_offsets
from fusecap.calibrate.offsets import calibrate_session, median_offsets, self_calibrate
from fusecap.evaluate.datasets.shelf import load_truth, score_people
from fusecap.evaluate.score import score_take
from fusecap.evaluate.simulated_solve import solve_simulation
from fusecap.evaluate.simulator import Simulation
from fusecap.evaluate.twin import (
    TWIN_VERSION,
    TwinSequence,
    told_by_height,
    twin_sequences,
    twin_simulation,
    twin_training_sequences,
)
from fusecap.setup import setup_of
from fusecap.sources.session_data import open_session
from fusecap.sources.session_file import load_session
from fusecap.take import Take

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "examples"))
sys.path.insert(0, str(Path(__file__).resolve().parent))

INSTANTS_PER_SEQUENCE = 150
"""Measured with truth, of each training sequence."""


def solve(simulation: Simulation, landmarks: LandmarkSet) -> Take:
    """The default solve of a subject whose stature alone is known."""
    people = tuple(replace(p, shape=told_by_height(p.shape)) for p in simulation.people)
    told = replace(simulation, people=people, landmark_set=landmarks)
    return solve_simulation(told).take


def with_truth(landmarks: LandmarkSet, cameras: int) -> LandmarkSet:
    """Eq. 17-18 over all training sequences."""
    parts: list[OffsetSamples] = []
    for sequence in twin_training_sequences():
        simulation = twin_simulation(sequence, cameras=cameras, imus=0)
        step = max(1, len(simulation.detections) // INSTANTS_PER_SEQUENCE)
        rows = simulation.detections[::step]
        parts.append(measure_offsets(simulation.rig, landmarks, simulation.truth, rows))
    pooled = OffsetSamples(
        subjects=("everyone",),
        person=np.zeros(sum(len(part.person) for part in parts), dtype=np.int64),
        in_bone=np.concatenate([part.in_bone for part in parts]),
    )
    return landmarks.calibrated(median_offsets(landmarks, pooled))


def this_person(simulation: Simulation) -> LandmarkSet:
    """Eq. 17-18 on the very sequence: what the best offsets could give."""
    landmarks = simulation.landmark_set
    samples = measure_offsets(
        simulation.rig, landmarks, simulation.truth, simulation.detections[::4]
    )
    return landmarks.calibrated(median_offsets(landmarks, samples))


def self_calibrated(simulation: Simulation) -> LandmarkSet:
    """From the sequence's own solves."""
    return self_calibrate(
        lambda landmarks: solve(simulation, landmarks),
        simulation.rig,
        simulation.landmark_set,
        simulation.detections,
    ).landmarks


def twin(cameras: int, imus: int) -> None:
    def capture(sequence: TwinSequence) -> Simulation:
        return twin_simulation(sequence, cameras=cameras, imus=imus)  # type: ignore[arg-type]

    default = capture(twin_sequences()[0]).landmark_set
    truth = with_truth(default, cameras)
    print(f"twin {TWIN_VERSION}, {cameras} cameras, {imus} IMUs: mm / deg (Procrustes mm)")
    totals: dict[str, list[tuple[float, float, float]]] = {}
    for sequence in twin_sequences():
        simulation = capture(sequence)
        variants = {
            "defaults": default,
            "with truth, other people": truth,
            "with truth, this person": this_person(simulation),
            "self-calibrated": self_calibrated(simulation),
        }
        for name, landmarks in variants.items():
            score = score_take(solve(simulation, landmarks), simulation.truth)
            totals.setdefault(name, []).append(
                (
                    score.position_error_mm.mean,
                    score.orientation_error_deg.mean,
                    score.aligned_error_mm.mean,
                )
            )
        row = "   ".join(f"{n} {v[-1][0]:5.1f} / {v[-1][1]:5.2f}" for n, v in totals.items())
        print(f"{sequence.key:8} {row}", flush=True)
    for name, values in totals.items():
        mean = np.mean(values, axis=0)
        print(f"{name:28} {mean[0]:5.1f} / {mean[1]:5.2f} ({mean[2]:.1f})")


def shelf(folder: Path, first: int = 150, end: int = 301) -> None:
    from shelf import TRUTH, write_shelf_session

    with tempfile.TemporaryDirectory() as target:
        path = write_shelf_session(folder, Path(target), frames=end, floor=True)
        data = open_session(load_session(path))
        landmarks = data.landmarks
        assert landmarks is not None

        def take(landmarks: LandmarkSet, first: int, end: int) -> Take:
            setup = setup_of(data.session, data.rig, landmarks)
            return solve_instants(setup, SessionInstants(data, first, end)).whole_take

        found = self_calibrate(
            lambda landmarks: take(landmarks, first, end),
            data.rig,
            landmarks,
            [data.detections(instant) for instant in range(first, end)],
        )
        steps = ", ".join(f"{1e3 * 1.75 * step:.2f}" for step in found.steps)
        error = " ".join(f"{px:.2f}" for px in found.error_px)
        print(
            f"Shelf: self-calibrated on frames {first}-{end - 1}; mean steps {steps} mm; ", end=""
        )
        print(f"training reprojection {error} px")
        _print_moves(found.landmarks)
        for name, each in (("defaults", landmarks), ("self-calibrated", found.landmarks)):
            score = score_people(take(each, 0, first), load_truth(folder / TRUTH))
            limbs = ", ".join(f"{kind} {pcp:.1f}" for kind, pcp in score.limb_pcp.items())
            print(f"{name:16} PCP {score.pcp:.2f} on frames 0-{first - 1} ({limbs}); ", end="")
            print(f"{score.identity_switches} switches, {score.missed_person_frames} missed")


def pose2sim(folder: Path) -> None:
    from pose2sim_clip import TRIALS, write_session

    for trial in TRIALS:
        with tempfile.TemporaryDirectory() as target:
            data = open_session(load_session(write_session(folder, Path(target), trial)))
            found = calibrate_session(data)
        before, after = found.held_out_before_px, found.held_out_after_px
        print(
            f"pose2sim {trial}: held-out reprojection {before.median:.2f} -> {after.median:.2f} px "
            f"median, {before.mean:.2f} -> {after.mean:.2f} px mean, {after.count} keypoints"
        )
        _print_moves(found.landmarks)


def _print_moves(landmarks: LandmarkSet) -> None:
    moved = np.linalg.norm(landmarks.fractions - landmarks.calibrated(None).fractions, axis=1)
    order: Sequence[int] = np.argsort(-moved)[:6].tolist()
    far = ", ".join(f"{landmarks.landmark_names[k]} {1750 * moved[k]:.0f}" for k in order)
    print(f"  moved {1750 * moved.mean():.1f} mm in the mean; farthest: {far}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("what", choices=("twin", "shelf", "pose2sim"))
    parser.add_argument("folder", type=Path, nargs="?")
    parser.add_argument("--cameras", type=int, default=8)
    parser.add_argument("--imus", type=int, choices=(0, 6, 13), default=13)
    arguments = parser.parse_args()
    if arguments.what == "twin":
        twin(arguments.cameras, arguments.imus)
    elif arguments.folder is None:
        parser.error("name the folder of the recording")
    elif arguments.what == "shelf":
        shelf(arguments.folder)
    else:
        pose2sim(arguments.folder)


if __name__ == "__main__":
    main()
