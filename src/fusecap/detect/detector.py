"""What finds people in images: the one interface between videos and keypoints."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float, UInt8

from fusecap.body.landmarks import LandmarkSet

DEFAULT_MODEL = "rtmpose-m-halpe26"
DEFAULT_PERSON_MODEL = "rtmdet-nano-person"

REVISION = 3
"""Of the way from images to keypoints. Raise it with every change that gives other keypoints for
the same video: colours of decoded pictures, crops, decoding of outputs, thresholds, who is kept,
when the person detector runs, where people are expected (`fusecap.batch`). Keypoints of another
revision are detected anew."""


@runtime_checkable
class Detector(Protocol):
    """Finds everyone in the images of one instant; holds no clock."""

    @property
    def landmarks(self) -> LandmarkSet:
        """What the keypoints are."""
        ...

    @property
    def identity(self) -> str:
        """Networks by name and checksum, the options that change results, and `REVISION`."""
        ...

    def detect(
        self,
        images: Sequence[UInt8[np.ndarray, "h w 3"] | None],
        predicted: Sequence[Float[np.ndarray, "m k 3"]],
    ) -> tuple[Float[np.ndarray, "n k 3"], ...]:
        """Per camera the n people's keypoints: x, y [px], confidence 0-1; NaN, NaN, 0 if missing.

        Images are BGR, None where a camera has none. `predicted` holds per camera the keypoints of
        people who are expected there (projected from predicted skeletons, or those of the instant
        before); empty where nobody is known.
        """
        ...

    def reset(self) -> None:
        """Forget earlier instants: the next one looks for everyone anew."""
        ...


@dataclass(frozen=True, slots=True, kw_only=True)
class DetectorOptions:
    """Which networks, and how often."""

    model: str = DEFAULT_MODEL
    """Pose network: a name of the model store, or a path to .onnx or OpenVINO .xml."""
    person_model: str = DEFAULT_PERSON_MODEL
    """Person detector, likewise; not used by networks that take whole images."""
    runtime: str = "auto"
    """"onnxruntime", "openvino", or "auto": by file type and what is installed."""
    person_every: int = 10
    """Instants between runs of the person detector; it also runs when someone is missing."""
    packed: bool = False
    """Pack all views into one mosaic for whole-image networks, the person detector included."""
