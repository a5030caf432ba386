"""The calibration board to print: exact millimetres on a page, or pixels at a stated resolution.

A board is a list of black rectangles: the squares, and within the other squares the black cells of
their markers. The same list becomes a PDF, whose units are points of 1/72 inch and therefore exact,
or a PNG. Below the board stand its parameters and a ruler of 100 mm: printers scale pages to fit,
and where a board that came out 3 % small is believed, everybody is 3 % too tall.
"""

from __future__ import annotations

import io
import struct
import zlib
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import UInt8

from fusecap.calibrate.cameras.board import CHARUCO, Board
from fusecap.errors import CalibrationError

PAGES_MM = {
    "a4": (210.0, 297.0),
    "a3": (297.0, 420.0),
    "a2": (420.0, 594.0),
    "a1": (594.0, 841.0),
    "a0": (841.0, 1189.0),
    "letter": (215.9, 279.4),
    "tabloid": (279.4, 431.8),
}
"""Width and height, upright."""
MARGIN_MM = 8.0
"""That printers leave blank."""
RULER_MM = 100.0
_FOOT_MM = 20.0
"""Below the board: the ruler and the text."""
_POINTS_PER_MM = 72.0 / 25.4
_TEXT_MM = 3.2


@dataclass(frozen=True, kw_only=True)
class BoardPage:
    """A board on a page, all in millimetres from the page's top left corner, y down."""

    name: str
    width_mm: float
    height_mm: float
    left_mm: float
    """Of the board."""
    top_mm: float


def page_for(board: Board, name: str | None = None) -> BoardPage:
    """The page of this name, or the first of `PAGES_MM` that holds the board, upright or lying.

    Raises `CalibrationError` naming a page that fits.
    """
    fitting = {key: page for key in PAGES_MM if (page := _fit(board, key)) is not None}
    if name is None:
        if fitting:
            return next(iter(fitting.values()))
    elif name in fitting:
        return fitting[name]
    width, height = 1e3 * board.columns * board.square_m, 1e3 * board.rows * board.square_m
    listed = ", ".join(fitting)
    largest = _largest_square_mm(board, name or "a0")
    raise CalibrationError(
        f"the board is {width:g} x {height:g} mm, which with ruler and margins does not fit on "
        f"{name or 'any page'}; "
        + (f"it fits on {listed}; or " if listed else "")
        + f"squares of {largest} mm fit on {name or 'a0'}"
    )


def draw_pdf(board: Board, page: BoardPage) -> bytes:
    """One page in exact millimetres: vector graphics, nothing for a viewer to resample."""
    scale = _POINTS_PER_MM

    def box(x: float, y: float, width: float, height: float) -> str:
        corner = (x * scale, (page.height_mm - y - height) * scale)
        return f"{corner[0]:.4f} {corner[1]:.4f} {width * scale:.4f} {height * scale:.4f} re"

    content = ["0 g"]
    content += [f"{box(*each)} f" for each in _black_mm(board, page)]
    content += [f"{box(*each)} f" for each in _ruler_mm(page)]
    for text, x, y in _texts(board, page):
        escaped = text.replace("\\", r"\\").replace("(", r"\(").replace(")", r"\)")
        place = f"{x * scale:.3f} {(page.height_mm - y) * scale:.3f}"
        content.append(f"BT /F1 {_TEXT_MM * scale:.2f} Tf {place} Td ({escaped}) Tj ET")
    size = f"{page.width_mm * scale:.4f} {page.height_mm * scale:.4f}"
    return _pdf("\n".join(content), size)


def draw_png(board: Board, page: BoardPage, *, dpi: float = 300.0) -> bytes:
    """The page at a stated resolution, which stands in the file (pHYs) for printing programs.

    Edges fall on whole pixels: a square is wrong by at most half a pixel, 0.04 mm at 300 dpi.
    """
    per_mm = dpi / 25.4
    image = np.full((round(page.height_mm * per_mm), round(page.width_mm * per_mm)), 255, np.uint8)
    for x, y, width, height in (*_black_mm(board, page), *_ruler_mm(page)):
        rows = slice(round(y * per_mm), round((y + height) * per_mm))
        columns = slice(round(x * per_mm), max(round((x + width) * per_mm), round(x * per_mm) + 1))
        image[rows, columns] = 0
    for text, x, y in _texts(board, page):
        height = _TEXT_MM * per_mm
        cv2.putText(
            image,
            text,
            (round(x * per_mm), round(y * per_mm)),
            cv2.FONT_HERSHEY_SIMPLEX,
            0.75 * height / 22.0,
            0,
            max(1, round(height / 14)),
            cv2.LINE_AA,
        )
    return _with_resolution(image, dpi)


