"""What is left of poses when cameras and sensors vanish, against the simulated truth.

    uv run python benchmarks/live_outages.py

Scenes of 40 s, simulated: two subjects and a bystander before four cameras at 25 to 30 Hz that
nobody synchronised, 13 sensors each or none, solved at 60 Hz without a clock. Prints per phase the
share of instants with a pose, the mean error of joints, the mean turn of bones and the quality at
the end of the phase, then the fastest movement between two outputs and the cost of an instant. Of
sensors alone for four seconds, which drift by chance, a line per seed of the simulated noise.
"""

from __future__ import annotations

import sys
import tempfile
import time
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))

import live_scene
from fusecap.engine.engine import Engine, LiveStep
from fusecap.evaluate.simulator import Simulation
from live_events import merged
from live_scene import Phase

ALL = (0, 1, 2, 3)
SECONDS = 40.0
SCENES = {
    "cameras and sensors": [
        Phase(0, ALL, True, "4 cameras, sensors"),
        Phase(6, (0,), True, "1 camera, sensors"),
        Phase(11, (), True, "sensors"),
        Phase(15, (), False, "nothing"),
        Phase(17, ALL, True, "4 cameras, sensors"),
        Phase(22, (1,), False, "1 camera"),
        Phase(27, (), False, "nothing"),
        Phase(29, ALL, False, "4 cameras"),
        Phase(33, (), False, "nothing"),
        Phase(36, ALL, True, "all back"),
    ],
    "cameras only": [
        Phase(0, ALL, False, "4 cameras"),
        Phase(5, (0, 1, 3), False, "3 cameras"),
        Phase(8, (0, 1), False, "2 cameras"),
        Phase(11, (0,), False, "1 camera"),
        Phase(31, (), False, "nothing"),
        Phase(33, ALL, False, "all back"),
    ],
}
VANISHING = [
    Phase(start_s, cameras, True, f"{len(cameras)} cameras, sensors")
    for seen_s in (0, 8, 16, 24, 32)
    for start_s, cameras in ((seen_s, ALL), (seen_s + 4, ()))
]
SEEDS = (0, 1, 2, 3)


def outputs(simulation: Simulation, phases: list[Phase]) -> tuple[list[LiveStep], list[float]]:
    """What a live run gives, and how long each took [ms]."""
    with tempfile.TemporaryDirectory() as folder:
        engine = Engine(live_scene.simulated_setup(simulation, Path(folder)))
    samples = live_scene.kept(live_scene.samples_of(simulation), phases)
    steps, tick_ms = [], []
    for event in merged(samples, live_scene.ticks_of(simulation)):
        start_s = time.perf_counter()
        step = engine.take(event)
        if step is not None:
            tick_ms.append(1e3 * (time.perf_counter() - start_s))
            steps.append(step)
    return steps, tick_ms


def main() -> None:
    for scene, phases in SCENES.items():
        simulation = live_scene.capture(SECONDS, imus=scene != "cameras only")
        steps, tick_ms = outputs(simulation, phases)
        print(f"\n### {scene} (simulated)\n")
        print("| from s | left | with a pose | joints mm | bones deg | quality |")
        print("|---|---|---|---|---|---|")
        for phase, result in zip(phases, live_scene.score(simulation, steps, phases), strict=True):
            print(
                f"| {phase.start_s:g} | {phase.name} | {100 * result.sent_share:.0f} % "
                f"| {result.error_mm:.0f} | {result.turn_deg:.0f} | {result.quality:.2f} |"
            )
        for name in ("anna", "ben"):
            fast = live_scene.fastest(steps, name)
            print(
                f"\nfastest of {name}: hips {fast.root_m_s:.1f}, joint {fast.joint_m_s:.1f} m/s, "
                f"bone {fast.bone_rad_s:.0f} rad/s"
            )
        median, p99 = np.percentile(tick_ms, [50, 99])
        print(f"\nan instant takes {median:.2f} ms (median), {p99:.2f} ms (p99)")
    print("\n### cameras vanish for 4 s, five times (simulated): joints mm\n")
    print("| seed | each | mean |\n|---|---|---|")
    for seed in SEEDS:
        simulation = live_scene.capture(SECONDS, seed=seed)
        steps, _ = outputs(simulation, VANISHING)
        away = [s.error_mm for s in live_scene.score(simulation, steps, VANISHING)[1::2]]
        print(f"| {seed} | {', '.join(f'{mm:.0f}' for mm in away)} | {np.mean(away):.0f} |")


if __name__ == "__main__":
    main()
