"""The clips that fusecap ships as motion, and how their files are made again.

    python -m fusecap.motion.shipped CMU_FOLDER OUT_FOLDER

writes `demo_motion.npz` (twelve seconds of takes that the pose prior never saw) and
`twin_motion.npz` (ten seconds each of 19 takes, `fusecap.evaluate.twin`). Names of the twin's clips
are "subject name"; `TEST_CLIPS` come from takes that neither trained the prior nor serve any
tuning, `TRAINING_CLIPS` from takes that trained it.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

from fusecap.motion.clips import Clip, save_clips

DEMO_CLIPS = (
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

TEST_CLIPS = (
    Clip(name="S1 FS3", take="asfamc/03/03_03", start_s=20.0),
    Clip(name="S2 FS1", take="expmap/train/walking_extra/walking_24", start_s=0.2),
    Clip(name="S2 ROM3", take="expmap/train/directing_traffic/directing_traffic_4", start_s=0.5),
    Clip(name="S3 FS1", take="asfamc/02/02_08", start_s=0.5),
    Clip(name="S3 FS3", take="expmap/test/jumping/jumping_1", start_s=3.0),
    Clip(name="S4 FS3", take="asfamc/02/02_10", start_s=0.5),
    Clip(name="S5 A3", take="expmap/test/washwindow/washwindow_1", start_s=0.5),
    Clip(name="S5 FS1", take="bvh/14_08", start_s=2.0),
    Clip(name="group walk", take="asfamc/03/03_04", start_s=0.5),
    Clip(name="group round", take="expmap/train/walking_extra/walking_50", start_s=0.2),
    Clip(name="group signals", take="expmap/train/basketball_signal/basketball_signal_5"),
)
"""The eight sequences of the twin, named after those of the paper's table 1, and three more that
only appear in scenes with several people."""

TRAINING_CLIPS = (
    Clip(name="T1 FS1", take="asfamc/02/02_05", start_s=2.0),
    Clip(name="T1 FS2", take="asfamc/02/02_06", start_s=1.0),
    Clip(name="T2 W1", take="expmap/train/walking_extra/walking_23", speed=0.81),
    Clip(name="T2 ROM1", take="expmap/train/directing_traffic/directing_traffic_1", start_s=1.0),
    Clip(name="T3 FS1", take="asfamc/02/02_07", start_s=1.0),
    Clip(name="T3 FS2", take="expmap/train/jumping/jumping_2", start_s=1.0),
    Clip(name="T4 FS1", take="bvh/06_11", speed=0.9),
    Clip(name="T5 A1", take="expmap/train/basketball_signal/basketball_signal_1", start_s=1.0),
)


def main(motion_folder: Path, out: Path) -> None:
    """Both files, from the CMU archives in `motion_folder`; raises `InputError`."""
    save_clips(motion_folder, out / "demo_motion.npz", DEMO_CLIPS, duration_s=12.0)
    twin = (*TEST_CLIPS, *TRAINING_CLIPS)
    save_clips(motion_folder, out / "twin_motion.npz", twin, duration_s=10.0, precision=np.float16)


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
