import re
import struct
import tomllib

import cv2
import numpy as np
import pytest

from fusecap.calibrate.cameras.board import Board, read_board
from fusecap.calibrate.cameras.board_drawing import (
    PAGES_MM,
    board_toml,
    draw_pdf,
    draw_png,
    page_for,
)
from fusecap.cli import main
from fusecap.errors import CalibrationError


def charuco(columns=7, rows=5, square_m=0.034, **more) -> Board:
    options = {"marker_m": 0.75 * square_m, "dictionary": "DICT_5X5_50", **more}
    return Board(kind="charuco", columns=columns, rows=rows, square_m=square_m, **options)


def checkerboard(columns=9, rows=6, square_m=0.025, **more) -> Board:
    return Board(kind="checkerboard", columns=columns, rows=rows, square_m=square_m, **more)


def decoded(png: bytes) -> np.ndarray:
    return cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_GRAYSCALE)


BOARDS = [
    charuco(),
    charuco(6, 4),
    charuco(6, 4, legacy=True),
    charuco(7, 5, inverted=True),
    charuco(6, 4, inverted=True, legacy=True),
    charuco(4, 5, 0.035, dictionary="DICT_4X4_1000"),
    charuco(5, 3, dictionary="DICT_7X7_50"),
    checkerboard(),
    checkerboard(8, 5, inverted=True),
]


@pytest.mark.parametrize("board", BOARDS, ids=lambda board: f"{board.words} {board.legacy}")
def test_every_corner_is_found_where_it_was_drawn(board):
    page = page_for(board)
    dpi = 150.0
    view = board.detect(decoded(draw_png(board, page, dpi=dpi)))
    assert view is not None
    assert len(view) == len(board.corners_in_board_m)
    places_mm = 1e3 * board.corners_in_board_m[view.corner_ids, :2] + [page.left_mm, page.top_mm]
    expected = places_mm * dpi / 25.4 - 0.5
    if board.ambiguous and np.linalg.norm(view.pixels[0] - expected[0]) > 100:
        expected = expected[::-1]
    assert np.abs(view.pixels - expected).max() < 0.8


@pytest.mark.parametrize("legacy", [False, True])
@pytest.mark.parametrize(("columns", "rows"), [(7, 5), (6, 4), (5, 4), (4, 5)])
def test_pattern_is_that_of_opencv(columns, rows, legacy):
    board = charuco(columns, rows, 0.035, marker_m=0.0245, legacy=legacy)
    theirs = cv2.aruco.CharucoBoard(
        (columns, rows), 35, 24.5, cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_5X5_50)
    )
    theirs.setLegacyPattern(legacy)
    expected = theirs.generateImage((70 * columns, 70 * rows), marginSize=0)
    page = page_for(board)
    image = decoded(draw_png(board, page, dpi=2 * 25.4))
    top, left = round(2 * page.top_mm), round(2 * page.left_mm)
    drawn = image[top : top + 70 * rows, left : left + 70 * columns]
    assert np.mean((drawn > 127) != (expected > 127)) < 0.02


def test_png_states_its_resolution_and_size():
    board = charuco()
    png = draw_png(board, page_for(board), dpi=300.0)
    assert png.count(b"pHYs") == 1
    place = png.index(b"pHYs") + 4
    assert struct.unpack(">IIB", png[place : place + 9]) == (11811, 11811, 1)
    assert decoded(png).shape == (2480, 3508)


def boxes_mm(pdf: bytes) -> np.ndarray:
    """x, y, width, height of the rectangles."""
    found = re.findall(rb"([\d.]+) ([\d.]+) ([\d.]+) ([\d.]+) re f", pdf)
    return np.array(found, dtype=float) * 25.4 / 72


