"""A take says where somebody is only as long as something tells."""

from dataclasses import replace

import numpy as np
import pytest

from fusecap.evaluate.simulated_solve import solve_simulation
from fusecap.stored_take import load_take
from fusecap.take import save_take
from live_scene import capture
from motions import person, take_of, walk


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
    for measured in take.measured:
        assert not measured[unseen].any()
        assert measured[:40].all() and measured[47:80].all()


def test_whom_a_sensor_measures_is_no_prediction():
    """Cameras see nobody for a while; who wears sensors goes on being measured."""
    simulation = replace(capture(1.2, synchronous=True))
    seen = simulation.detections
    nobody = tuple(np.empty((0, 25, 3)) for _ in seen[0].people)
    simulation.__dict__["detections"] = tuple(
        replace(detections, people=nobody) if 40 <= instant < 50 else detections
        for instant, detections in enumerate(seen)
    )
    take = solve_simulation(simulation).take
    worn = [row for row, name in enumerate(take.subject_names) if name in simulation.imus]
    assert worn and take.measured[worn].all()


def test_a_stored_take_says_what_was_measured_and_an_older_one_that_all_was(tmp_path):
    shapes = [person(1.6), person(1.8)]
    take = take_of(np.stack([walk(shape, 9) for shape in shapes]), shapes, names=("a", "b"))
    take = replace(take, measured=take.tracked & (np.arange(9) % 3 > 0))
    path = tmp_path / "take.npz"
    save_take(take, path)
    assert np.array_equal(load_take(path).measured, take.measured)
    with np.load(path) as arrays:
        older = {name: arrays[name] for name in arrays.files if name != "measured"}
    np.savez(path, **older)
    assert np.array_equal(load_take(path).measured, take.tracked)
    assert not replace(take, tracked=take.tracked & False).measured.any()
