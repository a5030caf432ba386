"""Make the demo's motion from takes that the pose prior never saw."""

from __future__ import annotations

from pathlib import Path

from fusecap.motion.clips import Clip, save_clips

DURATION_S = 12.0

CLIPS = (
    Clip(
        name="basketball",
        take="bvh/06_12",
        start_s=0.0,
        speed=0.81,
        heading_deg=35.0,
        centre_m=(0.0, 0.0),
    ),
    Clip(
        name="traffic",
        take="expmap/train/directing_traffic/directing_traffic_4",
        start_s=13.0,
        speed=1.0,
        heading_deg=-60.0,
        centre_m=(1.0, -0.1),
    ),
    Clip(
        name="bystander",
        take="expmap/train/walking_extra/walking_50",
        start_s=0.0,
        speed=0.87,
        heading_deg=0.0,
        centre_m=(-3.0, 0.0),
    ),
)


def make_demo_motion(motion_folder: Path, path: Path) -> None:
    """Write the coefficients of `CLIPS`, taken from the CMU archives in `motion_folder`."""
    save_clips(motion_folder, path, CLIPS, duration_s=DURATION_S)
