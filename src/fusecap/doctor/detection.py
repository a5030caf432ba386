"""Videos without keypoints yet: whether they open, and whether there are networks to read them."""

from __future__ import annotations

from fusecap.batch.detect import detector_options
from fusecap.detect.build import build_detector
from fusecap.detect.detector import DetectorOptions
from fusecap.detect.model_store import model_path, to_download
from fusecap.detect.runtimes.choice import runtime_for
from fusecap.doctor.videos import check_videos
from fusecap.errors import FusecapError
from fusecap.findings import Findings
from fusecap.sources.session import Session
from fusecap.sources.session_cameras import refuse_other_landmarks


def check_detection(session: Session, findings: Findings) -> None:
    """Checks what `fusecap detect` would need."""
    undetected = {
        camera.name: camera.video
        for camera in session.cameras
        if camera.keypoints is None and camera.video is not None
    }
    if not undetected:
        return
    if check_videos(undetected, findings):
        findings.add(
            "info",
            "videos",
            f"{len(undetected)} of {len(session.cameras)} cameras have no keypoints yet: "
            f"{', '.join(undetected)}",
            "fusecap detect finds them; fusecap solve does so too",
        )
    _check_networks(session, detector_options(session), findings)


def _check_networks(session: Session, options: DetectorOptions, findings: Findings) -> None:
    """Whether they are there, then whether they make a detector of the other cameras' keypoints."""
    there = True
    for model in dict.fromkeys((options.model, options.person_model)):
        try:
            stored = to_download(model)
            there &= stored is None
            if stored is not None and stored.url is None:
                model_path(model)  # says where it comes from
            elif stored is not None:
                findings.add(
                    "info",
                    "detector",
                    f"the network '{model}' is not on this machine yet",
                    f"fusecap detect downloads it once, from {stored.url}",
                )
            path = model_path(model) if stored is None else f"{model}{stored.suffix}"
            runtime_for(path, options.runtime)
        except FusecapError as error:
            there = False
            findings.add("error", "detector", str(error))
    if there:
        try:
            detector = build_detector(options, threads=1)
            refuse_other_landmarks(session, detector.landmarks.name)
        except FusecapError as error:
            findings.add("error", "detector", str(error).removeprefix(f"{session.path}: "))
