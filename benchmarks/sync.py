"""How far `fusecap calibrate sync` is from the truth.

    uv run python benchmarks/sync.py cameras [--seeds 2] [--no-calibration]
    uv run python benchmarks/sync.py imus [--seeds 3] [--training] [--drift]
    uv run python benchmarks/sync.py pose2sim DATA_FOLDER
    uv run python benchmarks/sync.py gait DATA_FOLDER

cameras and imus are simulated: the eight test sequences of the twin, 10 s each, before four
cameras, with the twin's faults of keypoints, sensors and rig and clocks wrong by up to 3 s;
searched in +-10 s (sensors +-3 s). For sensors two errors are given. *Aligned*: against the offset
at which the same sensor data fit the true bones, which is what a solve wants; flesh that lags is in
both. *Clock*: against the clock as it was set; the lag of the flesh counts as error. `--drift`
instead plays all clips of the twin one after the other on one body (160 s), and the sensors'
clock runs 100 ppm slow.

pose2sim is real: two clips of four cameras (pose2sim_demo/v0.8.4_openpose_body25b), frames dropped
from some. gait is half real: Xsens sensors on the legs of a walker against Vicon's segments, 4 s
(gait_imu_vicon), the sensors' times shifted; nothing is solved from video there.
"""

from __future__ import annotations

import argparse
import importlib.util
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from unittest.mock import patch

import numpy as np
from scipy.spatial.transform import Rotation

from fusecap.body.landmarks import landmark_set_named
from fusecap.calibrate.sync import session as sync_session
from fusecap.calibrate.sync.cameras import synchronise_cameras
from fusecap.calibrate.sync.imus import Filmed, TimedSensor, imu_clock
from fusecap.calibrate.sync.session import synchronise
from fusecap.calibrate.sync.signals import view_of
from fusecap.evaluate.imu_noise import IMUS_13
from fusecap.evaluate.simulated_solve import solve_simulation
from fusecap.evaluate.simulator import (
    CameraTiming,
    Person,
    Simulation,
    at_times,
    camera_ring,
    placed,
    simulate,
)
from fusecap.evaluate.twin import (
    TWIN_IMU_NOISE,
    TWIN_KEYPOINT_NOISE,
    TWIN_RIG_NOISE,
    TwinSequence,
    twin_sequences,
    twin_training_sequences,
)
from fusecap.sources.keypoint_files import KeypointTrack
from fusecap.sources.session_file import parse_session
from fusecap.take import Take

RATES_HZ = (60.0, 30.0, 50.0, 60.0)
STARTS_S = (0.0, 0.01, 0.02, 0.003)
DRIFT_PPM = 100.0


def capture(name: str, shape, theta: np.ndarray, seed: int, *, mixed: bool = False) -> Simulation:
    """One person before four cameras; `mixed`: of different rates."""
    timing = [CameraTiming(rate_hz=r, offset_s=o) for r, o in zip(RATES_HZ, STARTS_S, strict=True)]
    return simulate(
        [Person(name=name, shape=shape, theta=theta, imu_bones=() if mixed else IMUS_13)],
        camera_ring(4, radius_m=5.0),
        landmark_set_named("body25"),
        rate_hz=60.0,
        seed=seed,
        keypoint_noise=TWIN_KEYPOINT_NOISE,
        imu_noise=TWIN_IMU_NOISE,
        rig_noise=TWIN_RIG_NOISE,
        timing=timing if mixed else None,
    )


def cameras(seeds: int, calibrated: bool) -> None:
    rng = np.random.default_rng(0)
    errors, scores = [], []
    for sequence in twin_sequences():
        for seed in range(seeds):
            wrong_s = np.concatenate([[0.0], rng.uniform(-3, 3, 3)])
            simulation = capture(sequence.key, sequence.shape, sequence.theta, seed, mixed=True)
            views = [
                view_of(track, camera if calibrated else None)
                for track, camera in zip(
                    tracks_of(simulation, wrong_s), simulation.rig.cameras, strict=True
                )
            ]
            found = synchronise_cameras(
                simulation.rig if calibrated else None,
                views,
                simulation.landmark_set.landmark_names,
                max_offset_s=10.0,
            )
            apart_s = found.offset_s - wrong_s
            error_s = np.delete(apart_s - apart_s[found.reference], found.reference)
            errors += list(error_s)
            scores += list(error_s / np.delete(found.error_s, found.reference))
            print(sequence.key, seed, "ms", np.round(1e3 * error_s, 1), flush=True)
    summary("cameras", np.array(errors), np.array(scores))