def board_toml(board: Board, printed: str) -> str:
    """The text of the board's file; `printed` names the drawing."""
    lines = [
        f"# The board of {printed}. Measure the print: where its ruler is not {RULER_MM:g} mm",
        f"# long, multiply square_m and marker_m by its length over {RULER_MM:g} mm.",
        f'kind = "{board.kind}"',
        f"columns = {board.columns}",
        f"rows = {board.rows}",
        f"square_m = {board.square_m:.9g}",
    ]
    if board.kind == CHARUCO:
        lines += [f"marker_m = {board.marker_m:.9g}", f'dictionary = "{board.dictionary}"']
        lines += [f"legacy = {str(bool(board.legacy)).lower()}"]
    lines += [f"inverted = {str(board.inverted).lower()}"]
    return "\n".join(lines) + "\n"


def _fit(board: Board, name: str) -> BoardPage | None:
    width, height = 1e3 * board.columns * board.square_m, 1e3 * board.rows * board.square_m
    for across, down in (PAGES_MM[name], PAGES_MM[name][::-1]):
        free = down - 2 * MARGIN_MM - height - _FOOT_MM
        if across - 2 * MARGIN_MM >= max(width, RULER_MM) and free >= 0:
            return BoardPage(
                name=name,
                width_mm=across,
                height_mm=down,
                left_mm=(across - width) / 2,
                top_mm=MARGIN_MM + free / 2,
            )
    return None


def _largest_square_mm(board: Board, name: str) -> int:
    sizes = [
        min(
            (across - 2 * MARGIN_MM) / board.columns,
            (down - 2 * MARGIN_MM - _FOOT_MM) / board.rows,
        )
        for across, down in (PAGES_MM[name], PAGES_MM[name][::-1])
    ]
    return int(max(sizes))


