"""A take says where somebody is only as long as something tells."""

from dataclasses import replace

import numpy as np
import pytest

from fusecap.evaluate.simulated_solve import solve_simulation
from live_scene import capture


@pytest.mark.slow
def test_a_gap_is_bridged_and_after_the_last_sight_nobody_is_tracked():
    simulation = replace(capture(2.0, synchronous=True, imus=False))
    seen = simulation.detections
    unseen = [*range(40, 46), *range(80, len(seen))]
    nobody = tuple(np.empty((0, 25, 3)) for _ in seen[0].people)
    simulation.__dict__["detections"] = tuple(
        replace(detections, people=nobody) if instant in unseen else detections
        for instant, detections in enumerate(seen)
    )
    take = solve_simulation(simulation).take
    for tracked in take.tracked:
        assert tracked[:80].all() and not tracked[80:].any()
