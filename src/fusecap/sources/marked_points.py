"""Points that someone marked in the images of several cameras, as CSV.

    name,x_m,y_m,z_m,left_u_px,left_v_px,right_u_px,right_v_px
    corner,0.0,0.0,0.0,812.5,640.0,301.0,655.5
    table,1.20,0.74,0.40,1100.0,420.5,,

One row per point, two columns per camera that see any; empty where the camera does not see the
point. `x_m, y_m, z_m` are the place in the world that is wanted (y up, floor y = 0); a file of
points that merely lie on the floor leaves them out. Pixel (0, 0) is the centre of the top-left one.
"""

from __future__ import annotations

import csv
import io
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from fusecap.errors import InputError, nearest
from fusecap.inputs import POINTS, read_text

_WORLD = ("x_m", "y_m", "z_m")


@dataclass(frozen=True, kw_only=True)
class MarkedPoints:
    """K named points in the images of C cameras."""

    names: tuple[str, ...]
    keypoints: Float[np.ndarray, "c k 3"]
    """x [px], y [px], 1; NaN, NaN, 0 where not marked. In the order of the cameras asked for."""
    in_world_m: Float[np.ndarray, "k 3"] | None
    """Where they are wanted; None in a file without these columns."""


def read_marked_points(path: Path | str, cameras: tuple[str, ...]) -> MarkedPoints:
    """The points of a file, for cameras of these names; raises `InputError` with the line."""
    path = Path(path)
    lines = io.StringIO(read_text(path, POINTS), newline="")
    try:
        rows = [row for row in csv.reader(lines) if any(cell.strip() for cell in row)]
    except csv.Error as error:
        raise InputError(f"{path}: not a CSV file: {error}") from None
    header = [cell.strip() for cell in rows[0]] if rows else []
    if not header or header[0] != "name":
        raise InputError(
            f"{path}: the first line starts with {header[:1]}, expected a header "
            "name,x_m,y_m,z_m,<camera>_u_px,<camera>_v_px,..."
        )
    column = _columns(path, header, cameras)
    names: list[str] = []
    table = np.full((len(rows) - 1, len(header)), np.nan)
    for index, row in enumerate(rows[1:]):
        name = row[0].strip()
        if not name or name in names:
            found = f"a second '{name}'" if name else "no name"
            raise InputError(f"{path}: point {index + 1} has {found}; give each its own name")
        names.append(name)
        if len(row) > len(header):
            raise InputError(f"{path}: '{name}' has {len(row)} cells, the header {len(header)}")
        for position, cell in enumerate(row[1:], start=1):
            if cell.strip():
                table[index, position] = _number(path, name, header[position], cell)
    keypoints = np.full((len(cameras), len(names), 3), [np.nan, np.nan, 0.0])
    for camera, name in enumerate(cameras):
        if f"{name}_u_px" in column:
            pixels = table[:, [column[f"{name}_u_px"], column[f"{name}_v_px"]]]
            half = np.isfinite(pixels).any(axis=1) & ~np.isfinite(pixels).all(axis=1)
            if half.any():
                raise InputError(
                    f"{path}: '{names[int(half.argmax())]}' has one of two pixel coordinates in "
                    f"'{name}'; give both or none"
                )
            seen = np.isfinite(pixels[:, 0])
            keypoints[camera, seen] = np.column_stack([pixels[seen], np.ones(seen.sum())])
    if not all(key in column for key in _WORLD):
        return MarkedPoints(names=tuple(names), keypoints=keypoints, in_world_m=None)
    in_world = table[:, [column[key] for key in _WORLD]]
    lost = ~np.isfinite(in_world).all(axis=1)
    if lost.any():
        raise InputError(f"{path}: '{names[int(lost.argmax())]}' lacks one of x_m, y_m, z_m")
    return MarkedPoints(names=tuple(names), keypoints=keypoints, in_world_m=in_world)


def _columns(path: Path, header: list[str], cameras: tuple[str, ...]) -> dict[str, int]:
    known = {*_WORLD, *(f"{name}_{axis}_px" for name in cameras for axis in "uv")}
    for key in header[1:]:
        if key not in known:
            raise InputError(f"{path}: unknown column '{key}'{nearest(key, sorted(known))}")
        if header.count(key) > 1:
            raise InputError(f"{path}: column '{key}' is there twice")
    column = {key: position for position, key in enumerate(header)}
    for group in (_WORLD, *((f"{name}_u_px", f"{name}_v_px") for name in cameras)):
        found = [key for key in group if key in column]
        if found and len(found) < len(group):
            missing = next(key for key in group if key not in column)
            raise InputError(f"{path}: has column {found[0]} but not {missing}")
    return column


def _number(path: Path, name: str, key: str, cell: str) -> float:
    try:
        value = float(cell)
    except ValueError:
        value = float("nan")
    if not np.isfinite(value):
        raise InputError(f"{path}: {key} of '{name}' is '{cell.strip()}', expected a number")
    return value
