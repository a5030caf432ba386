"""Runs in pymomentum's own environment: its sequence solvers on windows of the same frames.

    python momentum_driver.py PROBLEMS.npz

Not the same cost: momentum has no loss per keypoint, other priors and other smoothness. The problem
has the same shape instead: as many instants, joints and keypoints, terms that reach over three
instants, and the same start. So what compares is the time of a step. The last line it prints is
JSON: its version, and per solver the seconds per step of every window, building not included.
"""

from __future__ import annotations

import json
import sys
import time
from importlib.metadata import version

import numpy as np
import pymomentum.geometry as geometry
import pymomentum.solver2 as solver
from scipy.spatial.transform import Rotation

STEPS = 2
_ROOT_NOISE_M_S2 = 30.0
_STEP_S = 1 / 60


def character(shared: dict[str, np.ndarray]) -> geometry.Character:
    """A joint per bone that turns freely; the first also travels."""
    parents = shared["parents"].astype(int)
    joints = [
        geometry.Joint(f"bone{i}", int(parent), np.array([0, 0, 0, 1]), shared["offsets_m"][i])
        for i, parent in enumerate(parents)
    ]
    skeleton = geometry.Skeleton(joints)
    columns = 3 + 3 * len(joints)
    transform = np.zeros((7 * len(joints), columns), np.float32)
    transform[:3, :3] = np.eye(3)
    for i in range(len(joints)):
        transform[7 * i + 3 : 7 * i + 6, 3 + 3 * i : 6 + 3 * i] = np.eye(3)
    names = [f"parameter{i}" for i in range(columns)]
    return geometry.Character(
        "body", skeleton, geometry.ParameterTransform(names, skeleton, transform)
    )


def euler(theta: np.ndarray) -> np.ndarray:
    """Our poses (N, P) as momentum's parameters: x, then y, then z about fixed axes."""
    turned = Rotation.from_rotvec(theta[:, 3:].reshape(-1, 3)).as_euler("xyz")
    return np.concatenate([theta[:, :3], turned.reshape(len(theta), -1)], axis=1)


def window(
    body: geometry.Character, shared: dict[str, np.ndarray], frames: dict[str, np.ndarray], at: int
) -> solver.SequenceSolverFunction:
    length = shared["start"].shape[1]
    function = solver.SequenceSolverFunction(body, length)
    position, orientation, _, _, deviation, _ = shared["weights"]
    rows = shared["cameras_packed"]
    projection = np.concatenate([rows[:, :9].reshape(-1, 3, 3), rows[:, 9:12, None]], axis=2)
    lens = np.zeros((len(rows), 3, 3))
    lens[:, 0, 0], lens[:, 1, 1], lens[:, 2, 2] = rows[:, 12], rows[:, 13], 1.0
    lens[:, :2, 2] = rows[:, 14:16]
    projection = lens @ projection
    for t in range(length):
        keypoints = frames["keypoints"][at + t]
        camera, landmark = np.nonzero(keypoints[:, :, 2] > 0)
        seen = solver.ProjectionErrorFunction(body, near_clip=0.05)
        seen.add_constraints(
            projection[camera].astype(np.float32),
            keypoints[camera, landmark, :2].astype(np.float32),
            shared["landmark_bone"][landmark].astype(np.int32),
            shared["landmark_offset_m"][landmark].astype(np.float32),
            (position * keypoints[camera, landmark, 2]).astype(np.float32),
        )
        function.add_error_function(t, seen)
        sensed = frames["imu_rotation"][at + t]
        there = np.isfinite(sensed[:, 0, 0])
        turned = solver.OrientationErrorFunction(body, weight=orientation)
        turned.add_constraints(
            Rotation.from_matrix(sensed[there]).as_quat().astype(np.float32),
            shared["imu_bone"][there].astype(np.int32),
        )
        function.add_error_function(t, turned)
    function.add_error_function(solver.ModelParametersErrorFunction(body, weight=deviation))
    function.add_sequence_error_function_all_frames(
        solver.AccelerationSequenceErrorFunction(
            body, weight=(_ROOT_NOISE_M_S2 * _STEP_S**2) ** -2.0
        )
    )
    return function


def solvers() -> dict[str, tuple[type, object]]:
    """Both kinds, with `STEPS` steps on one thread."""
    found = {}
    for name, kind, options in (
        ("QR", solver.SequenceSolver, solver.SequenceSolverOptions()),
        ("Cholesky", solver.SequenceCholeskySolver, solver.SequenceCholeskySolverOptions()),
    ):
        options.min_iterations = options.max_iterations = STEPS
        options.multithreaded = options.do_line_search = False
        found[name] = (kind, options)
    found["Cholesky"][1].use_double_precision_normal_equations = False
    return found


def main() -> None:
    shared = dict(np.load(sys.argv[1]))
    frames = {name: shared[name] for name in ("keypoints", "imu_rotation")}
    body = character(shared)
    seconds = {name: [] for name in solvers()}
    for at, theta in enumerate(shared["start"]):
        function = window(body, shared, frames, at)
        start = euler(theta).astype(np.float32).ravel()
        for name, (kind, options) in solvers().items():
            sequence = kind(function, options)
            before = time.process_time()
            sequence.solve(start)
            seconds[name].append((time.process_time() - before) / STEPS)
            errors = sequence.per_iteration_errors
            assert len(errors) == STEPS and errors[-1] < errors[0], errors
    print(json.dumps({"version": version("pymomentum-core"), "seconds": seconds}))


if __name__ == "__main__":
    main()
