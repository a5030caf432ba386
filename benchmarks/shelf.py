"""Solves the Shelf sequence from its OpenPose keypoints and scores it: 3D PCP, identity switches.

    uv run python benchmarks/shelf.py FOLDER [--no-floor] [--frames 150] [--out take.npz]

FOLDER holds `openpose_body25.tar.xz`, `calibs/` and `gt_frames_000_149.txt`. Nobody is named, no
height is given, and every option is the default.
"""

from __future__ import annotations

import argparse
import re
import tarfile
import tempfile
import time
from pathlib import Path

from fusecap.batch.solve import solve_session
from fusecap.evaluate.datasets.shelf import ShelfScore, load_truth, score_people
from fusecap.sources.session_data import open_session
from fusecap.sources.session_file import load_session
from fusecap.take import Take, save_take

CAMERAS = ("0", "1", "2", "3", "4")
TRUTH = "gt_frames_000_149.txt"


def write_shelf_session(folder: Path, target: Path, *, frames: int, floor: bool) -> Path:
    """Unpack the first `frames` frames into `target`, with a session file, and return its path."""
    with tarfile.open(folder / "openpose_body25.tar.xz") as archive:
        for member in archive:
            number = re.search(r"_(\d{12})_keypoints\.json$", member.name)
            if number and int(number[1]) < frames:
                archive.extract(member, target, filter="data")
    lines = [
        "[session]",
        'name = "shelf"',
        "rate_hz = 25.0",
        f"calibration = '{(folder / 'calibs').resolve()}'",
        'up = "z"',
        f"floor = {str(floor).lower()}",
    ]
    for camera in CAMERAS:
        lines += ["", "[[camera]]", f'name = "{camera}"', f'keypoints = "{camera}"']
        lines += ['format = "openpose-body25"', "rate_hz = 25.0"]
    path = target / "session.toml"
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return path


def solve_shelf(folder: Path, *, frames: int, floor: bool) -> Take:
    with tempfile.TemporaryDirectory() as target:
        path = write_shelf_session(folder, Path(target), frames=frames, floor=floor)
        return solve_session(open_session(load_session(path))).whole_take


def table(score: ShelfScore) -> str:
    rows = [f"actor {actor:<12} {pcp:6.2f}" for actor, pcp in score.actor_pcp.items()]
    rows += [f"{kind:<18} {pcp:6.2f}" for kind, pcp in score.limb_pcp.items()]
    rows += [
        f"{'3D PCP [%]':<18} {score.pcp:6.2f}   mean over the actors present",
        f"{'person-frames':<18} {score.person_frames:6d}   {score.missed_person_frames} missed",
        f"{'identity switches':<18} {score.identity_switches:6d}",
    ]
    return "\n".join(rows)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--no-floor", action="store_true", help="switch the floor term off")
    parser.add_argument("--frames", type=int, default=150, help="how many to solve")
    parser.add_argument("--out", type=Path, help="also write the take")
    arguments = parser.parse_args()
    started = time.perf_counter()
    take = solve_shelf(arguments.folder, frames=arguments.frames, floor=not arguments.no_floor)
    if arguments.out:
        save_take(take, arguments.out)
    people = len(take.subject_names)
    print(f"{arguments.frames} frames, {people} people, {time.perf_counter() - started:.1f} s")
    print(table(score_people(take, load_truth(arguments.folder / TRUTH))))


if __name__ == "__main__":
    main()
