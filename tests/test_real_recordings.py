"""Recordings made by others, end to end; figures are in docs/accuracy.md."""

import importlib.util
import sys
from pathlib import Path

import numpy as np
import pytest

from fusecap.batch.solve import solve_session
from fusecap.doctor import diagnose
from fusecap.evaluate.datasets.shelf import load_truth, score_people
from fusecap.sources.session_data import open_session
from fusecap.sources.session_file import load_session

pytestmark = [pytest.mark.real_data, pytest.mark.slow]


def script(path):
    spec = importlib.util.spec_from_file_location(
        Path(path).stem, Path(__file__).resolve().parents[1] / path
    )
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module  # dataclasses look their module up
    spec.loader.exec_module(module)
    return module


def solve(path):
    return solve_session(open_session(load_session(path)))


def test_walk_from_imus_alone_follows_vicon(data_dir, tmp_path):
    gait = script("examples/gait_imu_only.py")
    folder = data_dir / "gait_imu_vicon"
    take = solve(gait.write_session(folder, tmp_path)).take
    assert take.tracked.all()
    score = gait.score(take, folder)
    for bone, limit_deg in {"hips": 6, "thigh": 13, "shank": 13, "foot": 9}.items():
        assert all(e < limit_deg for b, e in score.orientation_deg.items() if bone in b)
    assert all(e < 4 for b, e in score.long_axis_deg.items() if "shank" in b)
    assert all(error < 10 for error in score.knee_rmse_deg.values())
    for ours, theirs in score.knee_flexion_deg.values():
        assert ours.min() > -5, "a knee bends forwards"
        assert 50 < ours.max() < 80 and abs(ours.max() - theirs.max()) < 12
        assert np.corrcoef(ours, theirs)[0, 1] > 0.95
    # Nothing observes where the walker is: the root stays where it started.
    root = take.bone_position_in_world_m[0, :, 0]
    assert np.ptp(root, axis=0).max() < 0.01


@pytest.mark.parametrize(("trial", "people"), [("balancing", 1), ("two-people", 2)])
def test_pose2sim_clip_is_followed_in_spite_of_its_calibration(data_dir, tmp_path, trial, people):
    folder = data_dir / "pose2sim_demo/v0.8.4_openpose_body25b"
    path = script("examples/pose2sim_clip.py").write_session(folder, tmp_path, trial)
    found = [str(finding) for finding in diagnose(path)]
    assert any("disagree" in text for text in found)
    assert not any("order" in text or "metres" in text for text in found)
    solved = solve(path)
    assert solved.report.instants == 100
    assert len(solved.report.subjects) == people
    assert all(s["tracked_share"] > 0.98 for s in solved.report.subjects.values())
    assert all(camera["median"] < 25 for camera in solved.report.reprojection_px.values())
    balancing = [s for s in solved.report.subjects.values() if s["height_m"] > 1.5]
    assert len(balancing) == 1 and balancing[0]["height_m"] == pytest.approx(1.7, abs=0.1)


def test_pose2sim_standing_person_is_read_in_the_right_order(data_dir, tmp_path):
    clip = script("examples/pose2sim_clip.py")
    clip.TRIALS["standing"] = ("S00_P00_SingleParticipant/S00_P00_T00_StaticTrial", 1)
    folder = data_dir / "pose2sim_demo/v0.8.4_openpose_body25b"
    path = clip.write_session(folder, tmp_path, "standing")
    assert not [finding for finding in diagnose(path) if finding.severity == "error"]


def test_shelf_is_solved_without_a_constant_of_its_own(data_dir, tmp_path):
    shelf = script("benchmarks/shelf.py")
    folder = data_dir / "shelf"
    path = shelf.write_shelf_session(folder, tmp_path, frames=150, floor=True)
    score = score_people(solve(path).take, load_truth(folder / shelf.TRUTH))
    assert score.pcp >= 98
    assert score.identity_switches == 0 and score.missed_person_frames == 0
