"""Scenes of close people are what they say: truth along paths, losses by whole stretches."""

from __future__ import annotations

import numpy as np
import pytest

from fusecap.errors import InputError
from fusecap.evaluate.close_groups import close_group_simulation, with_losses


def detected(simulation):
    """(c, p, t) who is detected by whom."""
    return np.array(
        [
            [[p in who for who in view.person] for p in range(len(simulation.people))]
            for view in simulation.views
        ]
    )


@pytest.mark.slow
def test_two_exchange_places_where_nobody_sees_them_and_losses_last_half_a_second():
    simulation = close_group_simulation("behind an occluder", imus=6, training=True)
    root_m = simulation.truth.bone_position_in_world_m[:, :, 0][..., [0, 2]]
    assert root_m[0, 0, 0] * root_m[0, -1, 0] < 0 or np.ptp(root_m[0], axis=0).max() > 3.0
    inside = np.linalg.norm(root_m, axis=2) < 0.8
    seen = detected(simulation)
    assert inside.any(axis=1).all() and not seen[:, inside].any()
    assert seen[:, ~inside].mean() > 0.8
    lossy = detected(with_losses(simulation, share=0.3, seed=1))
    stretches = lossy[:, :, :600].reshape(4, 2, 20, 30).any(axis=3)
    full = seen[:, :, :600].reshape(4, 2, 20, 30).any(axis=3)
    assert 0.15 < 1.0 - stretches.sum() / full.sum() < 0.45
    assert not (lossy & ~seen).any()


def test_unknown_scene_is_named():
    with pytest.raises(InputError, match="hug"):
        close_group_simulation("hugg 0.3 m")
