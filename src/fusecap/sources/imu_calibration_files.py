"""How sensors sit on their bones as TOML: what `fusecap calibrate imu` writes and a session names.

    format = "fusecap imu calibration 1"
    origin = "20.7 s of motion"

    [[imu]]
    subject = "anna"
    bone = "left_shank"                     # as the session has it
    bone_from_imu_wxyz = [0.7071, 0.0, 0.7071, 0.0]
    heading_deg = 3.10

The values come before those of the session's [[subject.imu]] tables.
"""

from __future__ import annotations

import sys
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from fusecap.errors import InputError, nearest
from fusecap.sources.toml_text import quoted, read_written

FORMAT = "fusecap imu calibration 1"
_KEYS = ("format", "origin", "imu")
_IMU_KEYS = ("subject", "bone", "bone_from_imu_wxyz", "heading_deg")


@dataclass(frozen=True, kw_only=True)
class CalibratedImu:
    """One sensor's constants, as a session's [[subject.imu]] table would state them."""

    subject: str
    bone: str
    bone_from_imu_wxyz: tuple[float, float, float, float]
    heading_deg: float


def imu_calibration_toml(imus: Iterable[CalibratedImu], *, origin: str) -> str:
    """The text of a file; `origin` says where the values are from."""
    lines = [
        "# How sensors sit on their bones; name this file as imu_calibration under [session].",
        f"format = {quoted(FORMAT)}",
        f"origin = {quoted(origin)}",
    ]
    for imu in imus:
        numbers = ", ".join(f"{value:.7f}" for value in imu.bone_from_imu_wxyz)
        lines += [
            "",
            "[[imu]]",
            f"subject = {quoted(imu.subject)}",
            f"bone = {quoted(imu.bone)}",
            f"bone_from_imu_wxyz = [{numbers}]",
            f"heading_deg = {imu.heading_deg:.3f}",
        ]
    return "\n".join(lines) + "\n"


def read_imu_calibration(path: Path | str) -> tuple[CalibratedImu, ...]:
    """The sensors of a file; raises `InputError`."""
    path = Path(path)
    data = read_written(path, FORMAT, "fusecap calibrate imu")
    _only_known(path, "", data, _KEYS)
    tables = data.get("imu", [])
    if not isinstance(tables, list) or not all(isinstance(table, dict) for table in tables):
        raise InputError(f"{path}: imu is {tables!r}, expected [[imu]] tables")
    imus = tuple(_imu(path, number, table) for number, table in enumerate(tables, start=1))
    seen = set()
    for imu in imus:
        if (imu.subject, imu.bone) in seen:
            raise InputError(
                f"{path}: '{imu.bone}' of '{imu.subject}' has two [[imu]] tables, expected one; "
                "write the file again with: fusecap calibrate imu"
            )
        seen.add((imu.subject, imu.bone))
    return imus


def _imu(path: Path, number: int, table: dict[str, Any]) -> CalibratedImu:
    where = f"[[imu]] no. {number}"
    _only_known(path, f"{where}: ", table, _IMU_KEYS)
    for key in _IMU_KEYS:
        if key not in table:
            raise InputError(f"{path}: {where} has no {key}")
    for key in ("subject", "bone"):
        if not isinstance(table[key], str):
            raise InputError(f"{path}: {where} {key} is {table[key]!r}, expected text in quotes")
    heading = _numbers([table["heading_deg"]])
    if heading is None:
        raise InputError(
            f"{path}: {where} heading_deg is {table['heading_deg']!r}, expected a number"
        )
    wxyz = _numbers(table["bone_from_imu_wxyz"])
    if wxyz is None or len(wxyz) != 4 or abs(np.linalg.norm(wxyz) - 1.0) > 0.05:
        raise InputError(
            f"{path}: {where} bone_from_imu_wxyz is {table['bone_from_imu_wxyz']!r}, expected a "
            "unit quaternion [w, x, y, z]"
        )
    return CalibratedImu(
        subject=table["subject"],
        bone=table["bone"],
        bone_from_imu_wxyz=(wxyz[0], wxyz[1], wxyz[2], wxyz[3]),
        heading_deg=heading[0],
    )


def _only_known(path: Path, where: str, table: dict[str, Any], known: tuple[str, ...]) -> None:
    for key in table:
        if key not in known:
            raise InputError(f"{path}: {where}unknown key '{key}'{nearest(key, known)}")


def _numbers(values: Any) -> list[float] | None:
    if not isinstance(values, list):
        return None
    if any(isinstance(v, bool) or not isinstance(v, int | float) for v in values):
        return None
    if not all(abs(v) <= sys.float_info.max for v in values):
        return None
    return [float(v) for v in values]