def tracks_of(simulation: Simulation, wrong_s: np.ndarray) -> list[KeypointTrack]:
    """Cameras whose times lack `wrong_s`."""
    return [
        KeypointTrack(
            name=name,
            landmarks=simulation.landmark_set,
            rate_hz=view.timing.rate_hz,
            frames=np.arange(len(view.times_s)),
            times_s=view.times_s - wrong,
            people=view.people,
            broken=(),
        )
        for name, view, wrong in zip(simulation.rig.names, simulation.views, wrong_s, strict=True)
    ]


def summary(what: str, error_s: np.ndarray, score: np.ndarray | None = None) -> None:
    ms = 1e3 * np.abs(error_s)
    text = f"{what}: {len(ms)} offsets, median {np.median(ms):.1f} ms, worst {ms.max():.1f} ms"
    text += f", mean {1e3 * error_s.mean():+.1f} ms, below 5 ms in {100 * (ms < 5).mean():.0f} %"
    if score is not None:
        text += f", within 2 standard errors in {100 * (np.abs(score) < 2).mean():.0f} %"
    print(text)


def imus(seeds: int, training: bool) -> None:
    rng = np.random.default_rng(1)
    aligned, clock, scores = [], [], []
    for sequence in twin_training_sequences() if training else twin_sequences():
        for seed in range(100, 100 + seeds):
            simulation = capture(sequence.key, sequence.shape, sequence.theta, seed)
            solved = solve_simulation(simulation.subset(imu_bones=())).whole_take
            wrong_s = float(rng.uniform(-2, 2))
            sensors = worn(simulation, wrong_s)
            found = imu_clock(sensors, filmed(solved), max_offset_s=3.0)
            best = imu_clock(sensors, filmed(simulation.truth), max_offset_s=3.0)
            aligned.append(found.offset_s - best.offset_s)
            clock.append(found.offset_s - wrong_s)
            scores.append(aligned[-1] / found.error_s)
            print(
                f"{sequence.key} {seed}: aligned {1e3 * aligned[-1]:+.1f} ms, "
                f"clock {1e3 * clock[-1]:+.1f} ms, standard error {1e3 * found.error_s:.1f} ms",
                flush=True,
            )
    summary("aligned with the bones", np.array(aligned), np.array(scores))
    print(f"  root mean square {1e3 * np.sqrt(np.mean(np.square(aligned))):.2f} ms")
    summary("the clock itself", np.array(clock))


def filmed(take: Take) -> Filmed:
    rotation = take.bone_rotation_in_world(0).copy()
    rotation[~take.tracked[0]] = np.nan
    return Filmed(
        name=take.subject_names[0],
        times_s=take.time_s,
        bone_names=take.bone_names,
        rotation=rotation,
    )


def worn(simulation: Simulation, wrong_s: float, drift_ppm: float = 0.0) -> list[TimedSensor]:
    """The sensors, on times that lack `wrong_s` and run slow by `drift_ppm`."""
    imus = simulation.imus[simulation.people[0].name]
    return [
        TimedSensor(
            bone=bone,
            times_s=(imus.times_s[imus.received[:, index]] - wrong_s) / (1 + 1e-6 * drift_ppm),
            rotation=imus.world_from_imu[imus.received[:, index], index],
        )
        for index, bone in enumerate(imus.bones)
    ]


def drift(seeds: int) -> None:
    every = (*twin_sequences(), *twin_training_sequences())
    theta = chained(every)
    for seed in range(100, 100 + seeds):
        simulation = capture("all", every[0].shape, theta, seed)
        solved = solve_simulation(simulation.subset(imu_bones=())).whole_take
        sensors = worn(simulation, 0.5, DRIFT_PPM)
        found = imu_clock(sensors, filmed(solved), max_offset_s=3.0)
        best = imu_clock(sensors, filmed(simulation.truth), max_offset_s=3.0)
        print(
            f"{len(theta) / 60:.0f} s, seed {seed}: drift {found.drift_ppm:.1f} ppm of "
            f"{DRIFT_PPM:g}, standard error {found.drift_error_ppm:.1f}; aligned "
            f"{1e3 * (found.offset_s - best.offset_s):+.1f} ms",
            flush=True,
        )


def chained(sequences: Sequence[TwinSequence]) -> np.ndarray:
    """All motions about one place, one turning into the next within 0.7 s."""
    parts = [placed(sequences[0].theta, centre_m=(0.0, 0.0))]
    for sequence in sequences[1:]:
        ends = [parts[-1][-1], sequence.theta[0]]
        ahead = [Rotation.from_rotvec(row[3:6]).apply([0.0, 0.0, 1.0]) for row in ends]
        turn = np.arctan2(ahead[0][0], ahead[0][2]) - np.arctan2(ahead[1][0], ahead[1][2])
        following = placed(sequence.theta, turn_rad=float(turn), centre_m=(0.0, 0.0))
        steps = np.arange(1, 42) / 42
        parts += [at_times(np.stack([parts[-1][-1], following[0]]), 1.0, steps), following]
    return np.concatenate(parts)


