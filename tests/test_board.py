import shutil
from dataclasses import replace

import cv2
import numpy as np
import pytest

from board_images import CHARUCO, CHECKERBOARD, camera, pose, projected, rendered
from fusecap.calibrate.cameras.board import (
    Board,
    larger_than_stated,
    read_board,
    why_not_found,
)
from fusecap.calibrate.cameras.board_views import in_step, read_shots, read_timestamps
from fusecap.errors import CalibrationError

LENS = camera()
GOOD = """
kind = "charuco"
columns = 4
rows = 5
square_m = 0.054
marker_m = 0.0405
dictionary = "DICT_4X4_1000"
inverted = true
"""


def away_px(board, cam_from_board, **render):
    view = board.detect(rendered(board, LENS, cam_from_board, **render))
    assert view is not None
    return np.linalg.norm(
        view.pixels - projected(board, LENS, cam_from_board)[view.corner_ids], axis=1
    )


@pytest.mark.parametrize("inverted", [False, True])
@pytest.mark.parametrize("legacy", [False, True])
def test_charuco_corners_are_found_to_a_fraction_of_a_pixel(inverted, legacy):
    board = replace(CHARUCO, inverted=inverted, legacy=legacy)
    away = away_px(board, pose((25, -20, 12)), noise=2.0)
    assert len(away) == 20
    assert np.sqrt((away**2).mean()) < 0.12


def test_a_legacy_pattern_is_found_unasked():
    drawn = replace(CHARUCO, legacy=True)
    picture = rendered(drawn, LENS, pose((10, 25, 5)))
    assert CHARUCO.detect(picture) is None
    view = replace(CHARUCO, legacy=None).detect(picture)
    assert view is not None
    miss = view.pixels - projected(drawn, LENS, pose((10, 25, 5)))[view.corner_ids]
    assert np.abs(miss).max() < 0.3


@pytest.mark.parametrize("roll", [0, 90, 180, 250])
@pytest.mark.parametrize(("columns", "rows"), [(7, 6), (6, 7), (5, 8)])
def test_a_checkerboard_starts_at_the_same_corner_however_it_is_turned(columns, rows, roll):
    board = replace(CHECKERBOARD, columns=columns, rows=rows)
    away = away_px(board, pose((15, 20, roll), board=board), noise=2.0)
    assert np.sqrt((away**2).mean()) < 0.15


@pytest.mark.slow
def test_a_large_image_of_a_checkerboard_is_searched_small_and_located_exactly():
    lens = camera(focal=1800.0, size=(1920, 1440))
    there = pose((20, -25, 8), board=CHECKERBOARD)
    view = CHECKERBOARD.detect(rendered(CHECKERBOARD, lens, there))
    assert view is not None
    miss = np.linalg.norm(view.pixels - projected(CHECKERBOARD, lens, there), axis=1)
    assert np.sqrt((miss**2).mean()) < 0.15


@pytest.mark.parametrize(
    ("columns", "rows", "ambiguous"), [(7, 6, False), (7, 7, True), (6, 4, True)]
)
def test_half_a_turn_shows_on_boards_of_odd_and_even(columns, rows, ambiguous):
    assert replace(CHECKERBOARD, columns=columns, rows=rows).ambiguous == ambiguous
    assert not replace(CHARUCO, columns=columns, rows=rows).ambiguous


def test_a_colour_image_is_as_good_as_a_grey_one():
    grey = rendered(CHARUCO, LENS, pose())
    view, same = CHARUCO.detect(grey), CHARUCO.detect(cv2.cvtColor(grey, cv2.COLOR_GRAY2BGR))
    assert view is not None and same is not None
    np.testing.assert_allclose(view.pixels, same.pixels, atol=1e-3)


@pytest.mark.slow
def test_no_board_is_none(rng):
    noise = rng.integers(0, 255, (240, 320)).astype(np.uint8)
    assert CHARUCO.detect(noise) is None
    assert CHECKERBOARD.detect(noise) is None
    assert why_not_found(CHARUCO, [noise]) == ""


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"dictionary": "DICT_5X5_100"}, "DICT_4X4"),
        ({"inverted": True}, "correct the board file"),
        ({"columns": 6, "rows": 5}, "5 columns and 6 rows|5 x 6 squares"),
        ({"columns": 8, "rows": 9}, "5 columns and 6 rows"),
    ],
)
@pytest.mark.slow
def test_a_wrong_board_file_is_told_from_what_is_there(change, words):
    picture = rendered(CHARUCO, LENS, pose((10, 10, 0)))
    wrong = replace(CHARUCO, **change)
    assert wrong.detect(picture) is None
    with pytest.raises(AssertionError, match=words):
        raise AssertionError(why_not_found(wrong, [picture]))


def test_inner_corners_given_as_squares_are_noticed():
    there = pose((10, 10, 0), board=CHECKERBOARD)
    picture = rendered(CHECKERBOARD, LENS, there)
    assert larger_than_stated(CHECKERBOARD, picture) == ""
    counted_wrong = replace(CHECKERBOARD, columns=6, rows=5)
    assert "inner corners" in larger_than_stated(counted_wrong, picture)


