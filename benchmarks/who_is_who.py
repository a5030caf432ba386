"""Who is who when nobody says so: sensors without start positions, exchanges, lost detections.

    uv run python benchmarks/who_is_who.py

Simulated twin groups (test sequences), 4 and 8 cameras. First, people with 13 or 6 sensors and no
start positions, named in either order: when each was first followed under the right name, instants
under a wrong one, names that were moved; then the same with two people exchanged by force at 4 s.
Second, every camera loses each person in 30 % of half-second stretches: IDF1 and switches, with and
without sensors, start positions known.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from fusecap.associate.tracker import Tracker
from fusecap.evaluate.close_groups import with_losses
from fusecap.evaluate.score import score_take
from fusecap.evaluate.simulated_solve import setup_of_simulation, solve_simulation
from fusecap.evaluate.simulator import Simulation
from fusecap.evaluate.twin import GROUPS, twin_group_simulation
from fusecap.pipeline import Pipeline
from fusecap.solve.options import SolverOptions

CAMERAS = (4, 8)
FORCED_AT_S = 4.0
LOSS = 0.3
"""Share of half-second stretches."""


def main() -> None:
    for group in GROUPS:
        for cameras in CAMERAS:
            for imus in (13, 6):
                simulation = twin_group_simulation(group, cameras=cameras, imus=imus)
                where = f"{group}, {cameras} cameras, {imus} sensors"
                print(f"{where}: {paired(simulation)}")
                print(f"    other order: {paired(simulation, backwards=True)}")
                print(f"    exchanged at {FORCED_AT_S:g} s: {paired(simulation, force=True)}")
    for group in GROUPS:
        for cameras in CAMERAS:
            for imus in (13, 0):
                simulation = twin_group_simulation(group, cameras=cameras, imus=imus)
                take = solve_simulation(with_losses(simulation, share=LOSS, seed=1)).take
                score = score_take(take, simulation.truth, gate_m=0.5)
                print(
                    f"{group}, {cameras} cameras, {imus} sensors, {LOSS:.0%} lost: IDF1 "
                    f"{score.idf1:.3f}, {score.identity_switches} switches",
                    flush=True,
                )


def paired(simulation: Simulation, *, backwards: bool = False, force: bool = False) -> str:
    setup = setup_of_simulation(simulation, options=SolverOptions(window=1))
    subjects = [replace(model, start_m=None) for model in setup.subjects]
    subjects = tuple(subjects[::-1] if backwards else subjects)
    pipeline = Pipeline(replace(setup, subjects=subjects))
    truth, right, wrong, notes = simulation.truth, {}, 0, []
    for instant, detections in enumerate(simulation.detections):
        if force and instant == round(FORCED_AT_S * simulation.rate_hz):
            exchange(pipeline)
        readings = {name: rows[instant] for name, rows in simulation.imu_readings.items()}
        step = pipeline.step(detections, readings)
        notes += step.notes
        for estimate in step.estimates:
            root_m = estimate.bone_position_in_world_m[0]
            away_m = np.linalg.norm(truth.bone_position_in_world_m[:, instant, 0] - root_m, axis=1)
            if truth.subject_names[int(np.argmin(away_m))] == estimate.name:
                right.setdefault(estimate.name, instant / simulation.rate_hz)
            else:
                wrong += 1
    named = ", ".join(f"{name} {at_s:.2f} s" for name, at_s in right.items())
    return f"{named}; {wrong} wrong, {len(notes)} names moved"


def exchange(pipeline: Pipeline) -> None:
    """The first two subjects' tracks, with what is known of their poses."""
    tracker = pipeline._sorter
    assert isinstance(tracker, Tracker)
    first, second = [place for place in tracker._cast.places if place.live][:2]
    one, other = first.track, second.track
    assert one is not None and other is not None
    first.track, second.track = other, one
    one.track_id, other.track_id = other.track_id, one.track_id
    for place in (first, second):
        pipeline._estimators.pop(place.name, None)


if __name__ == "__main__":
    main()
