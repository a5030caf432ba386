"""What a calibration must not pass over in silence, and files that lie."""

import json
import tomllib
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from board_images import CHARUCO, camera, pose, seen, shots
from fusecap.calibrate.cameras import extrinsics, extrinsics_checks, people_report
from fusecap.calibrate.cameras.board import CHECKERBOARD, Board
from fusecap.calibrate.cameras.bundle_adjustment import adjust, stack_views
from fusecap.calibrate.cameras.people_report import CameraChange, HeldOutFit, PeopleCalibration
from fusecap.calibrate.cameras.report import CameraReport, ScaleCheck, verdict_of
from fusecap.calibrate.verdict import Verdict, worst
from fusecap.errors import CalibrationError, InputError
from fusecap.geometry.projection_derivatives import PARAMETERS
from fusecap.sources.detection_files import DetectionRecord, VideoMark, read_record
from fusecap.sources.imu_calibration_files import read_imu_calibration
from fusecap.sources.sync_files import read_sync
from fusecap.sources.toml_text import quoted
from session_files import ring

FINE = CameraReport(
    name="left",
    views=30,
    held_out_px=0.4,
    held_out_median_px=0.3,
    predicted_median_px=0.5,
    coverage=0.6,
    centre_spread_mm=1.0,
    rotation_spread_deg=0.01,
    pixel_scale=1.0,
)
RECORD = DetectionRecord(
    landmark_set="body25",
    detector="a network",
    video=VideoMark(
        name="a.mp4", bytes=9, sha256="0", size_px=(64, 48), rate_hz=30.0, variable_rate=False
    ),
    times_ns=np.array([0, 33_000_000]),
    complete=True,
)


def verdict(cameras=(FINE, FINE, FINE), **changes):
    fine = {
        "error_px": 0.3,
        "scale": ScaleCheck(mean=1.0, spread=0.01, edges=100),
        "size_m": 2.0,
        "instants": 40,
        "left_out": 0.0,
        "resamples": 10,
    }
    return verdict_of(cameras=cameras, **fine | changes)


@given(st.lists(st.sampled_from(list(Verdict))))
def test_worst_verdict_decides(verdicts):
    order = [word for word in ("poor", "usable", "good") if word in verdicts]
    assert worst(verdicts) == (order or ["good"])[0]


def test_rig_without_a_flaw_is_good():
    assert verdict() == ("good", ())


def test_one_camera_that_misses_is_not_hidden_by_the_others():
    bad = replace(FINE, name="right", held_out_median_px=7.0)
    word, advice = verdict((FINE, FINE, FINE, bad))
    assert word == "poor"
    assert "'right'" in advice[0] and "7.0 px" in advice[0]


def test_camera_that_was_never_held_out_is_not_good():
    word, advice = verdict((FINE, replace(FINE, name="right", held_out_median_px=np.nan)))
    assert word == "poor"
    assert "'right'" in advice[0]


@pytest.mark.parametrize(
    ("change", "word", "said"),
    [
        ({"left_out": 0.2}, "usable", "20 % of the views"),
        ({"left_out": 0.5}, "poor", "50 % of the views"),
        ({"resamples": 6}, "usable", "6 of 10"),
        ({"resamples": 2}, "poor", "2 of 10"),
    ],
)
def test_what_a_calibration_left_out_counts_against_it(change, word, said):
    found, advice = verdict(**change)
    assert found == word
    assert said in advice[0]


def test_resample_that_falls_apart_is_left_out_of_the_spread(rng, monkeypatch):
    lenses = [camera("a"), camera("b", pose=pose((0, 20, 0), (0.1, 0, 0.1)))]
    boards = {i: pose(rng.uniform(-25, 25, 3), (0, 0, 1.2)) for i in range(6)}
    found = [shots(lens, {i: seen(CHARUCO, lens, b) for i, b in boards.items()}) for lens in lenses]
    views = extrinsics.views_of(found)
    solution = extrinsics.solve(lenses, views, CHARUCO)
    monkeypatch.setattr(extrinsics, "outlying", lambda rms_px: rms_px >= 0)
    repeated = extrinsics_checks.repeatability(solution, views, CHARUCO, resamples=3)
    assert repeated.resamples == 0
    assert np.isnan(repeated.centre_mm).all()


def test_adjustment_that_starts_behind_a_camera_has_not_converged():
    lens, behind = camera("a"), pose((0, 0, 0), (0, 0, -1.0))
    view = seen(CHARUCO, lens, pose((0, 0, 0), (0, 0, 1.0)))
    corners = stack_views([(0, 0, view)], CHARUCO.corners_in_board_m)
    fixed = np.zeros((1, PARAMETERS), dtype=bool)
    assert not adjust([lens], behind[None], corners, free=fixed).converged


