"""One solve of the simulated twin, as a cell of a grid: plain values in, plain values out."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import Any, Literal

import numpy as np
from jaxtyping import Float

from fusecap.body.landmarks import LandmarkOffsets, LandmarkSet
from fusecap.evaluate.metrics import aligned_error_m, position_error_m, summarize
from fusecap.evaluate.score import score_take
from fusecap.evaluate.simulated_solve import ahead_takes, live_takes, solve_simulation
from fusecap.evaluate.simulator import Simulation
from fusecap.evaluate.twin import (
    GROUPS,
    told_by_height,
    twin_group_simulation,
    twin_sequence,
    twin_simulation,
)
from fusecap.files import plain
from fusecap.solve.options import SolverOptions, Weights
from fusecap.take import Take

LIMBS_12 = tuple(
    f"{side}_{part}"
    for side in ("left", "right")
    for part in ("shoulder", "elbow", "wrist", "hip", "knee", "ankle")
)
"""The keypoints that Malleson et al. (2017) used: K12 of the paper's table 3."""

LATE_S = 0.1
"""Of poses that have settled, and of the pictures that others are ahead of."""
_SPINE = ("spine", "spine1", "spine2", "spine3")
"""The joints that Human3.6M does not have; 17 of 21 remain [1, sec. 4.1.3]."""


def default_weights() -> dict[str, float]:
    """The solver's own, in full, so that a cell says what it was solved with."""
    return asdict(Weights())


@dataclass(frozen=True, kw_only=True)
class TwinCell:
    """What to solve, and how."""

    scene: str
    """A sequence ('S1 FS3') or a group ('duo')."""
    cameras: int = 8
    """The first so many of the ring."""
    every_other_camera: bool = False
    """Of those, the first, third and so on."""
    imus: Literal[0, 6, 13] = 13
    weights: Mapping[str, float] = field(default_factory=default_weights)
    associate: str = "tracker"
    keypoints: Literal["body25", "limbs12"] = "body25"
    offsets: Mapping[str, Sequence[float]] | None = None
    """Calibrated landmark offsets of everyone, by stature; None: the defaults."""
    body: Literal["measured", "height"] = "measured"
    """What the solver knows of the bones: true lengths, or proportions of the stature."""
    seed: int = 0
    live: bool = False
    """Also score what a live run has: the newest pose, one settled for `LATE_S`, and where pictures
    come as late the last one that they reached and one ahead of them."""
    trace: bool = False
    """Return the places of the root and of a wrist over time as well."""


def solve_cell(cell: TwinCell) -> dict[str, Any]:
    """Score, root trace and times of one solve; NaN becomes None."""
    simulation = simulation_of(cell)
    options = SolverOptions(weights=Weights.named(**cell.weights))
    solved = solve_simulation(simulation, options=options, associate=cell.associate)
    take = solved.whole_take
    # One person is who they are, however far away the estimate has drifted.
    gate_m = np.inf if len(simulation.people) == 1 else 0.5
    score = score_take(take, simulation.truth, gate_m=gate_m)
    result = {
        "score": asdict(score),
        "floor": below_floor(take),
        "joints17": _over_17_joints(take, simulation.truth),
        "solve_ms_median": solved.report.solve_ms_median,
        "solve_ms_p99": solved.report.solve_ms_p99,
        "frames": solved.report.instants,
    }
    if cell.live:
        newest, settled = live_takes(simulation, options=options, lag_s=LATE_S)
        result["newest"] = asdict(score_take(newest, simulation.truth, gate_m=gate_m))
        result["settled"] = asdict(score_take(settled, simulation.truth, gate_m=gate_m))
        seen, ahead = ahead_takes(simulation, options=options, late_s=LATE_S)
        result["seen"] = asdict(score_take(seen, simulation.truth, gate_m=gate_m))
        result["ahead"] = asdict(score_take(ahead, simulation.truth, gate_m=gate_m))
    if cell.trace:
        result["root_m"] = np.round(take.theta[0, :, :3], 5).tolist()
        result["true_root_m"] = np.round(simulation.truth.theta[0, :, :3], 5).tolist()
        wrist = simulation.truth.bone_names.index("right_hand")
        for name, moved in (("wrist_m", take), ("true_wrist_m", simulation.truth)):
            place = moved.bone_position_in_world_m[0, :, wrist]
            result[name] = np.round(place, 5).tolist()
    return plain(result)


