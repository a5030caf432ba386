"""Pose2Sim on Shelf beside fusecap: same detections, same truth, same 3D PCP, seconds.

    uv venv pose2sim-env && uv pip install --python pose2sim-env pose2sim
    uv run python benchmarks/peers/pose2sim_shelf.py SHELF_FOLDER pose2sim-env/bin/python

SHELF_FOLDER is that of benchmarks/shelf.py. Pose2Sim stays in its own environment and keeps its
default settings. Its BODY_25 leaves out the ears, which the chin of the scoring rule needs, so they
are added to the skeleton it is given. Both its triangulated and its filtered points are scored.
"""

from __future__ import annotations

import argparse
import json
import re
import subprocess
import sys
import tarfile
import tempfile
import time
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from shelf import CAMERAS, TRUTH, solve_shelf

from fusecap.evaluate.datasets.shelf import ACTORS, LIMBS, load_truth, score_people
from fusecap.evaluate.metrics import correct_limbs, identity_switches, match_people

FRAMES = 150
_LEGS = ("RAnkle", "RKnee", "RHip", "LHip", "LKnee", "LAnkle")
_ARMS = ("RWrist", "RElbow", "RShoulder", "LShoulder", "LElbow", "LWrist")
POSE2SIM_NAMES = _LEGS + _ARMS
"""In the order of Shelf's joints 0-11."""
BODY25_TREE = {
    ("CHip", 8): {
        ("RHip", 9): {
            ("RKnee", 10): {
                ("RAnkle", 11): {("RBigToe", 22): {("RSmallToe", 23): {}}, ("RHeel", 24): {}}
            }
        },
        ("LHip", 12): {
            ("LKnee", 13): {
                ("LAnkle", 14): {("LBigToe", 19): {("LSmallToe", 20): {}}, ("LHeel", 21): {}}
            }
        },
        ("Neck", 1): {
            ("Nose", 0): {("REar", 17): {}, ("LEar", 18): {}},
            ("RShoulder", 2): {("RElbow", 3): {("RWrist", 4): {}}},
            ("LShoulder", 5): {("LElbow", 6): {("LWrist", 7): {}}},
        },
    }
}
HEAD_FORWARD_M, HEAD_UP_M = 0.125, 0.145
"""See fusecap.evaluate.datasets.shelf."""


def write_project(folder: Path, target: Path) -> None:
    """Shelf as a Pose2Sim project: calibration, a keypoint folder per camera, the skeleton."""
    with tarfile.open(folder / "openpose_body25.tar.xz") as archive:
        for member in archive:
            found = re.search(r"(\d)_(\d{12})_keypoints\.json$", member.name)
            source = archive.extractfile(member) if found else None
            if found and source and int(found[2]) < FRAMES:
                to = target / "pose" / f"cam{found[1]}_json" / f"cam{found[1]}_{found[2]}.json"
                to.parent.mkdir(parents=True, exist_ok=True)
                to.write_bytes(source.read())
    lines = []
    for camera in CAMERAS:
        calibration = json.loads((folder / "calibs" / f"{camera}.json").read_text())
        world = np.array(calibration["RT"]).reshape(3, 4)
        rotation = Rotation.from_matrix(world[:, :3]).as_rotvec()
        lines += [
            f"[cam{camera}]",
            f'name = "cam{camera}"',
            f"size = {[float(size) for size in calibration['imgSize']]}",
            f"matrix = {np.array(calibration['K']).reshape(3, 3).tolist()}",
            "distortions = [0.0, 0.0, 0.0, 0.0]",
            f"rotation = {rotation.tolist()}",
            f"translation = {world[:, 3].tolist()}",
            "fisheye = false",
            "",
        ]
    (target / "calibration").mkdir()
    (target / "calibration" / "Calib_shelf.toml").write_text("\n".join(lines))
    (target / "skeleton.json").write_text(json.dumps(_nodes(BODY25_TREE)[0]))


def _nodes(tree: dict) -> list[dict]:
    return [
        {"name": name, "id": number, "children": _nodes(children)}
        for (name, number), children in tree.items()
    ]