def test_checkerboard_too_small_for_its_finder_is_refused():
    with pytest.raises(CalibrationError, match="rows = 3, expected the number of squares, 4"):
        Board(kind=CHECKERBOARD, columns=5, rows=3, square_m=0.05)
    assert (
        Board(kind=CHECKERBOARD, columns=4, rows=4, square_m=0.05).detect(
            np.full((240, 320), 255, dtype=np.uint8)
        )
        is None
    )


@pytest.mark.parametrize(
    "change",
    [
        {"times_ns": [[0, 1], [2, 3]]},
        {"times_ns": [0, 2, 1]},
        {"times_ns": [0, 10**30]},
        {"video": {"rate_hz": float("inf")}},
        {"video": {"bytes": float("inf")}},
        {"video": {"size_px": [-1, 4]}},
    ],
)
def test_record_with_impossible_numbers_is_refused(tmp_path, change):
    data = json.loads(RECORD.json())
    video = data["video"] | change.pop("video", {})
    (tmp_path / "detection.json").write_text(json.dumps(data | change | {"video": video}))
    with pytest.raises(InputError, match="detect again"):
        read_record(tmp_path)


def test_whole_record_is_read(tmp_path):
    (tmp_path / "detection.json").write_text(RECORD.json())
    found = read_record(tmp_path)
    assert found is not None and found.same_work(RECORD)


def test_number_beyond_all_bounds_is_refused_in_words(tmp_path):
    path = tmp_path / "file.toml"
    huge = "9" * 400
    path.write_text(f'format = "fusecap sync 1"\n[camera.left]\noffset_s = {huge}\n')
    with pytest.raises(InputError, match="expected a number"):
        read_sync(path)
    path.write_text(
        'format = "fusecap imu calibration 1"\n[[imu]]\nsubject = "a"\nbone = "hips"\n'
        f"bone_from_imu_wxyz = [1.0, 0.0, 0.0, 0.0]\nheading_deg = {huge}\n"
    )
    with pytest.raises(InputError, match="expected a number"):
        read_imu_calibration(path)


def change_of(name, **changes):
    fine = {
        "before": HeldOutFit(median_px=12.0, p90_px=20.0, keypoints=500),
        "after": HeldOutFit(median_px=4.0, p90_px=9.0, keypoints=500),
        "skeleton_before_px": 12.0,
        "skeleton_after_px": 6.0,
        "moved_mm": 20.0,
        "turned_deg": 0.4,
        "focal_share": 1.0,
        "sigma_mm": 3.0,
        "sigma_deg": 0.05,
        "repeat_mm": 5.0,
        "repeat_deg": 0.1,
        "covered": 0.6,
    }
    return CameraChange(name=name, **fine | changes)


def notes_of(*changes):
    rig = ring(len(changes))
    result = PeopleCalibration(
        rig=rig,
        improved=True,
        cameras=changes,
        before=changes[0].before,
        after=changes[0].after,
        skeleton_before_px=12.0,
        skeleton_after_px=6.0,
        refined=(),
        rounds=2,
        fit_person_instants=50,
        check_person_instants=20,
        blocks=(9, 3),
        block_s=2.0,
        scale=1.0,
        scale_from="the rough calibration",
        walked_m=(3.0, 3.0),
        feet_m=0.0,
        notes=(),
        residuals_px={},
    )
    return people_report.notes_on(result, rig, np.ones((50, len(changes)), dtype=bool))


def test_calibration_from_people_without_a_flaw_has_no_notes():
    assert notes_of(change_of("left"), change_of("right")) == ()


def test_camera_whose_repeatability_is_unknown_is_noted():
    [note] = notes_of(change_of("left"), change_of("right", repeat_mm=np.nan, repeat_deg=np.nan))
    assert note.startswith("'right'") and "not known better" in note


def test_camera_that_no_keypoint_checks_is_noted():
    nothing = HeldOutFit(median_px=np.nan, p90_px=np.nan, keypoints=0)
    [note] = notes_of(change_of("left"), change_of("right", before=nothing, after=nothing))
    assert note.startswith("'right'") and "no held-out keypoint" in note


def test_camera_that_pays_for_the_others_is_noted():
    worse = HeldOutFit(median_px=4.0, p90_px=9.0, keypoints=500)
    before = HeldOutFit(median_px=3.0, p90_px=9.0, keypoints=500)
    [note] = notes_of(change_of("left"), change_of("right", before=before, after=worse))
    assert note.startswith("'right' (3.0 -> 4.0 px)")


@given(st.text(st.characters(exclude_categories=["Cs"])))
def test_quoted_text_comes_back_from_toml(text):
    assert tomllib.loads(f"text = {quoted(text)}")["text"] == text