def simulation_of(cell: TwinCell) -> Simulation:
    """The capture that a cell solves."""
    if cell.scene in GROUPS:
        simulation = twin_group_simulation(
            cell.scene, cameras=cell.cameras, imus=cell.imus, seed=cell.seed
        )
    else:
        simulation = twin_simulation(
            twin_sequence(cell.scene), cameras=cell.cameras, imus=cell.imus, seed=cell.seed
        )
    if cell.every_other_camera:
        simulation = simulation.subset(cameras=simulation.rig.names[::2])
    if cell.keypoints == "limbs12":
        simulation = with_keypoints(simulation, LIMBS_12)
    if cell.offsets is not None:
        everyone = {name: (x, y, z) for name, (x, y, z) in cell.offsets.items()}
        landmarks = simulation.landmark_set.calibrated(LandmarkOffsets(everyone=everyone))
        simulation = replace(simulation, landmark_set=landmarks)
    if cell.body == "height":
        people = [replace(p, shape=told_by_height(p.shape)) for p in simulation.people]
        simulation = replace(simulation, people=tuple(people))
    return simulation


def with_keypoints(simulation: Simulation, landmarks: Sequence[str]) -> Simulation:
    """The same capture by a detector that finds only the named landmarks."""
    missing = np.array([name not in landmarks for name in simulation.landmark_set.landmark_names])

    def without(people: Float[np.ndarray, "n k 3"]) -> Float[np.ndarray, "n k 3"]:
        fewer = people.copy()
        fewer[:, missing] = [np.nan, np.nan, 0.0]
        return fewer

    views = [replace(v, people=tuple(without(p) for p in v.people)) for v in simulation.views]
    return replace(simulation, views=tuple(views))


def mean_offsets(simulations: Sequence[Simulation]) -> dict[str, tuple[float, float, float]]:
    """Where a detector puts landmarks, by stature: the mean over everyone in `simulations`.

    What eq. 17-18 come to with exact poses and enough frames; left and right are one, mirrored.
    """
    landmarks: LandmarkSet = simulations[0].landmark_set
    fractions = [
        offsets / person.shape.height_m
        for simulation in simulations
        for offsets, person in zip(simulation.landmark_offsets_m, simulation.people, strict=True)
    ]
    mean = np.mean(fractions, axis=0)
    mean = (mean + mean[landmarks.mirror] * [-1.0, 1.0, 1.0]) / 2
    return {
        name: (float(x), float(y), float(z))
        for name, (x, y, z) in zip(landmarks.landmark_names, mean, strict=True)
    }


def below_floor(take: Take) -> dict[str, float]:
    """How far the ankle and toe joints are under the floor, over tracked frames [mm, share]."""
    feet = [b for b, name in enumerate(take.bone_names) if name.endswith(("_foot", "_toes"))]
    height_m = take.bone_position_in_world_m[take.tracked][:, feet, 1]
    if not height_m.size:
        return {"share": math.nan, "mean_mm": math.nan, "worst_mm": math.nan}
    depth_mm = np.maximum(-height_m, 0.0) * 1e3
    return {
        "share": float((depth_mm > 0).mean()),
        "mean_mm": float(depth_mm.mean()),
        "worst_mm": float(depth_mm.max()),
    }


def _over_17_joints(take: Take, truth: Take) -> dict[str, float]:
    """Mean position errors of the first subject over Human3.6M's joints, the hips first [mm]."""
    joints = [bone for bone, name in enumerate(take.bone_names) if name not in _SPINE]
    found = take.tracked[0]
    estimate = take.bone_position_in_world_m[0, found][:, joints]
    true = truth.bone_position_in_world_m[0, found][:, joints]
    return {
        "position_mm": summarize(position_error_m(estimate, true)).mean * 1e3,
        "aligned_mm": summarize(aligned_error_m(estimate, true)).mean * 1e3,
    }
