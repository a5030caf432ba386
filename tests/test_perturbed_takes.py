"""The same take, perturbed, gives the same people: a single run hides how near the cliff is."""

import pytest
import shelf_perturbed
from shelf_perturbed import RUNS, UNPERTURBED, falls, joints_of

from fusecap.evaluate.datasets.shelf import load_shelf

FRAMES = 150


@pytest.mark.real_data
@pytest.mark.slow
def test_shelf_loses_and_exchanges_nobody_but_one_in_24_perturbed_runs(data_dir):
    sequence = load_shelf(data_dir / "shelf")
    reference = joints_of(sequence, UNPERTURBED, FRAMES)
    runs = [run for run in RUNS if run[0] == shelf_perturbed.NOISE_PX[0]]
    fallen = [run for run in runs if falls(joints_of(sequence, run, FRAMES), reference, run[2])]
    assert len(runs) == 24 and len(fallen) <= 1, fallen
