"""The file that other solvers read (benchmarks/peers) holds the cost of eq. 2 in full."""

from __future__ import annotations

import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "benchmarks" / "peers"))

from pose_problem import build_problems, read_problems, write_problems
from scipy_peer import ScipyProblem

from fusecap.body.landmarks import LANDMARK_SETS
from fusecap.body.prior import PosePrior
from fusecap.body.shape import BodyShape
from fusecap.body.skeleton import PAPER21
from fusecap.geometry.camera import Camera, Rig
from fusecap.solve.options import SolverOptions, Weights
from fusecap.solve.pose_solver import Measurements, PoseSolver
from paper_twin import Twin
from scenes import IMU13, flat_prior, measure, random_pose, ring

OPTIONS = SolverOptions(weights=Weights.paper(), function_tolerance=1e-5, floor_radius_m=0.5)
FLOOR_BONES = ("left_foot", "left_toes", "right_foot", "right_toes")
FRAMES = 3
DISTORTED = (0.05, -0.02, 1e-3, -1e-3, 0.01)


@pytest.fixture
def written(rng, tmp_path):
    """Our solver's cost at each frame's start, and the file."""
    shape, rig = BodyShape.from_height(PAPER21, 1.7), ring(3, distortion=DISTORTED)
    starts, data = [], []
    for frame in range(FRAMES):
        truth = random_pose(rng)
        perfect, sites = measure(truth, shape, rig, imu_bones=IMU13)
        keypoints = perfect.keypoints + rng.normal(scale=5, size=perfect.keypoints.shape) * [
            1,
            1,
            0,
        ]
        keypoints[0, frame] = [np.nan, np.nan, 0.0]
        rotation = perfect.imu_rotation.copy()
        rotation[frame] = np.nan
        data.append(
            Measurements(
                keypoints=keypoints,
                imu_rotation=rotation,
                imu_accel=rng.normal(scale=3, size=(len(IMU13), 3)),
                imu_history=perfect.imu_history,
                dt_s=1 / 60,
            )
        )
        starts.append(truth + rng.normal(scale=0.1, size=truth.shape))
    parts = {
        "shape": shape,
        "rig": rig,
        "landmarks": LANDMARK_SETS["body25"],
        "prior": flat_prior(),
        "sites": sites,
        "options": OPTIONS,
    }
    solver = PoseSolver(**parts)
    problems = build_problems(**parts, floor_bones=FLOOR_BONES, starts=np.stack(starts), data=data)
    write_problems(problems, tmp_path / "problems.bin")
    costs = [solver.evaluate(start, frame)[0] for start, frame in zip(starts, data, strict=True)]
    return costs, tmp_path / "problems.bin"


def twin_of(problems, frame):
    """The paper's cost from nothing but the numbers of the file."""
    p = problems.shared
    cameras = [
        Camera(
            name=str(index),
            size_px=(round(1920 / row[21]), 1080),
            matrix=np.array([[row[12], 0, row[14]], [0, row[13], row[15]], [0, 0, 1]]),
            distortion=row[16:21],
            rotation=row[:9].reshape(3, 3),
            translation=row[9:12],
        )
        for index, row in enumerate(p["cameras_packed"])
    ]
    position, orientation, acceleration, projection, deviation, floor = p["weights"]
    weights = Weights(
        position=position,
        orientation=orientation,
        acceleration=acceleration,
        projection=projection,
        deviation=deviation,
        floor=floor,
    )
    assert p["parents"].tolist() == list(PAPER21.parents)
    assert p["floor_bone"].tolist() == [PAPER21.bone(name) for name in FLOOR_BONES]
    return Twin(
        shape=BodyShape(skeleton=PAPER21, offsets_m=p["offsets_m"], height_m=1.0),
        rig=Rig(cameras=tuple(cameras)),
        landmarks=SimpleNamespace(
            bones=lambda _: p["landmark_bone"].astype(int),
            offsets_m=lambda _: p["landmark_offset_m"],
        ),
        prior=PosePrior(
            skeleton_name="paper21",
            mean=p["prior_mean"],
            basis=p["prior_basis"],
            sigma=p["prior_sigma"],
            acceleration=np.ones(1 + PAPER21.bone_count),
            recipe={},
        ),
        data=problems.measurements(frame),
        sites=SimpleNamespace(bone=p["imu_bone"].astype(int), position_m=p["imu_offset_m"]),
        options=SolverOptions(weights=weights, floor_radius_m=float(p["floor_radius_m"][0])),
    )


def test_file_gives_the_solvers_cost_through_the_papers_formulas(written):
    costs, path = written
    problems = read_problems(path)
    assert len(problems) == FRAMES
    assert problems.shared["function_tolerance"][0] == OPTIONS.function_tolerance
    for frame, expected in enumerate(costs):
        twin = twin_of(problems, frame)
        assert twin.cost(problems.frames["start"][frame]) == pytest.approx(expected, rel=1e-9)


def test_scipys_residuals_have_the_solvers_cost(written):
    costs, path = written
    problems = read_problems(path)
    for frame, expected in enumerate(costs):
        peer = ScipyProblem(problems, frame)
        cost = 0.5 * np.sum(peer.residuals(peer.start) ** 2)
        assert cost == pytest.approx(expected, rel=1e-9)


def test_a_file_of_something_else_is_refused(tmp_path):
    np.zeros(20).tofile(tmp_path / "zeros.bin")
    with pytest.raises(ValueError, match="no pose problems"):
        read_problems(tmp_path / "zeros.bin")
