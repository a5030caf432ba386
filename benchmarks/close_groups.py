"""Who is who among people who touch, cross and crowd: twin v2, with and without lost detections.

    uv run python benchmarks/close_groups.py [--training] [--cameras 4] [SCENE ...]

Simulated (`evaluate/close_groups.py`), start positions known, 13 sensors or none; every camera
loses each person in 0 or 30 % of half-second stretches. Solved as `fusecap solve` does. IDF1,
and switches of identity in ten seconds, over the frames in which some camera detects somebody: feet
slide in these scenes, so where nobody is seen sensors cannot know the way.
"""

from __future__ import annotations

import argparse
from dataclasses import replace

import numpy as np

from fusecap.evaluate.close_groups import CLOSE_GROUPS, close_group_simulation, with_losses
from fusecap.evaluate.score import score_take
from fusecap.evaluate.simulated_solve import solve_simulation
from fusecap.evaluate.simulator import Simulation
from fusecap.take import Take

CELLS = ((13, 0.0), (13, 0.3), (0, 0.0), (0, 0.3))
"""Sensors, and the share of stretches lost."""


def both_seen(take: Take, simulation: Simulation) -> tuple[Take, Take]:
    """A take and its truth without the frames in which no camera detects somebody."""
    truth = simulation.truth
    seen = np.zeros(truth.tracked.shape, dtype=bool)
    for view in simulation.views:
        for frame, who in enumerate(view.person):
            seen[[p for p in who.tolist() if 0 <= p < len(seen)], frame] = True
    named = [truth.subject(name) for name in take.subject_names]
    return _only(take, seen[named]), _only(truth, seen)


def _only(take: Take, seen: np.ndarray) -> Take:
    tracked = take.tracked & seen
    position = np.where(tracked[:, :, None, None], take.bone_position_in_world_m, np.nan)
    return replace(take, tracked=tracked, bone_position_in_world_m=position)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("scenes", nargs="*", default=list(CLOSE_GROUPS))
    parser.add_argument(
        "--training", action="store_true", help="other bodies and clips, to tune on"
    )
    parser.add_argument("--cameras", type=int, default=4)
    arguments = parser.parse_args()
    print("| scene | " + " | ".join(f"{n} sensors, {loss:.0%} lost" for n, loss in CELLS) + " |")
    print("|---|" + "---|" * len(CELLS))
    for scene in arguments.scenes:
        row = []
        for imus, loss in CELLS:
            simulation = close_group_simulation(
                scene, cameras=arguments.cameras, imus=imus, training=arguments.training
            )
            if loss:
                simulation = with_losses(simulation, share=loss, seed=1)
            take = solve_simulation(simulation).take
            score = score_take(*both_seen(take, simulation), gate_m=0.5)
            row.append(f"{score.idf1:.3f}, {score.identity_switches}")
        print(f"| {scene} | " + " | ".join(row) + " |", flush=True)


if __name__ == "__main__":
    main()