def read_people(paths: list[Path]) -> np.ndarray:
    """Shelf's 15 points (people, FRAMES, 15, 3) from TRC files, y up as those are; NaN = absent."""
    people = np.full((len(paths), FRAMES, 15, 3), np.nan)
    for person, path in enumerate(paths):
        lines = path.read_text().splitlines()
        names = [name for name in lines[3].split("\t")[2:] if name.strip()]
        rows = np.array([[float(x) for x in line.split("\t") if x.strip()] for line in lines[5:]])
        columns = rows[:, 2:].reshape(len(rows), len(names), 3)
        marker = {name: columns[:, index] for index, name in enumerate(names)}
        points = np.full((len(rows), 15, 3), np.nan)
        points[:, :12] = np.stack([marker[name] for name in POSE2SIM_NAMES], axis=1)
        hips = (points[:, 2] + points[:, 3]) / 2
        right, left = points[:, 8], points[:, 9]
        forward = np.cross(left - hips, right - hips)
        forward /= np.maximum(np.linalg.norm(forward, axis=1, keepdims=True), 1e-9)
        ears = (marker["REar"] + marker["LEar"]) / 2
        points[:, 12] = ((left + right) / 2 + ears) / 2
        points[:, 13] = points[:, 12] + HEAD_FORWARD_M * forward + [0.0, HEAD_UP_M, 0.0]
        points[:, 14] = hips
        people[person, rows[:, 0].astype(int)] = points
    return people


def score(people: np.ndarray, truth_path: Path) -> tuple[float, dict[int, float], int]:
    """PCP by the rules of fusecap.evaluate.datasets.shelf: mean, per actor; identity switches."""
    # From our y up (x, z, -y) to the TRC's (y, z, x): only distances count, but axes must agree.
    truth = load_truth(truth_path).points_in_world_m
    actors = [actor for actor in ACTORS if actor < len(truth)]
    truth = np.stack([-truth[actors][..., 2], truth[actors][..., 1], truth[actors][..., 0]], -1)
    limbs = np.array([limb for group in LIMBS.values() for limb in group])
    match = match_people(people, truth, gate_m=np.inf)
    actor, frame = np.nonzero(match >= 0)
    matched = np.full_like(truth, np.nan)
    matched[actor, frame] = people[match[actor, frame], frame]
    correct = correct_limbs(matched, truth, limbs)
    scored = np.isfinite(truth[:, :, limbs].sum(axis=(-2, -1)))
    pcp = {
        actors[row]: 100.0 * float(correct[row][scored[row]].mean())
        for row in range(len(actors))
        if scored[row].any()
    }
    return float(np.mean(list(pcp.values()))), pcp, identity_switches(match_people(people, truth))


def line(name: str, pcp: float, actors: dict[int, float], switches: int, seconds: str) -> str:
    each = ", ".join(f"{actor}: {value:.1f}" for actor, value in actors.items())
    return f"| {name} | {pcp:.2f} | {each} | {switches} | {seconds} |"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("python", type=Path, help="interpreter of Pose2Sim's environment")
    arguments = parser.parse_args()
    truth = arguments.folder / TRUTH
    with tempfile.TemporaryDirectory() as temporary:
        target = Path(temporary)
        write_project(arguments.folder, target)
        driver = Path(__file__).with_name("pose2sim_driver.py")
        # Not resolved: an environment is found by the name that its interpreter is called by.
        command = [str(arguments.python.absolute()), str(driver), str(target)]
        done = subprocess.run(command, capture_output=True, text=True, check=False, cwd=target)
        if done.returncode:
            raise SystemExit(f"Pose2Sim failed:\n{done.stdout}\n{done.stderr}")
        report = json.loads(done.stdout.strip().splitlines()[-1])
        files = sorted((target / "pose-3d").glob("*.trc"))
        filtered = [path for path in files if "_filt" in path.name]
        raw = [path for path in files if "_filt" not in path.name]
        triangulated, smoothed = score(read_people(raw), truth), score(read_people(filtered), truth)
    wall, processor = time.perf_counter(), time.process_time()
    take = solve_shelf(arguments.folder, frames=FRAMES, floor=True)
    ours = score_people(take, load_truth(truth))
    wall, processor = time.perf_counter() - wall, time.process_time() - processor

    stages = report["seconds"]
    solve = [sum(stages[name][i] for name in ("associate_all", "triangulate_all")) for i in (0, 1)]
    every = [sum(stage[i] for stage in stages.values()) for i in (0, 1)]
    print(f"Pose2Sim {report['version']}, frames 0-{FRAMES - 1}\n")
    print("| system | 3D PCP [%] | per actor | identity switches | seconds, wall (processor) |")
    print("|---|---|---|---|---|")
    seconds = f"{wall:.1f} ({processor:.1f})"
    print(line("fusecap", ours.pcp, ours.actor_pcp, ours.identity_switches, seconds))
    print(line("Pose2Sim, filtered", *smoothed, f"{every[0]:.1f} ({every[1]:.1f})"))
    print(line("Pose2Sim, triangulated", *triangulated, f"{solve[0]:.1f} ({solve[1]:.1f})"))


if __name__ == "__main__":
    main()
