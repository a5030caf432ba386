"""fusecap: full 6-DoF motion of several people from a few cameras and body-worn IMUs.

The names below load on first use, so that `import fusecap` stays quick.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from fusecap.batch.solve import Solved, SolveReport, solve_session
    from fusecap.body.landmarks import LandmarkSet, landmark_set_named
    from fusecap.body.prior import PosePrior, load_prior
    from fusecap.body.shape import BodyShape
    from fusecap.body.skeleton import EXTENDED23, PAPER21, Skeleton
    from fusecap.errors import FusecapError
    from fusecap.geometry.camera import Camera, Rig
    from fusecap.solve.estimator import Estimator, SubjectModel
    from fusecap.solve.options import SolverOptions, Weights
    from fusecap.solve.pose_solver import ImuSites
    from fusecap.sources.session import Session, load_session
    from fusecap.sources.session_data import open_session
    from fusecap.take import Take, load_take, save_take
    from fusecap.types import Detections, Estimate, ImuReading, Observation, Status

_HOME = {
    "LandmarkSet": "body.landmarks",
    "landmark_set_named": "body.landmarks",
    "PosePrior": "body.prior",
    "load_prior": "body.prior",
    "BodyShape": "body.shape",
    "EXTENDED23": "body.skeleton",
    "PAPER21": "body.skeleton",
    "Skeleton": "body.skeleton",
    "FusecapError": "errors",
    "Camera": "geometry.camera",
    "Rig": "geometry.camera",
    "Solved": "batch.solve",
    "SolveReport": "batch.solve",
    "solve_session": "batch.solve",
    "Take": "take",
    "load_take": "take",
    "save_take": "take",
    "Estimator": "solve.estimator",
    "SubjectModel": "solve.estimator",
    "SolverOptions": "solve.options",
    "Weights": "solve.options",
    "ImuSites": "solve.pose_solver",
    "Session": "sources.session",
    "load_session": "sources.session",
    "open_session": "sources.session_data",
    "Detections": "types",
    "Estimate": "types",
    "ImuReading": "types",
    "Observation": "types",
    "Status": "types",
}

__all__ = [  # noqa: RUF022  (grouped by module, as above)
    "LandmarkSet",
    "landmark_set_named",
    "PosePrior",
    "load_prior",
    "BodyShape",
    "EXTENDED23",
    "PAPER21",
    "Skeleton",
    "FusecapError",
    "Camera",
    "Rig",
    "Solved",
    "SolveReport",
    "solve_session",
    "Take",
    "load_take",
    "save_take",
    "Estimator",
    "SubjectModel",
    "SolverOptions",
    "Weights",
    "ImuSites",
    "Session",
    "load_session",
    "open_session",
    "Detections",
    "Estimate",
    "ImuReading",
    "Observation",
    "Status",
]


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module 'fusecap' has no attribute '{name}'")
    return getattr(importlib.import_module(f"fusecap.{_HOME[name]}"), name)


def __dir__() -> list[str]:
    return sorted(_HOME)
