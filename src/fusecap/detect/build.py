"""From options to a detector."""

from __future__ import annotations

from fusecap.body.landmarks import LandmarkSet
from fusecap.detect.blazepose import (
    BlazePersonDetector,
    BlazePose,
    finds_keypoints,
    finds_people,
)
from fusecap.detect.detector import Detector, DetectorOptions
from fusecap.detect.model_store import model_path
from fusecap.detect.one_stage import OneStageDetector, is_one_stage
from fusecap.detect.packing import PackedDetector, PackedPersonDetector
from fusecap.detect.person import PersonDetector
from fusecap.detect.pose import PoseNetwork
from fusecap.detect.runtimes.choice import open_network
from fusecap.detect.runtimes.network import Network
from fusecap.detect.top_down import TopDownDetector
from fusecap.errors import InputError
from fusecap.progress import Progress


def build_detector(
    options: DetectorOptions,
    progress: Progress | None = None,
    *,
    landmarks: LandmarkSet | None = None,
    threads: int | None = None,
    follow_others: bool = True,
) -> Detector:
    """Fetch the networks where needed, load them and put them together.

    `landmarks` says what the keypoints are where their number does not; `threads` None: all cores.
    `follow_others` is `TopDownDetector`'s.
    Raises `InputError` where a network is unknown, cannot be fetched or loaded, or does not fit.
    """
    if options.person_every < 1:
        raise InputError(f"person_every is {options.person_every}, expected 1 or more instants")
    network = _load(options.model, options.runtime, progress, threads)
    if is_one_stage(network):
        detector = OneStageDetector(network, landmarks)
        return PackedDetector(detector) if options.packed else detector
    pose = BlazePose(network) if finds_keypoints(network) else PoseNetwork(network, landmarks)
    boxes = _load(options.person_model, options.runtime, progress, threads)
    if not finds_people(boxes):
        person = PersonDetector(boxes)
        finder = PackedPersonDetector(person) if options.packed else person
    elif options.packed:
        raise InputError(
            f"{boxes.path}: finds who is near, and in a mosaic everybody is far; leave out packed"
        )
    else:
        finder = BlazePersonDetector(boxes)
    return TopDownDetector(finder, pose, options.person_every, follow_others=follow_others)


def _load(model: str, runtime: str, progress: Progress | None, threads: int | None) -> Network:
    return open_network(model_path(model, progress), runtime, threads)