def test_pdf_is_exact_to_a_micrometre():
    board = checkerboard()
    page = page_for(board, "a4")
    pdf = draw_pdf(board, page)
    [size] = re.findall(rb"/MediaBox \[0 0 ([\d.]+) ([\d.]+)\]", pdf)
    assert np.allclose(np.array(size, dtype=float) * 25.4 / 72, (297.0, 210.0), atol=1e-3)
    boxes = boxes_mm(pdf)
    squares = boxes[np.isclose(boxes[:, 3], 25.0, atol=1e-3)]
    assert len(squares) == 27
    assert np.allclose(squares[:, 2], 25.0, atol=1e-3)
    ruler = boxes[np.isclose(boxes[:, 3], 0.25, atol=1e-3)]
    assert ruler[0, 2] == pytest.approx(100.0, abs=1e-3)
    ticks = boxes[np.isclose(boxes[:, 2], 0.25, atol=1e-3)]
    assert ticks[:, 0].max() + 0.25 - ticks[:, 0].min() == pytest.approx(100.0, abs=1e-3)


def test_cross_references_of_the_pdf_point_at_its_objects():
    pdf = draw_pdf(charuco(), page_for(charuco()))
    places = [int(place) for place in re.findall(rb"(\d{10}) 00000 n", pdf)]
    assert [pdf[p : p + 7] for p in places] == [b"%d 0 obj" % n for n in range(1, 6)]
    start = int(re.search(rb"startxref\n(\d+)", pdf)[1])
    assert pdf[start : start + 4] == b"xref"
    length = int(re.search(rb"/Length (\d+)", pdf)[1])
    begin = pdf.index(b"stream\n") + 7
    assert pdf[begin + length : begin + length + 10] == b"\nendstream"


@pytest.mark.parametrize("name", PAGES_MM)
def test_nothing_leaves_the_page(name):
    board = charuco(5, 3, 0.03)
    page = page_for(board, name)
    boxes = boxes_mm(draw_pdf(board, page))
    assert (boxes[:, :2] >= 7.9).all()
    assert (boxes[:, 0] + boxes[:, 2] <= page.width_mm - 7.9).all()
    assert (boxes[:, 1] + boxes[:, 3] <= page.height_mm - 7.9).all()


def test_board_that_does_not_fit_names_the_page_that_does():
    with pytest.raises(
        CalibrationError, match=r"does not fit on a4; it fits on a3.* 34 mm fit on a4"
    ):
        page_for(charuco(square_m=0.04), "a4")
    with pytest.raises(CalibrationError, match="does not fit on any page"):
        page_for(charuco(square_m=0.4))


@pytest.mark.parametrize("board", BOARDS, ids=lambda board: f"{board.words} {board.legacy}")
def test_board_file_reads_back(tmp_path, board):
    (tmp_path / "board.toml").write_text(board_toml(board, "board.pdf"))
    read = read_board(tmp_path / "board.toml")
    for key in ("kind", "columns", "rows", "dictionary", "inverted"):
        assert getattr(read, key) == getattr(board, key)
    for key in ("square_m", "marker_m"):
        assert getattr(read, key) == pytest.approx(getattr(board, key))
    assert bool(read.legacy) == bool(board.legacy)


def run(monkeypatch, *arguments) -> int:
    monkeypatch.setattr("sys.argv", ["fusecap", "calibrate", "board", *map(str, arguments)])
    try:
        main()
    except SystemExit as end:
        return int(end.code or 0)
    return 0


def test_command_writes_drawing_and_board_file(tmp_path, monkeypatch, capsys):
    out = tmp_path / "wall.pdf"
    assert run(monkeypatch, "--square", "34mm", "--out", out) == 0
    assert "297 x 210 mm" in capsys.readouterr().out
    assert out.read_bytes().startswith(b"%PDF")
    assert tomllib.loads((tmp_path / "wall.toml").read_text())["square_m"] == 0.034


@pytest.mark.parametrize(
    ("arguments", "code", "expected"),
    [
        (("--square", "34"), 2, "with its unit"),
        (("--page", "a5"), 2, "a5"),
        (("--kind", "dots"), 2, "dots"),
        (("--square", "34mm", "--marker", "40mm"), 1, "not smaller than"),
        (("--dictionary", "DICT_4X4"), 1, "did you mean"),
        (("--page", "a4", "--square", "5cm"), 1, "does not fit on a4"),
    ],
)
def test_command_refuses_what_cannot_be_printed(
    tmp_path, monkeypatch, capsys, arguments, code, expected
):
    assert run(monkeypatch, *arguments, "--out", tmp_path / "board.pdf") == code
    assert expected in capsys.readouterr().err
    assert not list(tmp_path.iterdir())
