"""Detected keypoints against OpenPose's of the same clip: Pose2Sim's balancing trial.

    uv run fusecap detect SESSION                       the four videos of HEAD_Demo_SinglePerson
    uv run python benchmarks/detection_accuracy.py SESSION/keypoints \\
        DATA/pose2sim_demo/v0.8.4_openpose_body25b/pose_json.tar.xz

OpenPose's keypoints are not the truth: the table says how far two detectors are apart. Compared are
OpenPose's people with at least 12 of 17 keypoints above 0.3, each with the nearest one detected,
over all frames; keypoints count that both are sure of (0.3). Sides are swapped where limbs fit
better the other way round.
"""

from __future__ import annotations

import argparse
import json
import tarfile
from pathlib import Path

import numpy as np

from fusecap.body.landmarks import LANDMARK_SETS
from fusecap.sources.keypoint_files import read_keypoints

TRIAL = "BalancingTrial"
COCO = LANDMARK_SETS["coco17"]
LEFT, RIGHT = np.arange(5, 16, 2), np.arange(6, 17, 2)
SURE, LEAST = 0.3, 12


def openpose(archive: Path) -> dict[tuple[int, int], np.ndarray]:
    """By (view from 1, frame) the people's 17 COCO keypoints, which BODY_25B lists first."""
    found = {}
    with tarfile.open(archive) as files:
        for member in files:
            name = member.name.rsplit("/", 1)[-1].split(".")
            content = files.extractfile(member)
            if TRIAL not in member.name or name[-1] != "json" or content is None:
                continue
            people = [p["pose_keypoints_2d"] for p in json.load(content)["people"]]
            keypoints = np.array(people, dtype=float).reshape(len(people), -1, 3)[:, :17]
            found[int(name[0][-2:]), int(name[1])] = keypoints
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("keypoints", type=Path, help="with folders cam01 to cam04")
    parser.add_argument("openpose", type=Path)
    parser.add_argument("--landmarks", default="coco17", choices=("coco17", "blazepose33"))
    arguments = parser.parse_args()
    landmarks = LANDMARK_SETS[arguments.landmarks]
    others = openpose(arguments.openpose)
    print("view   people/frame  compared  missed  median px  90 % px  sides swapped")
    for folder in sorted(arguments.keypoints.glob("cam0?")):
        track = read_keypoints(folder, name=folder.name, landmarks=landmarks, rate_hz=60.0)
        apart, compared, missed, swapped = [], 0, 0, 0
        for frame, found in enumerate(track.people):
            people = found[:, : len(COCO.landmark_names)]  # which come first in both
            for other in others.get((int(folder.name[-2:]), frame), ()):
                if np.sum(other[:, 2] > SURE) < LEAST:
                    continue
                compared += 1
                both = (people[:, :, 2] > SURE) & (other[:, 2] > SURE)
                distance = np.linalg.norm(people[:, :, :2] - other[:, :2], axis=2)
                typical = [np.median(d[b]) for d, b in zip(distance, both, strict=True) if b.any()]
                if len(typical) < len(people) or not len(people):
                    missed += 1
                    continue
                best = int(np.argmin(typical))
                apart.append(distance[best][both[best]])
                limbs = both[best, LEFT] & both[best, RIGHT]
                crossed = np.linalg.norm(people[best, LEFT, :2] - other[RIGHT, :2], axis=1)
                crossed += np.linalg.norm(people[best, RIGHT, :2] - other[LEFT, :2], axis=1)
                straight = distance[best, LEFT] + distance[best, RIGHT]
                swapped += int(crossed[limbs].sum() < straight[limbs].sum())
        pixels = np.concatenate(apart)
        count = np.mean([len(people) for people in track.people])
        median, most = np.percentile(pixels, [50, 90])
        print(
            f"{folder.name}  {count:12.2f}  {compared:8d}  {missed:6d}  {median:9.1f}  "
            f"{most:7.1f}  {swapped:13d}"
        )


if __name__ == "__main__":
    main()
