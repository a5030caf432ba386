"""Runs in Pose2Sim's own environment: associates, triangulates and filters one prepared project.

    python pose2sim_driver.py PROJECT_FOLDER

Its configuration is the one that Pose2Sim ships with its multi-person demo, but for what describes
the recording, what would open windows, and what PROJECT_FOLDER/skeleton.json says. The last line it
prints is JSON: its version, and wall and processor seconds per stage.
"""

from __future__ import annotations

import json
import sys
import time
from importlib.metadata import version
from pathlib import Path

import Pose2Sim
import rtoml
from Pose2Sim.filtering import filter_all
from Pose2Sim.personAssociation import associate_all
from Pose2Sim.triangulation import triangulate_all


def main() -> None:
    project = Path(sys.argv[1]).resolve()
    shipped = Path(Pose2Sim.__file__).parent / "Demo_MultiPerson" / "Config.toml"
    config = rtoml.load(shipped)
    config["project"].update(project_dir=str(project), frame_rate=25, multi_person=True)
    config["project"]["session_dir"] = str(project)
    config["pose"]["pose_model"] = "SHELF"
    config["pose"]["SHELF"] = json.loads((project / "skeleton.json").read_text())
    config["filtering"].update(display_figures=False, save_filt_plots=False)
    seconds = {}
    for stage in (associate_all, triangulate_all, filter_all):
        wall, processor = time.perf_counter(), time.process_time()
        stage(config)
        taken = [time.perf_counter() - wall, time.process_time() - processor]
        seconds[stage.__name__] = taken
    print(json.dumps({"version": version("pose2sim"), "seconds": seconds}))


if __name__ == "__main__":
    main()
