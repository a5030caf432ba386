"""Networks that find everyone's keypoints in a whole image at once: RTMO.

Outputs as exported by mmdeploy: `dets` (n, N, 5) and `keypoints` (n, N, k, 3), on the letterboxed
canvas, raw BGR pixels (mmpose `rtmo_*` configs).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, UInt8

from fusecap.body.landmarks import LandmarkSet
from fusecap.detect.detector import REVISION
from fusecap.detect.images import RAW_BGR, letterbox
from fusecap.detect.people import distinct, within
from fusecap.detect.person import LEAST_SCORE, canvas_size
from fusecap.detect.pose import landmarks_for
from fusecap.detect.runtimes.network import Network
from fusecap.errors import InputError

_OUTPUTS = ("dets", "keypoints")


def is_one_stage(network: Network) -> bool:
    """Whether the outputs are those of RTMO."""
    return {tensor.name for tensor in network.outputs} >= set(_OUTPUTS)


class OneStageDetector:
    """Everyone's keypoints, each image in one run; keeps nothing between instants."""

    def __init__(self, network: Network, landmarks: LandmarkSet | None = None) -> None:
        by_name = {tensor.name: tensor for tensor in network.outputs}
        shape = by_name["keypoints"].shape
        if len(shape) != 4 or shape[2] is None or shape[3] not in (3, None):
            raise InputError(
                f"{network.path}: 'keypoints' is {shape}, expected (n, people, keypoints, 3)"
            )
        self._network = network
        self.landmarks = landmarks_for(network, shape[2], landmarks)

    @property
    def identity(self) -> str:
        """The network's, the threshold and the revision."""
        return f"{self._network.identity} score {LEAST_SCORE}; revision {REVISION}"

    def canvas_size(self, image_size: tuple[int, int]) -> tuple[int, int]:
        """Width and height of the network's input for an image (w, h)."""
        return canvas_size(self._network, image_size)

    def find(
        self, images: Sequence[UInt8[np.ndarray, "_ _ 3"]]
    ) -> tuple[Float[np.ndarray, "_ k 3"], ...]:
        """Per BGR image the people: x, y [px], confidence 0-1; NaN, NaN, 0 if missing."""
        found: list[np.ndarray] = [self._nobody()] * len(images)
        shapes = [(image.shape[1], image.shape[0]) for image in images]
        sizes = [self.canvas_size(shape) for shape in shapes]
        for size in dict.fromkeys(sizes):
            chosen = [i for i, other in enumerate(sizes) if other == size]
            placed = [letterbox(images[i], size) for i in chosen]
            outputs = self._network.run(RAW_BGR.batch([canvas for canvas, _ in placed]))
            for row, (i, (_, placement)) in enumerate(zip(chosen, placed, strict=True)):
                good = outputs["dets"][row, :, 4] >= LEAST_SCORE
                people = outputs["keypoints"][row, good].astype(np.float64)
                people[:, :, :2] = placement.to_image(people[:, :, :2])
                people[:, :, 2] = np.clip(people[:, :, 2], 0.0, 1.0)
                people = within(people, shapes[i])
                found[i] = people[distinct(people)]
        return tuple(found)

    def detect(
        self,
        images: Sequence[UInt8[np.ndarray, "_ _ 3"] | None],
        predicted: Sequence[Float[np.ndarray, "_ k 3"]],
    ) -> tuple[Float[np.ndarray, "_ k 3"], ...]:
        """Per camera everyone in the image; `predicted` is not needed."""
        present = [i for i, image in enumerate(images) if image is not None]
        found = self.find([image for image in images if image is not None])
        result = [self._nobody()] * len(images)
        for i, people in zip(present, found, strict=True):
            result[i] = people
        return tuple(result)

    def reset(self) -> None:
        """Nothing to forget."""

    def _nobody(self) -> np.ndarray:
        return np.empty((0, len(self.landmarks.landmark_names), 3))
