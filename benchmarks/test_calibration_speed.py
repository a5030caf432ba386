"""Board images of four cameras to a calibrated and checked rig.

uv run pytest --benchmark-only benchmarks/test_calibration_speed.py
"""

import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from board_images import CHARUCO, camera, pose, rendered
from fusecap.calibrate.cameras.board_views import read_shots
from fusecap.calibrate.cameras.report import calibrate_rig

CAMERAS, IMAGES = 4, 60


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    """Rendered images 1280 x 720 of a board carried about, and the true cameras."""
    folder = tmp_path_factory.mktemp("boards")
    cameras = []
    for index in range(CAMERAS):
        place = np.eye(4)
        turn = Rotation.from_euler("yx", [20.0 * index - 30.0, 5.0], degrees=True)
        place[:3, :3], place[:3, 3] = turn.as_matrix(), [0, 0, 1.8]
        cameras.append(camera(f"c{index}", focal=1000.0, size=(1280, 720), pose=place))
        (folder / f"c{index}").mkdir()
        for image in range(IMAGES):
            board = np.random.default_rng(image)
            there = pose(board.uniform(-25, 25, 3), board.uniform(-0.3, 0.3, 3))
            picture = rendered(CHARUCO, cameras[-1], place @ there, noise=2.0, seed=image)
            cv2.imwrite(str(folder / f"c{index}" / f"{image:03d}.jpg"), picture)
    return folder, cameras


@pytest.mark.benchmark(group="calibration")
def test_four_cameras_sixty_boards(benchmark, recording):
    folder, cameras = recording

    def calibrate():
        found = [read_shots(c.name, folder / c.name, CHARUCO) for c in cameras]
        return calibrate_rig(cameras, found, CHARUCO)

    result = benchmark.pedantic(calibrate, rounds=1, iterations=1)
    assert result.report.instants > 50