def _black_mm(board: Board, page: BoardPage) -> list[tuple[float, float, float, float]]:
    """x, y, width, height of everything black on the board."""
    square = 1e3 * board.square_m
    dark = _dark_cells(board)
    cells = dark.shape[0] // board.rows
    if cells == 1:
        edges = np.array([0.0, square])
    else:
        marker = 1e3 * (board.marker_m or 0.0)
        inner = (square - marker) / 2 + marker * np.arange(cells - 1) / (cells - 2)
        edges = np.concatenate([[0.0], inner, [square]])
    boxes = []
    for row, line in enumerate(dark):
        y0 = square * (row // cells) + edges[row % cells]
        y1 = square * (row // cells) + edges[row % cells + 1]
        for first, last in _runs(line):
            x0 = square * (first // cells) + edges[first % cells]
            x1 = square * (last // cells) + edges[last % cells + 1]
            boxes.append((page.left_mm + x0, page.top_mm + y0, x1 - x0, y1 - y0))
    return boxes


def _dark_cells(board: Board) -> np.ndarray:
    """(rows * c, columns * c) of bool: each square cut into c x c cells of unequal width.

    The outer ring of a square's cells is what a marker leaves free, the inner ones are its bits.
    """
    first_is_dark = not (board.legacy and board.kind == CHARUCO and board.rows % 2 == 0)
    squares = (np.add.outer(np.arange(board.rows), np.arange(board.columns)) % 2 == 0) == (
        first_is_dark
    )
    if board.kind != CHARUCO:
        return squares != board.inverted
    words = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, str(board.dictionary)))
    bits = words.markerSize + 2
    cells = bits + 2
    dark = np.kron(squares, np.ones((cells, cells), dtype=bool))
    for number, (row, column) in enumerate(np.argwhere(~squares)):
        marker = cv2.aruco.generateImageMarker(words, number, bits, borderBits=1) == 0
        top, left = row * cells + 1, column * cells + 1
        dark[top : top + bits, left : left + bits] = marker
    return dark != board.inverted


def _runs(line: np.ndarray) -> list[tuple[int, int]]:
    """First and last index of each run of true, so that neighbours print without a seam."""
    padded = np.concatenate([[False], line, [False]]).astype(np.int8)
    steps = np.diff(padded)
    return [
        (int(a), int(b) - 1)
        for a, b in zip(np.flatnonzero(steps > 0), np.flatnonzero(steps < 0), strict=True)
    ]


def _ruler_mm(page: BoardPage) -> list[tuple[float, float, float, float]]:
    """A line with a tick every 10 mm, 100 mm from the first one's outer edge to the last one's."""
    left, y = (page.width_mm - RULER_MM) / 2, page.height_mm - MARGIN_MM - 6.0
    thin = 0.25
    boxes = [(left, y, RULER_MM, thin)]
    for tick in range(11):
        x = left + tick * (RULER_MM - thin) / 10
        height = 4.0 if tick % 5 == 0 else 2.5
        boxes.append((x, y - height, thin, height))
    return boxes


def _texts(board: Board, page: BoardPage) -> Sequence[tuple[str, float, float]]:
    """Text, x and y of its baseline."""
    marker = f", marker {1e3 * board.marker_m:g} mm" if board.marker_m else ""
    legacy = ", legacy pattern" if board.legacy and board.kind == CHARUCO else ""
    words = f"{board.words}{legacy}: square {1e3 * board.square_m:g} mm{marker}"
    below = page.height_mm - MARGIN_MM
    check = f"{RULER_MM:g} mm from edge to edge: print at 100 %, measure, and glue flat"
    return (
        (words, max(MARGIN_MM, (page.width_mm - 1.75 * len(words)) / 2), below - 13.0),
        (check, (page.width_mm - RULER_MM) / 2, below - 1.0),
    )


def _pdf(content: str, media_box: str) -> bytes:
    """A document of one page (ISO 32000-1, 7.5), its text in the standard font Helvetica."""
    stream = content.encode("latin-1", "replace")
    objects = [
        b"<< /Type /Catalog /Pages 2 0 R >>",
        b"<< /Type /Pages /Kids [3 0 R] /Count 1 >>",
        (
            f"<< /Type /Page /Parent 2 0 R /MediaBox [0 0 {media_box}] /Contents 4 0 R "
            "/Resources << /Font << /F1 5 0 R >> >> >>"
        ).encode(),
        b"<< /Length %d >>\nstream\n%s\nendstream" % (len(stream), stream),
        b"<< /Type /Font /Subtype /Type1 /BaseFont /Helvetica >>",
    ]
    file = io.BytesIO()
    file.write(b"%PDF-1.4\n")
    places = []
    for number, body in enumerate(objects, start=1):
        places.append(file.tell())
        file.write(b"%d 0 obj\n%s\nendobj\n" % (number, body))
    start = file.tell()
    file.write(b"xref\n0 %d\n0000000000 65535 f \n" % (len(objects) + 1))
    file.writelines(b"%010d 00000 n \n" % place for place in places)
    file.write(b"trailer\n<< /Size %d /Root 1 0 R >>\n" % (len(objects) + 1))
    file.write(b"startxref\n%d\n%%%%EOF\n" % start)
    return file.getvalue()


def _with_resolution(image: UInt8[np.ndarray, "h w"], dpi: float) -> bytes:
    """PNG with its pHYs chunk [pixels per metre], right after the header."""
    _, encoded = cv2.imencode(".png", image)
    png = encoded.tobytes()
    per_metre = round(dpi / 0.0254)
    body = b"pHYs" + struct.pack(">IIB", per_metre, per_metre, 1)
    chunk = struct.pack(">I", len(body) - 4) + body + struct.pack(">I", zlib.crc32(body))
    after_header = 8 + 25
    rest = png[after_header:]
    return png[:after_header] + chunk + _without_chunk(rest, b"pHYs")


def _without_chunk(chunks: bytes, kind: bytes) -> bytes:
    kept, place = [], 0
    while place < len(chunks):
        size = struct.unpack(">I", chunks[place : place + 4])[0] + 12
        if chunks[place + 4 : place + 8] != kind:
            kept.append(chunks[place : place + size])
        place += size
    return b"".join(kept)
