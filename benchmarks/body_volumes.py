"""Whether bodies in touch are solved into each other, so that volumes would have to part them.

    uv run python benchmarks/body_volumes.py

Simulated (twin v2, training bodies and clips), four cameras, solved as `fusecap solve` does. Torsos
are segments from hips to neck; counted are instants in which the true ones are nearer than 0.6 m:
how far the solved distance is from the true one, and how often it is 0.1 m less.
"""

from __future__ import annotations

from itertools import combinations

import numpy as np
from close_groups import CELLS
from jaxtyping import Float

from fusecap.evaluate.close_groups import close_group_simulation, with_losses
from fusecap.evaluate.simulated_solve import solve_simulation
from fusecap.take import Take

SCENES = ("hug 0.3 m", "wrestle", "dance")
NEAR_M, INSIDE_M = 0.6, 0.1
ENDS = ("hips", "neck")


def torso_m(take: Take, name: str) -> Float[np.ndarray, "t p 3"]:
    """Points along a torso."""
    ends = [take.skeleton.bone_names.index(end) for end in ENDS]
    lower, upper = take.bone_position_in_world_m[take.subject(name)][:, ends].swapaxes(0, 1)
    share = np.linspace(0.0, 1.0, 12)[:, None]
    return lower[:, None] + share * (upper - lower)[:, None]


def apart_m(take: Take, a: str, b: str) -> Float[np.ndarray, " t"]:
    between = torso_m(take, a)[:, :, None] - torso_m(take, b)[:, None]
    return np.linalg.norm(between, axis=3).min(axis=(1, 2))


def main() -> None:
    print("| scene | sensors | lost | instants | error mean, 1 %, 99 % [mm] | into each other |")
    print("|---|---|---|---|---|---|")
    for scene in SCENES:
        for imus, loss in CELLS:
            simulation = close_group_simulation(scene, cameras=4, imus=imus, training=True)
            if loss:
                simulation = with_losses(simulation, share=loss, seed=101)
            take = solve_simulation(simulation).take
            errors_m = []
            for a, b in combinations(take.subject_names, 2):
                true_m, solved_m = apart_m(simulation.truth, a, b), apart_m(take, a, b)
                near = np.isfinite(solved_m) & (true_m < NEAR_M)
                errors_m.append((solved_m - true_m)[near])
            error_m = np.concatenate(errors_m)
            low, high = np.percentile(error_m, [1, 99]) * 1e3
            inside = (error_m < -INSIDE_M).mean()
            print(
                f"| {scene} | {imus} | {loss:.0%} | {len(error_m)} | "
                f"{error_m.mean() * 1e3:.0f}, {low:.0f}, {high:.0f} | {inside:.1%} |",
                flush=True,
            )


if __name__ == "__main__":
    main()