def test_a_board_file_is_read(tmp_path):
    path = tmp_path / "board.toml"
    path.write_text(GOOD)
    board = read_board(path)
    assert board == Board(
        kind="charuco",
        columns=4,
        rows=5,
        square_m=0.054,
        marker_m=0.0405,
        dictionary="DICT_4X4_1000",
        inverted=True,
    )
    np.testing.assert_allclose(
        board.corners_in_board_m[[0, 2, 3]][:, :2], [[0.054, 0.054], [0.162, 0.054], [0.054, 0.108]]
    )


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("0.054", "54", "in millimetres, write 0.054"),
        ("0.054", "5.4", "in millimetres, write 0.0054"),
        ("0.054", "-1", "measure the print"),
        ("square_m", "square_mm", "did you mean 'square_m'"),
        ("columns = 4", "", "columns is missing"),
        ("columns = 4", "columns = 2", "number of squares"),
        ("columns = 4", "columns = 4.5", "a whole number"),
        ("columns = 4", "columns = 90", "has 1000|1000"),
        ("0.0405", "0.06", "not smaller than square_m"),
        ("DICT_4X4_1000", "DICT_4X4_1001", "did you mean"),
        ("charuco", "charucco", "did you mean 'charuco'"),
        ("charuco", "checkerboard", "no marker_m"),
        ('dictionary = "DICT_4X4_1000"', "", "needs dictionary"),
        ("inverted = true", "inverted = 1", "true or false"),
        ("kind =", "kind", "not valid TOML"),
    ],
)
def test_a_wrong_board_file_says_what_to_change(tmp_path, old, new, words):
    path = tmp_path / "board.toml"
    path.write_text(
        GOOD.replace(old, new).replace("rows = 5", "rows = 90" if "90" in new else "rows = 5")
    )
    with pytest.raises(CalibrationError, match=words) as error:
        read_board(path)
    assert str(path) in str(error.value)


@pytest.fixture
def folder(tmp_path):
    for number, turn in enumerate([(20, 0, 0), (0, 25, 0), (-20, 10, 30)]):
        picture = rendered(CHARUCO, LENS, pose(turn))
        cv2.imwrite(str(tmp_path / f"cam_1_{10 * number:03d}.png"), picture)
    return tmp_path


def test_images_are_told_apart_by_the_last_number_of_their_names(folder):
    found = read_shots("left", folder, CHARUCO)
    assert [shot.instant for shot in found.shots] == [0, 10, 20]
    assert found.size_px == (640, 480) and found.inspected == 3
    assert len(read_shots("left", f"{folder}/cam_1_0[12]*.png", CHARUCO).shots) == 2


def test_one_image_per_camera_is_one_instant(folder):
    shutil.copy(folder / "cam_1_010.png", folder / "other_3.png")
    pair = [
        read_shots(n, folder / f, CHARUCO)
        for n, f in (("a", "cam_1_000.png"), ("b", "other_3.png"))
    ]
    assert {shot.instant for camera in in_step(pair) for shot in camera.shots} == {0}


def test_images_of_two_sizes_are_refused(folder):
    cv2.imwrite(str(folder / "cam_1_099.png"), np.zeros((100, 120), np.uint8))
    with pytest.raises(CalibrationError, match=r"640 x 480 .* and 120 x 100 px .*099"):
        read_shots("left", folder, CHARUCO)


def test_an_unreadable_image_is_named(folder):
    (folder / "cam_1_050.png").write_bytes(b"no picture")
    with pytest.raises(CalibrationError, match=r"050.png: not a readable image"):
        read_shots("left", folder, CHARUCO)


def test_a_source_that_is_not_there_is_named(tmp_path):
    with pytest.raises(CalibrationError, match="no such video"):
        read_shots("left", tmp_path / "nothing_*.png", CHARUCO)
    with pytest.raises(CalibrationError, match="holds no images"):
        read_shots("left", tmp_path, CHARUCO)


def test_no_board_in_any_image_says_what_the_board_file_says(tmp_path):
    for n in range(2):
        cv2.imwrite(str(tmp_path / f"{n}.png"), np.full((120, 160), 90, np.uint8))
    with pytest.raises(CalibrationError, match=r"none of 2 images.*charuco of 5 x 6 squares"):
        read_shots("left", tmp_path, CHARUCO)


def test_timestamps_give_each_frame_its_instant(tmp_path):
    path = tmp_path / "timestamps.csv"
    path.write_text("sync_index,cam_id,frame_time\n3,0,1.0\n3,1,1.01\n4,1,1.2\n5,0,1.4\n")
    assert read_timestamps(path) == {"0": [3, 5], "1": [3, 4]}
    path.write_text("sync_index,frame_time\n3,1.0\n")
    with pytest.raises(CalibrationError, match="line 2: expected the columns"):
        read_timestamps(path)
