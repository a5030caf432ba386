"""Whole sessions, good and broken: a clear error, or a degraded result that says so."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from fusecap.batch.solve import Solved, _small_people, solve_session
from fusecap.errors import CalibrationError, InputError, SessionError
from fusecap.evaluate.demo_scene import demo_scene
from fusecap.evaluate.score import score_take
from fusecap.evaluate.simulated_session import write_session
from fusecap.evaluate.simulated_solve import solve_simulation
from fusecap.sources.session_data import open_session, unplaced_wearers
from fusecap.sources.session_file import load_session
from fusecap.stored_take import load_take

SECONDS = 1.0


@pytest.fixture(scope="module")
def original(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("original")
    write_session(demo_scene(0, seconds=SECONDS), folder)
    return folder


@pytest.fixture
def folder(original, tmp_path) -> Path:
    """A copy to break."""
    return Path(shutil.copytree(original, tmp_path / "session"))


def solve(folder: Path) -> Solved:
    return solve_session(open_session(load_session(folder)))


def edit(folder: Path, *changes: tuple[str, str]) -> None:
    file = folder / "session.toml"
    text = file.read_text()
    for old, new in changes:
        assert old in text, f"{old!r} is not in the session file"
        text = text.replace(old, new)
    file.write_text(text)


def without_tables(folder: Path, header: str, keep: int = 0) -> None:
    """Drop all tables `[[header]]` but the first `keep`, with their sub-tables."""
    file = folder / "session.toml"
    blocks = ("\n" + file.read_text()).split("\n[[")
    kept, seen = [blocks[0]], 0
    for block in blocks[1:]:
        mine = block.startswith(header)
        seen += mine and block.startswith(f"{header}]]")
        if not mine or seen <= keep:
            kept.append(block)
    file.write_text("\n[[".join(kept).lstrip("\n"))


def error_mm(solved: Solved, folder: Path) -> float:
    return score_take(solved.take, load_take(folder / "truth.npz")).position_error_mm.mean


def test_a_written_session_solves_like_the_simulation_it_came_from(original):
    direct = solve_simulation(demo_scene(0, seconds=SECONDS))
    truth = demo_scene(0, seconds=SECONDS).truth
    solved = solve(original)
    assert solved.take.tracked.mean() > 0.95
    assert error_mm(solved, original) == pytest.approx(
        score_take(direct.take, truth).position_error_mm.mean, abs=5.0
    )


def test_the_paper_sorter_solves_the_demo_too():
    simulation = demo_scene(0, seconds=SECONDS)
    solved = solve_simulation(simulation, associate="paper")
    score = score_take(solved.take, simulation.truth)
    assert score.identity_switches == 0
    assert score.found_share > 0.95
    assert score.position_error_mm.mean < 40


def test_without_subjects_people_are_found_and_measured(folder):
    without_tables(folder, "subject")
    solved = solve(folder)
    assert len(solved.take.subject_names) == 2
    assert solved.take.tracked.mean() > 0.9
    assert error_mm(solved, folder) < 60
    np.testing.assert_allclose(sorted(solved.take.heights_m), [1.68, 1.82], atol=0.1)


def test_one_camera_follows_one_subject_by_video_and_sensors(folder):
    without_tables(folder, "camera", keep=1)
    without_tables(folder, "subject", keep=1)
    edit(folder, ("max_subjects = 2", "max_subjects = 1"))
    solved = solve(folder)
    assert solved.report.cameras == 1
    assert solved.take.tracked.any()
    assert np.isfinite(solved.take.theta[solved.take.tracked]).all()
    assert error_mm(solved, folder) < 150


def test_one_camera_and_two_subjects_is_refused(folder):
    without_tables(folder, "camera", keep=1)
    with pytest.raises(SessionError, match="one camera"):
        solve(folder)


def test_without_cameras_sensors_alone_give_motion_from_foot_to_foot(folder):
    without_tables(folder, "camera")
    solved = solve(folder)
    assert solved.take.tracked.all()
    truth = load_take(folder / "truth.npz")
    moved = [np.diff(take.theta[:, :, [0, 2]], axis=1).sum(axis=1) for take in (solved.take, truth)]
    assert np.abs(moved[0] - moved[1][: len(moved[0])]).max() < 0.3
    score = score_take(solved.take, truth, gate_m=5.0)
    assert score.orientation_error_deg.median < 12


def test_nothing_to_solve_is_refused(folder):
    without_tables(folder, "camera")
    without_tables(folder, "subject")
    with pytest.raises(SessionError, match="nothing to solve"):
        solve(folder)


def test_a_camera_without_detections_costs_little(folder):
    for file in (folder / "keypoints" / "cam2").glob("*.json"):
        file.write_text(json.dumps({"version": 1.3, "people": []}))
    solved = solve(folder)
    assert solved.report.reprojection_px["cam2"]["keypoints"] == 0
    assert solved.report.as_json()["reprojection_px"]["cam2"]["median"] is None
    assert solved.take.tracked.mean() > 0.9
    assert error_mm(solved, folder) < 40


def test_no_detections_at_all_leave_a_take_that_says_untracked(folder):
    without_tables(folder, "subject")
    for camera in range(1, 5):
        for file in (folder / "keypoints" / f"cam{camera}").glob("*.json"):
            file.write_text(json.dumps({"version": 1.3, "people": []}))
    with pytest.raises(SessionError, match="no camera sees anyone"):
        solve(folder)
    solved = solve_session(open_session(load_session(folder)), anyway=True)
    assert len(solved.take.timestamps_ns) > 0
    assert not solved.take.tracked.any()


def test_some_broken_keypoint_files_are_reported_and_survived(folder):
    for file in sorted((folder / "keypoints" / "cam1").glob("*.json"))[::10]:
        file.write_text(file.read_text()[:40])
    solved = solve(folder)
    assert any("cam1" in note for note in solved.report.notes)
    assert error_mm(solved, folder) < 40


def test_nan_keypoints_are_missing_keypoints(folder):
    for file in sorted((folder / "keypoints" / "cam3").glob("*.json")):
        people = json.loads(file.read_text())
        for person in people["people"]:
            person["pose_keypoints_2d"][3:6] = [float("nan"), float("nan"), 0.9]
        file.write_text(json.dumps(people))
    solved = solve(folder)
    assert np.isfinite(solved.take.theta[solved.take.tracked]).all()
    assert error_mm(solved, folder) < 40


def imu_files(folder: Path) -> list[Path]:
    return sorted(folder.rglob("*left_forearm*.csv"))


def test_lost_and_disordered_sensor_packets_are_noted_and_survived(folder):
    for file in imu_files(folder):
        header, *rows = file.read_text().splitlines()
        rows = rows[:10] + rows[40:]
        rows[3], rows[4] = rows[4], rows[3]
        file.write_text("\n".join([header, *rows]) + "\n")
    solved = solve(folder)
    assert any("left_forearm" in note for note in solved.report.notes)
    assert error_mm(solved, folder) < 40


def test_a_truncated_sensor_file_is_named(folder):
    file = imu_files(folder)[0]
    file.write_text(file.read_text()[:5])
    with pytest.raises(InputError, match=file.name):
        solve(folder)


def calibration_file(folder: Path) -> Path:
    return next(path for path in folder.glob("*.toml") if path.name != "session.toml")


def scaled_translations(text: str, factor: float) -> str:
    lines = []
    for line in text.splitlines():
        if line.startswith("translation"):
            values = [float(v) * factor for v in line.split("[")[1].rstrip("]").split(",")]
            line = f"translation = [{', '.join(map(repr, values))}]"
        lines.append(line)
    return "\n".join(lines) + "\n"


def test_a_calibration_in_millimetres_is_refused_and_says_how_to_convert(folder):
    file = calibration_file(folder)
    file.write_text(scaled_translations(file.read_text(), 1000.0))
    with pytest.raises(CalibrationError, match='calibration_unit = "mm"'):
        solve(folder)
    edit(folder, ("[session]\n", '[session]\ncalibration_unit = "mm"\n'))
    assert error_mm(solve(folder), folder) < 40


def test_a_mirrored_calibration_finds_nobody_rather_than_mirrored_people(folder):
    """Translations with their sign flipped: cameras stand where they do not."""
    file = calibration_file(folder)
    file.write_text(scaled_translations(file.read_text(), -1.0))
    solved = solve(folder)
    assert not solved.take.tracked.any()
    assert solved.report.notes


def test_wearers_without_start_positions_are_pointed_out(folder):
    file = folder / "session.toml"
    lines = file.read_text().splitlines()
    file.write_text("\n".join(line for line in lines if not line.startswith("start_m")))
    session = load_session(folder)
    assert not unplaced_wearers(session), "thirteen sensors tell who wears them"
    few = tuple(s.model_copy(update={"imus": s.imus[:2]}) for s in session.subjects)
    (finding,) = unplaced_wearers(session.model_copy(update={"subjects": few}))
    assert "start_m" in finding.remedy


def test_two_subjects_with_one_name_are_refused(folder):
    edit(folder, ('name = "ben"', 'name = "anna"'))
    with pytest.raises(SessionError, match="anna"):
        solve(folder)


def test_an_unknown_key_names_the_nearest_known_one(folder):
    edit(folder, ("rate_hz = 60", "rate_hzz = 60"))
    with pytest.raises(SessionError, match="did you mean 'rate_hz'"):
        solve(folder)


def test_weights_of_the_session_reach_the_solver(folder):
    edit(
        folder,
        ("[session]\n", "[estimator]\nweights = { floor = 0, position = 5e-4 }\n[session]\n"),
    )
    solved = solve(folder)
    weights = solved.take.provenance["options"]["solver"]["weights"]
    assert weights["floor"] == 0.0
    assert weights["position"] == 5e-4


def test_the_extended_skeleton_solves_too(folder):
    edit(folder, ("[session]\n", '[session]\nskeleton = "extended23"\n'))
    solved = solve(folder)
    assert len(solved.take.bone_names) == 23
    assert solved.take.tracked.mean() > 0.9


def test_someone_very_small_is_told_of():
    [note] = _small_people({"ben": 0.62, "anna": 1.2})
    assert note.startswith("ben: 0.62 m tall") and "height_m" in note
