"""Make the motion of the twin (`fusecap.evaluate.twin`): ten seconds each of 19 takes.

`TEST_CLIPS` come from takes that neither trained the pose prior nor serve any tuning;
`TRAINING_CLIPS` from takes that trained the prior. Names are "subject name".
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from fusecap.motion.clips import Clip, save_clips

DURATION_S = 10.0

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


def make_twin_motion(motion_folder: Path, path: Path) -> None:
    """Write the coefficients of all clips, taken from the CMU archives in `motion_folder`."""
    clips = (*TEST_CLIPS, *TRAINING_CLIPS)
    save_clips(motion_folder, path, clips, duration_s=DURATION_S, precision=np.float16)
