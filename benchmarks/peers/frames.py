"""Writes the frames that peers solve: what the estimator really asks its solver, frame by frame.

    uv run python benchmarks/peers/frames.py OUT.bin [--frames 400] [--weights paper]

One simulated subject walks and moves through the shipped motion (60 Hz) in front of 8 cameras, with
25 keypoints and 13 IMUs; the faults are those of docs/simulation.md. Every frame starts from our
solution of the one before it.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import NamedTuple

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from pose_problem import Problems, build_problems, write_problems
from solve_scene import scene

from fusecap.solve.estimator import Estimator
from fusecap.solve.options import SolverOptions, Weights
from fusecap.solve.pose_solver import Measurements, PoseSolver, Solution
from fusecap.types import Observation

FLOOR_BONES = ("left_foot", "left_toes", "right_foot", "right_toes")
WEIGHTS = {
    "default": Weights().alone(),
    "paper": Weights.paper(),
    "window": Weights(growth=0.0, position=1e-3, rest=0.0),
}
"""Of single poses, and of windows, without what depends on the pose before: contacts, sizes."""
_SETTLED = 3
"""Frames before the first that is written: it starts from a tracked pose, and IMUs have history."""


class _RecordingSolver(PoseSolver):
    """Keeps what it is asked."""

    asked: list[tuple[np.ndarray, Measurements]]

    def solve(self, theta: np.ndarray, data: Measurements) -> Solution:
        self.asked.append((theta.copy(), data))
        return super().solve(theta, data)


class Recorded(NamedTuple):
    """The problems, the solver that they were put to, and what it was shown."""

    problems: Problems
    solver: PoseSolver
    observations: list[Observation]


def record_problems(*, frames: int, weights: str) -> Recorded:
    options = SolverOptions(weights=WEIGHTS[weights], window=1)
    built = scene(cameras=8, frames=frames + _SETTLED)
    model, rig = built.models[0], built.simulation.rig
    assert model.shape is not None
    parts = {
        "shape": model.shape,
        "rig": rig,
        "landmarks": built.simulation.landmark_set,
        "prior": built.prior,
        "sites": model.sites,
        "options": options,
    }
    estimator = Estimator(
        model, rig=rig, landmarks=parts["landmarks"], prior=built.prior, options=options
    )
    recorder = _RecordingSolver(**parts)
    estimator.solver = recorder
    asked = []
    observations = built.observations()
    for observation in observations:
        recorder.asked = []
        estimator.update(observation)
        asked += recorder.asked[:1]  # without restarts
    starts, data = zip(*asked[_SETTLED:], strict=True)
    problems = build_problems(
        **parts, floor_bones=FLOOR_BONES, starts=np.stack(starts), data=list(data)
    )
    return Recorded(problems, PoseSolver(**parts), observations[_SETTLED:])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("out", type=Path)
    parser.add_argument("--frames", type=int, default=400)
    parser.add_argument("--weights", choices=WEIGHTS, default="default")
    arguments = parser.parse_args()
    problems = record_problems(frames=arguments.frames, weights=arguments.weights).problems
    write_problems(problems, arguments.out)
    print(f"{len(problems)} frames in {arguments.out}")


if __name__ == "__main__":
    main()