def pose2sim(data: Path) -> None:
    clip = script("pose2sim_clip")
    folder = data / "pose2sim_demo/v0.8.4_openpose_body25b"
    for trial in ("balancing", "two-people"):
        with tempfile.TemporaryDirectory() as out:
            session = parse_session(clip.write_session(folder, Path(out), trial))
            whole = sync_session.open_keypoints(session)
            unshifted = np.zeros(len(whole))
            drops = ((0, 0, 0, 0), (0, 7, 0, 0), (0, 0, 13, 0), (0, 13, 7, 3), (5, 0, 0, 13))
            for dropped in drops:
                some = tuple(
                    replace(
                        track,
                        frames=track.frames[: len(track.frames) - k],
                        times_s=track.times_s[: len(track.frames) - k],
                        people=track.people[k:],
                    )
                    for track, k in zip(whole, dropped, strict=True)
                )
                with patch.object(sync_session, "open_keypoints", lambda *_, some=some: some):
                    found = synchronise(session)
                offsets = [np.nan if r.offset_s is None else r.offset_s for r in found.rows]
                frames = np.array(offsets) * clip.RATE_HZ
                error = frames - (np.array(dropped) - dropped[0])
                if not any(dropped):
                    unshifted = error
                print(
                    f"{trial}, dropped {dropped}: off by {np.round(error, 2)} frames "
                    f"({np.round(error - unshifted, 2)} from unshifted),",
                    ", ".join(row.word for row in found.rows),
                    flush=True,
                )


def gait(data: Path) -> None:
    walk = script("gait_imu_only")
    folder = data / "gait_imu_vicon"
    vicon = walk.read_vicon(folder / "vicon_first_400.csv")
    frames = len(vicon.rotation["hips"])
    truth = Filmed(
        name="walker",
        times_s=np.arange(frames) / walk.RATE_HZ,
        bone_names=tuple(walk.SEGMENTS),
        rotation=np.stack([vicon.rotation[b].as_matrix() for b in walk.SEGMENTS], axis=1),
    )
    sensors = {}
    for bone, (sensor, _) in walk.SEGMENTS.items():
        rotation = walk.world_from_imu(folder, sensor).as_matrix()
        times_s = np.arange(len(rotation)) / walk.RATE_HZ
        sensors[bone] = TimedSensor(bone=bone, times_s=times_s, rotation=rotation)
    for shift_s in (0.0, -0.35, 1.2, -2.417):
        moved = [replace(each, times_s=each.times_s - shift_s) for each in sensors.values()]
        for limit_s in (10.0, abs(shift_s) + 0.4):
            found = imu_clock(moved, truth, max_offset_s=limit_s)
            rivals = len(found.peak.rivals_s) if found.peak else 0
            print(
                f"shifted by {shift_s:+.3f} s, searched +-{limit_s:.1f} s: "
                f"{1e3 * (found.offset_s - shift_s):+.1f} ms off, standard error "
                f"{1e3 * found.error_s:.1f} ms, {rivals} rivals"
            )
    for bone, each in sensors.items():
        found = imu_clock([each], truth, max_offset_s=0.4)
        print(f"{bone}, alone and unshifted: {1e3 * found.offset_s:+.1f} ms")


def script(name: str) -> ModuleType:
    path = Path(__file__).resolve().parents[1] / f"examples/{name}.py"
    spec = importlib.util.spec_from_file_location(name, path)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    spec.loader.exec_module(module)
    return module


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("what", choices=["cameras", "imus", "pose2sim", "gait"])
    parser.add_argument("data", type=Path, nargs="?", help="folder of the real recordings")
    parser.add_argument("--seeds", type=int, default=2)
    parser.add_argument("--no-calibration", action="store_true", help="cameras: from speeds alone")
    parser.add_argument("--training", action="store_true", help="imus: the training sequences")
    parser.add_argument("--drift", action="store_true", help="imus: one long recording")
    arguments = parser.parse_args()
    if arguments.what in ("pose2sim", "gait") and arguments.data is None:
        parser.error(f"{arguments.what} needs the folder of the real recordings")
    if arguments.what == "cameras":
        cameras(arguments.seeds, not arguments.no_calibration)
    elif arguments.what == "imus":
        drift(arguments.seeds) if arguments.drift else imus(arguments.seeds, arguments.training)
    elif arguments.what == "pose2sim":
        pose2sim(arguments.data)
    else:
        gait(arguments.data)


if __name__ == "__main__":
    main()
