"""What a live run knows before the first sample."""

from __future__ import annotations

from dataclasses import dataclass

from fusecap.body.landmarks import LANDMARK_SETS, LandmarkSet
from fusecap.geometry.camera import Rig
from fusecap.sources.offset_files import read_offsets
from fusecap.sources.session import Session
from fusecap.sources.session_data import common_landmarks, open_rig


@dataclass(frozen=True, kw_only=True)
class LiveSetup:
    """Everything that poses depend on besides the events."""

    session: Session
    """Its settings, subjects with their sensors, and the solver's options; files are not opened."""
    rig: Rig
    """In the order of the session's cameras; empty without any."""
    landmarks: LandmarkSet
    """What the keypoints are, with the session's offsets."""
    simulated: bool = False


def setup_of(
    session: Session, landmark_set: LandmarkSet | None = None, *, simulated: bool = False
) -> LiveSetup:
    """Opens calibration and offsets; `landmark_set` is the detector's, where one is in the loop.

    Raises `SessionError` for cameras without a calibration or with different keypoints.
    """
    rig, _ = open_rig(session)
    if landmark_set is None:
        landmarks = common_landmarks(session) or LANDMARK_SETS["body25"]
    elif session.settings.landmark_offsets is None:
        landmarks = landmark_set
    else:
        offsets = read_offsets(session.settings.landmark_offsets, landmark_set.name)
        landmarks = landmark_set.calibrated(offsets)
    return LiveSetup(session=session, rig=rig, landmarks=landmarks, simulated=simulated)
