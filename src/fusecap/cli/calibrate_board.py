"""`fusecap calibrate board`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from fusecap.cli.common import Json, check_choice, length_m, print_json
from fusecap.cli.terminal import console

EXAMPLE = "Example: fusecap calibrate board --columns 7 --rows 5 --square 34mm --out board.pdf"


def board(
    out: Annotated[
        Path,
        typer.Option(help="The drawing to write, .pdf or .png; its .toml goes beside it."),
    ] = Path("board.pdf"),
    kind: Annotated[str, typer.Option(help="charuco, or checkerboard.")] = "charuco",
    columns: Annotated[int, typer.Option(help="Squares in a row.")] = 7,
    rows: Annotated[int, typer.Option(help="Rows of squares.")] = 5,
    square: Annotated[str, typer.Option(help="Edge of a square, with its unit.")] = "34mm",
    marker: Annotated[
        str | None,
        typer.Option(help="Edge of a marker, with its unit; default 3/4 of a square's."),
    ] = None,
    dictionary: Annotated[str, typer.Option(help="OpenCV's name of the markers.")] = "DICT_5X5_50",
    inverted: Annotated[bool, typer.Option("--inverted", help="Swap black and white.")] = False,
    legacy: Annotated[
        bool, typer.Option("--legacy", help="Charuco pattern of OpenCV before 4.6.")
    ] = False,
    page: Annotated[
        str | None,
        typer.Option(
            help="a4, a3, a2, a1, a0, letter or tabloid; default the first of these that fits."
        ),
    ] = None,
    dpi: Annotated[float, typer.Option(min=72, max=1200, help="Of a PNG.")] = 300.0,
    as_json: Json = False,
) -> None:
    """Draw a calibration board in exact millimetres to print, and write its board file."""
    from fusecap.calibrate.cameras import board_drawing
    from fusecap.calibrate.cameras.board import CHARUCO, KINDS, Board
    from fusecap.files import write_whole

    check_choice("--kind", kind, KINDS)
    check_choice("the suffix of --out", out.suffix, (".pdf", ".png"))
    if page is not None:
        check_choice("--page", page, tuple(board_drawing.PAGES_MM))
    square_m = length_m("--square", square)
    marker_m = length_m("--marker", marker) if marker else 0.75 * square_m
    with_markers = kind == CHARUCO
    target = Board(
        kind=kind,
        columns=columns,
        rows=rows,
        square_m=square_m,
        marker_m=marker_m if with_markers else None,
        dictionary=dictionary if with_markers else None,
        inverted=inverted,
        legacy=legacy if with_markers else None,
    )
    sheet = board_drawing.page_for(target, page)
    drawing = (
        board_drawing.draw_pdf(target, sheet)
        if out.suffix == ".pdf"
        else board_drawing.draw_png(target, sheet, dpi=dpi)
    )
    toml = out.with_suffix(".toml")
    write_whole(out, drawing)
    write_whole(toml, board_drawing.board_toml(target, out.name))
    page_mm = (sheet.width_mm, sheet.height_mm)
    if as_json:
        report = {
            "board": target.words,
            "corners": len(target.corners_in_board_m),
            "page": sheet.name,
            "page_mm": page_mm,
            "files": [str(out), str(toml)],
        }
        print_json(report)
        return
    console.print(
        f"{target.words}: square {1e3 * square_m:g} mm, {len(target.corners_in_board_m)} corners, "
        f"on {sheet.name} ({page_mm[0]:g} x {page_mm[1]:g} mm)",
        soft_wrap=True,
    )
    if target.ambiguous:
        console.print(
            "note: it looks the same after half a turn; make columns + rows odd to tell its ends",
            soft_wrap=True,
        )
    console.print(f"wrote {out}\nwrote {toml}", soft_wrap=True)
    console.print(
        f"print at 100 %, check that the ruler is {board_drawing.RULER_MM:g} mm long, glue it flat",
        soft_wrap=True,
    )
