"""Own detector: pictures in, keypoints out, with where people are expected.

    python examples/2_own_detector.py

A detector is any object with the four members below. `LiveRun` and `detect_videos` take it, and so
does an application's own loop, as here. This one reads pictures in which every landmark is a dot
whose blue says which landmark it is and whose red says whose.
"""

from collections.abc import Sequence

import cv2
import numpy as np

import fusecap
from fusecap.evaluate.demo_scene import demo_scene


class DotDetector:
    """Finds everyone in the pictures of one instant."""

    identity = "dots 1"
    landmarks = fusecap.landmark_set_named("body25")

    def detect(
        self, images: Sequence[np.ndarray | None], predicted: Sequence[np.ndarray]
    ) -> tuple[np.ndarray, ...]:
        """Per camera (people, 25, 3): x, y [px] and confidence; NaN, NaN, 0 where missing.

        `predicted` are the keypoints of those expected there; dots are found without them.
        """
        return tuple(self._people(image) for image in images)

    def _people(self, image: np.ndarray | None) -> np.ndarray:
        count = len(self.landmarks.landmark_names)
        if image is None:
            return np.empty((0, count, 3))
        y, x = np.nonzero(image[:, :, 0])
        person, landmark = image[y, x, 2].astype(int), image[y, x, 0].astype(int) - 1
        dot = person * count + landmark
        size = 1 + dot.max(initial=-1) // count
        pixels, *sums = (np.bincount(dot, weights, size * count) for weights in (None, x, y))
        with np.errstate(invalid="ignore"):
            found = np.stack([*(one / pixels for one in sums), pixels > 0], axis=1)
        return found.reshape(size, count, 3)

    def reset(self) -> None:
        """Nothing is kept from one instant to the next."""


def picture(size_px: tuple[int, int], people: np.ndarray) -> np.ndarray:
    """What a camera would show of these keypoints."""
    image = np.zeros((size_px[1], size_px[0], 3), dtype=np.uint8)
    for number, person in enumerate(people):
        for landmark, (x, y, confidence) in enumerate(person):
            if confidence > 0:
                cv2.circle(image, (round(x), round(y)), 2, (landmark + 1, 255, number), -1)
    return image


scene = demo_scene(seconds=1.0)
detector = DotDetector()
pipeline = fusecap.Pipeline(
    fusecap.Setup(
        rig=scene.rig,
        landmarks=detector.landmarks,
        skeleton=fusecap.PAPER21,
        prior=fusecap.load_prior(fusecap.PAPER21),
        rate_hz=60.0,
        tracker=fusecap.TrackerOptions(max_subjects=2, volume_m=scene.volume_m),
    )
)
errors_mm = []
for instant, seen in enumerate(scene.detections):
    images = [
        picture(camera.size_px, people)
        for camera, people in zip(scene.rig.cameras, seen.people, strict=True)
    ]
    expected = pipeline.expected(seen.timestamp_ns)
    people = detector.detect(images, expected)
    detections = fusecap.Detections(timestamp_ns=seen.timestamp_ns, people=people)
    for estimate in pipeline.step(detections, readings={}).estimates:
        truth_m = scene.truth.bone_position_in_world_m[:, instant]
        distance_m = np.linalg.norm(estimate.bone_position_in_world_m - truth_m, axis=2)
        errors_mm.append(1e3 * distance_m.mean(axis=1).min())
print(f"{len(errors_mm)} poses, mean joint position error {np.mean(errors_mm):.1f} mm")
