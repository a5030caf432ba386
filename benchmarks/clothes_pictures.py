"""How differently people look from themselves and from each other: Pose2Sim's demo videos. Real.

    uv run python benchmarks/clothes_pictures.py DATA/pose2sim_demo MODELS

Each camera by itself, every second frame of 100: whoever is found near where somebody was is taken
for the same; people come and go, so some are followed twice. A person's own difference is that of
the first third of their pictures from the last third.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass, field
from itertools import combinations
from pathlib import Path

import av
import numpy as np

from fusecap.appearance import by_part, difference
from fusecap.detect.build import build_detector
from fusecap.detect.clothes import ClothesReader
from fusecap.detect.detector import DetectorOptions

CLIPS = ("HEAD_Demo_SinglePerson", "HEAD_Demo_MultiPerson")
NEAR_PX, FEWEST = 120.0, 12


@dataclass
class Seen:
    """Somebody in one camera."""

    centre_px: np.ndarray
    looks: list[np.ndarray] = field(default_factory=list)

    def mean(self, some: slice) -> np.ndarray:
        return by_part(np.mean(self.looks[some], axis=0))[None]


def followed(video_path: Path, options: DetectorOptions) -> list[Seen]:
    detector = build_detector(options)
    reader = ClothesReader(detector.landmarks)
    people: list[Seen] = []
    with av.open(str(video_path)) as video:
        for number, frame in enumerate(video.decode(video=0)):
            if number % 2:
                continue
            image = frame.to_ndarray(format="bgr24")
            (found,) = detector.detect([image], [np.empty((0, 17, 3))])
            for person, looks in zip(found, reader.read(image, found), strict=True):
                centre_px = np.median(person[person[:, 2] > 0.3, :2], axis=0)
                if not looks.any() or not np.isfinite(centre_px).all():
                    continue
                near = [p for p in people if np.hypot(*(p.centre_px - centre_px)) < NEAR_PX]
                if not near:
                    near = [Seen(centre_px)]
                    people += near
                near[0].centre_px = centre_px
                near[0].looks.append(looks.astype(float))
    return [person for person in people if len(person.looks) >= FEWEST]


def main(data: Path, models: Path) -> None:
    options = DetectorOptions(
        model=str(models / "tinypose_ir" / "tinypose_128_96_fp16.xml"),
        person_model=str(models / "rtmdet_nano" / "rtmdet_nano_person_320.onnx"),
    )
    for clip in CLIPS:
        for path in sorted((data / clip / "videos").glob("*.mp4")):
            people = followed(path, options)
            third = [len(person.looks) // 3 for person in people]
            own = [
                difference(p.mean(slice(n)), p.mean(slice(-n, None)))[0]
                for p, n in zip(people, third, strict=True)
            ]
            others = [
                difference(a.mean(slice(None)), b.mean(slice(None)))[0]
                for a, b in combinations(people, 2)
            ]
            print(f"{clip} {path.stem}: own {np.round(own, 2)}, others {np.round(others, 2)}")


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
