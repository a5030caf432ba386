"""Calibrations that no room can hold: wrong unit, wrong up axis, inverted extrinsics."""

from __future__ import annotations

import numpy as np

from fusecap.findings import Finding
from fusecap.geometry.camera import Rig

MILLIMETRES_ABOVE = 100.0
"""Cameras whose median distance exceeds this are not given in metres."""
SAME_PLACE_M = 0.005
NARROW_M = 0.03
"""Nearer to each other than the lenses of a stereo camera."""
BELOW_FLOOR_M = -0.3


def camera_spread(rig: Rig) -> float:
    """Median distance between cameras; of a single camera, its distance from the origin."""
    centres = np.array([camera.position_in_world for camera in rig.cameras])
    if len(centres) < 2:
        return float(np.linalg.norm(centres)) if len(centres) else 0.0
    first, second = np.triu_indices(len(centres), 1)
    return float(np.median(np.linalg.norm(centres[first] - centres[second], axis=1)))


def check_rig(rig: Rig, *, floor: bool = True) -> list[Finding]:
    """Warnings about a rig in our y-up world; `floor` says that y = 0 is one."""
    findings = []
    centres = {camera.name: camera.position_in_world for camera in rig.cameras}
    names = list(centres)
    if len(rig) > 1 and camera_spread(rig) < SAME_PLACE_M:
        return [
            Finding(
                severity="error",
                where="calibration",
                found="all cameras stand at the same place: it holds their lenses only",
                remedy="fusecap calibrate extrinsics places them; name what it wrote",
            )
        ]
    if len(rig) > 1 and camera_spread(rig) < NARROW_M:
        return [
            Finding(
                severity="error",
                where="calibration",
                found=f"its cameras stand within {1e3 * camera_spread(rig):.0f} mm of each other",
                remedy="where they stand farther apart it is in another unit, or its extrinsics "
                "failed whatever their error says: fusecap calibrate extrinsics, with the board "
                "all over the room",
            )
        ]
    for i, first in enumerate(names):
        for second in names[i + 1 :]:
            if np.linalg.norm(centres[first] - centres[second]) < SAME_PLACE_M:
                findings.append(
                    Finding(
                        severity="warning",
                        where=f"cameras '{first}' and '{second}'",
                        found="stand at the same place, so they give no depth",
                        remedy="calibrate the extrinsics again",
                    )
                )
    for camera in rig.cameras:
        centre = camera.matrix[:2, 2] / camera.size_px
        if np.any(centre < 0.1) or np.any(centre > 0.9):
            findings.append(
                Finding(
                    severity="warning",
                    where=f"camera '{camera.name}'",
                    found=f"its optical axis meets the image at {camera.matrix[0, 2]:.0f}, "
                    f"{camera.matrix[1, 2]:.0f} px of {camera.size_px[0]} x {camera.size_px[1]}",
                    remedy="check that size and matrix belong to the same resolution",
                )
            )
    if len(rig) == 0:
        return findings
    down = np.array([camera.rotation[1] for camera in rig.cameras])
    if np.mean(down[:, 1]) > 0.3:
        findings.append(
            Finding(
                severity="warning",
                where="calibration",
                found="the cameras hang upside down",
                remedy='check the up axis, "y", "z" or "-y": up under [session], --up of commands',
            )
        )
    low = [name for name, centre in centres.items() if centre[1] < BELOW_FLOOR_M]
    if floor and low:
        findings.append(
            Finding(
                severity="warning",
                where=f"{len(low)} of {len(rig)} cameras ({', '.join(low[:5])})",
                found=f"lie up to {-min(centres[name][1] for name in low):.2f} m below the floor",
                remedy="check the up axis (up under [session]), put the origin on the floor "
                "(fusecap calibrate world), or set floor = false",
            )
        )
    if len(rig) > 1 and not _look_at_each_other(rig):
        findings.append(
            Finding(
                severity="warning",
                where="calibration",
                found="the cameras look away from a common volume",
                remedy="the extrinsics may be inverted (world_from_cam instead of cam_from_world) "
                "or a sign flipped",
            )
        )
    return findings


def _look_at_each_other(rig: Rig) -> bool:
    """Whether the point nearest to all optical axes lies before most cameras."""
    axes = np.array([camera.rotation[2] for camera in rig.cameras])
    centres = np.array([camera.position_in_world for camera in rig.cameras])
    across = np.eye(3) - axes[:, :, None] * axes[:, None, :]
    total = across.sum(0)
    if np.linalg.cond(total) > 1e6:
        return True
    common = np.linalg.solve(total, np.einsum("cij,cj->i", across, centres))
    ahead = np.einsum("cj,cj->c", axes, common - centres)
    return bool(np.mean(ahead > 0) >= 0.5)
