"""Errors of poses against truth, as the literature counts them; one family per file.

Inside metres, seconds and radians; a report converts. NaN in an estimate or in the truth means
"not there" and makes every error that needs it NaN.
"""

from fusecap.evaluate.metrics.contact import foot_contact, foot_skate_m_s, standing_heights_m
from fusecap.evaluate.metrics.motion import acceleration_error_m_s2, jitter_m_s3
from fusecap.evaluate.metrics.people import (
    false_tracks,
    identity_switches,
    idf1,
    match_people,
    missed_tracks,
)
from fusecap.evaluate.metrics.pose import (
    aligned_error_m,
    aligned_orientation_error_rad,
    correct_limbs,
    orientation_error_rad,
    position_error_m,
    procrustes,
    procrustes_rotation,
    root_relative_error_m,
)
from fusecap.evaluate.metrics.summary import Summary, summarize
from fusecap.evaluate.metrics.twist import axial_error_rad, long_axes, swing_error_rad

__all__ = [
    "Summary",
    "acceleration_error_m_s2",
    "aligned_error_m",
    "aligned_orientation_error_rad",
    "axial_error_rad",
    "correct_limbs",
    "false_tracks",
    "foot_contact",
    "foot_skate_m_s",
    "identity_switches",
    "idf1",
    "jitter_m_s3",
    "long_axes",
    "match_people",
    "missed_tracks",
    "orientation_error_rad",
    "position_error_m",
    "procrustes",
    "procrustes_rotation",
    "root_relative_error_m",
    "standing_heights_m",
    "summarize",
    "swing_error_rad",
]
