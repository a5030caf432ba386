"""Sensor files: rates, gaps, units, gravity."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from fusecap.errors import FusecapError
from fusecap.findings import Findings
from fusecap.geometry.quaternions import from_wxyz
from fusecap.sources.imu_files.track import ImuTrack
from fusecap.sources.session import ImuSettings, Session
from fusecap.sources.session_sensors import mount
from fusecap.sources.synchronizer import UPRIGHT
from fusecap.types import GRAVITY_M_S2

FROZEN_S = 0.5
_OR_SIGN = (
    " where their worlds are north, east, down; where accelerometers read 9.8 downwards at rest, "
    "multiply accelerations by -1 instead"
)


def check_imus(
    session: Session, tracks: Mapping[str, Sequence[ImuTrack | None]], findings: Findings
) -> None:
    """Of every sensor that could be read, and how it sits on its bone."""
    for subject in session.subjects:
        unmounted, other_up = [], []
        for imu, track in zip(subject.imus, tracks.get(subject.name, ()), strict=True):
            if track is None:
                continue
            where = f"imu '{imu.bone}' of '{subject.name}'"
            if (
                imu.bone_from_imu_wxyz is None
                and subject.still_s is None
                and track.bone_from_imu is None
            ):
                unmounted.append(imu.bone)
            else:
                try:
                    mount(subject.model_copy(update={"imus": (imu,)}), [track])
                except FusecapError as error:
                    findings.add("error", where, str(error).removeprefix(f"{where}: "))
                    continue
            _check_imu(where, imu, track, findings)
            if _points_elsewhere(imu, track):
                other_up.append((imu.imu_up, track.up_axis, imu.bone))
        if unmounted:
            _add_unmounted(subject.name, unmounted, bool(session.cameras), findings)
        for stated, found in {(stated, found): None for stated, found, _ in other_up}:
            bones = [bone for *both, bone in other_up if both == [stated, found]]
            findings.add(
                "warning",
                f"sensors of '{subject.name}'",
                f"imu_up is {stated}, gravity points along {found}: {', '.join(bones)}",
                f'set imu_up = "{found}" in their tables'
                + (_OR_SIGN if "-z" in (stated, found) else ""),
            )


def _points_elsewhere(imu: ImuSettings, track: ImuTrack) -> bool:
    """Whether gravity's reaction points along another axis that may be called up."""
    return track.up_axis in UPRIGHT and track.up_axis != imu.imu_up


def _add_unmounted(subject: str, bones: list[str], cameras: bool, findings: Findings) -> None:
    command = "fusecap calibrate imu finds it from motion the cameras saw, or " if cameras else ""
    findings.add(
        "error",
        f"sensors of '{subject}'",
        f"how they sit on the bones is not known: {', '.join(bones)}",
        f"{command}state tpose_s = [start, end], when the subject stands in the T-pose, or npose_s",
    )


def _check_imu(where: str, imu: ImuSettings, track: ImuTrack, findings: Findings) -> None:
    if imu.rate_hz is not None and abs(track.rate_hz / imu.rate_hz - 1) > 0.02:
        findings.add(
            "warning",
            where,
            f"samples come at {track.rate_hz:.1f} Hz, rate_hz says {imu.rate_hz:g}",
            "correct rate_hz, or remove it",
        )
    if track.rate_hz < 20:
        findings.add(
            "warning",
            where,
            f"samples come at {track.rate_hz:.1f} Hz",
            "record at 60 Hz or more; below 20 Hz fast motion is lost",
        )
    _check_frozen(where, track, findings)
    if not track.heading_known and "heading_deg" not in imu.model_fields_set:
        findings.add(
            "error",
            where,
            "found without a magnetometer, it faces another way than the others, nobody knows "
            "which",
            "fusecap calibrate imu finds heading_deg from motion the cameras saw; or state it",
        )
    _check_gravity(where, imu, track, findings)


def _check_frozen(where: str, track: ImuTrack, findings: Findings) -> None:
    """No sensor that measures says the same twice for long, however still it lies."""
    samples = np.concatenate([track.orientation_wxyz, np.nan_to_num(track.accel_m_s2)], axis=1)
    changes = np.flatnonzero((np.diff(samples, axis=0) != 0).any(axis=1)) + 1
    if len(changes) == 0:
        return
    first = np.concatenate([[0], changes])
    last = np.concatenate([changes, [len(samples)]]) - 1
    lasts_s = track.times_s[last] - track.times_s[first]
    longest = int(np.argmax(lasts_s))
    if lasts_s[longest] > FROZEN_S:
        findings.add(
            "warning",
            where,
            f"says the same for {lasts_s[longest]:.1f} s from "
            f"{track.times_s[first[longest]]:.1f} s on, to the last digit",
            "the sensor or its radio had stopped: take these rows out",
        )


def _check_gravity(where: str, imu: ImuSettings, track: ImuTrack, findings: Findings) -> None:
    """On average an accelerometer reads gravity, upwards in the world."""
    measured = np.isfinite(track.accel_m_s2).all(axis=1)
    if measured.sum() < 10:
        return
    world_from_imu = from_wxyz(track.orientation_wxyz[measured])
    force = np.median(world_from_imu.apply(track.accel_m_s2[measured]), axis=0)
    size = float(np.median(np.linalg.norm(track.accel_m_s2[measured], axis=1)))
    if abs(size - 1) < 0.3:
        findings.add(
            "error",
            where,
            f"the accelerometer reads {size:.2f} on average: it is in units of g",
            f"multiply by {GRAVITY_M_S2}; expected m/s2",
        )
    elif size < 4:
        findings.add(
            "error",
            where,
            f"the accelerometer reads {size:.1f} m/s2 on average: gravity has been removed",
            "export the raw acceleration (specific force)",
        )
    elif size > 14:
        findings.add(
            "warning",
            where,
            f"the accelerometer reads {size:.1f} m/s2 on average, gravity is {GRAVITY_M_S2:.1f}",
            "see in which unit or range it was recorded; expected m/s2",
        )
    else:
        up = UPRIGHT[imu.imu_up][1]
        angle = np.degrees(np.arccos(np.clip(force @ up / np.linalg.norm(force), -1, 1)))
        if angle > 15 and not _points_elsewhere(imu, track):
            findings.add(
                "warning",
                where,
                f"gravity points {angle:.0f} deg away from the sensor world's {imu.imu_up} axis",
                ("multiply its accelerations by -1, or " if angle > 165 else "")
                + "check that its quaternion is w, x, y, z from sensor to world",
            )
