"""What is known of cameras that were refined from people, and what to do about the rest."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Bool

from fusecap.calibrate.verdict import Verdict
from fusecap.geometry.camera import Rig

IMPROVES, IMPROVES_PX = 0.97, 0.1
"""The held-out median must fall to this share and by so much, or the old calibration stays."""
COVERED_SHARE = 0.25
"""Of an image's 6 x 6 cells: fewer with keypoints leave its rest to extrapolation."""
WALKED_M = 1.0
"""Smaller extents on the floor leave distances poorly known."""
UNSURE_M, UNSURE_RAD = 0.02, np.radians(0.5)
SHARED_SHARE = 0.1
"""Of person-instants, those in which a camera should take part."""
LEFT_PX = 8.0
"""Held-out median of a 1920-pixel-wide image that better camera poses alone should undercut."""


@dataclass(frozen=True, kw_only=True)
class HeldOutFit:
    """Residuals of one camera on held-out instants, in its own pixels."""

    median_px: float
    p90_px: float
    keypoints: int


@dataclass(frozen=True, kw_only=True)
class CameraChange:
    """What happened to one camera."""

    name: str
    before: HeldOutFit
    after: HeldOutFit
    skeleton_before_px: float
    """Median distance of held-out keypoints from the solved skeleton's landmarks."""
    skeleton_after_px: float
    moved_mm: float
    turned_deg: float
    focal_share: float
    """New focal length over the old."""
    sigma_mm: float
    """Uncertainty of the centre from the normal equations (3D)."""
    sigma_deg: float
    repeat_mm: float
    """Scatter of the centre over resampled blocks (3D)."""
    repeat_deg: float
    covered: float
    """Share of the image's 6 x 6 cells in which keypoints served the adjustment."""


@dataclass(frozen=True, kw_only=True)
class PeopleCalibration:
    """A refined rig and what is known about it."""

    rig: Rig
    improved: bool
    """Whether held-out keypoints say that it is better; if not, keep the old one."""
    cameras: tuple[CameraChange, ...]
    before: HeldOutFit
    """All cameras together."""
    after: HeldOutFit
    skeleton_before_px: float
    skeleton_after_px: float
    refined: tuple[str, ...]
    """What moved beside the poses: those of `focal`, `centre`, `distortion` that helped."""
    rounds: int
    fit_person_instants: int
    check_person_instants: int
    blocks: tuple[int, int]
    """Blocks of the adjustment, and held out."""
    block_s: float
    scale: float
    """New metres per old one."""
    scale_from: str
    walked_m: tuple[float, float]
    """Extents in x and z in which people's hips were, 5 % to 95 %."""
    feet_m: float
    """Height of the lowest tenth of foot keypoints above the floor of the new world."""
    notes: tuple[str, ...]
    """What keeps the result from being good, with its remedy."""
    residuals_px: Mapping[str, tuple[np.ndarray, np.ndarray]] = field(repr=False)
    """Per camera the held-out residuals (n, 2) before and after, for a picture."""

    @property
    def verdict(self) -> Verdict:
        """Poor where the old calibration is to be kept."""
        if not self.improved:
            return Verdict.POOR
        return Verdict.USABLE if self.notes else Verdict.GOOD


def fit_of(residual: np.ndarray) -> HeldOutFit:
    known = residual[np.isfinite(residual)]
    if not len(known):
        return HeldOutFit(median_px=np.nan, p90_px=np.nan, keypoints=0)
    return HeldOutFit(
        median_px=float(np.median(known)),
        p90_px=float(np.percentile(known, 90)),
        keypoints=len(known),
    )


def better(after: HeldOutFit, before: HeldOutFit) -> bool:
    limit_px = min(IMPROVES * before.median_px, before.median_px - IMPROVES_PX)
    return after.median_px < limit_px


def notes_on(
    result: PeopleCalibration, rough: Rig, views: Bool[np.ndarray, "n c"]
) -> tuple[str, ...]:
    """What could not be measured counts as poor; `views` are the adjustment's."""
    notes = []
    if not result.improved:
        notes.append(
            f"held-out keypoints do not fit better ({result.before.median_px:.1f} px before, "
            f"{result.after.median_px:.1f} px after): keep the old calibration"
        )
    if max(result.walked_m) < WALKED_M:
        notes.append(
            f"people stay within {result.walked_m[0]:.1f} x {result.walked_m[1]:.1f} m: record "
            "someone who walks through the whole volume"
        )
    cameras = list(zip(result.cameras, rough.cameras, views.T, strict=True))

    def note(which: Sequence[str], remedy: str) -> None:
        if which:
            notes.append(f"{', '.join(which)}: {remedy}")

    note(
        [
            f"'{c.name}' ({100 * c.covered:.0f} %)"
            for c, _, _ in cameras
            if c.covered < COVERED_SHARE
        ],
        "people cover so little of the image, the rest is extrapolated: walk to its edges, near "
        "and far",
    )
    note(
        [
            f"'{c.name}' ({c.repeat_mm:.0f} mm, {c.repeat_deg:.2f} deg)"
            for c, _, _ in cameras
            if not (c.repeat_mm <= 1e3 * UNSURE_M and c.repeat_deg <= np.degrees(UNSURE_RAD))
        ],
        "not known better than that: record longer, with more people and poses",
    )
    note(
        [
            f"'{c.name}' ({seen.sum()} of {len(seen)} person-instants)"
            for c, _, seen in cameras
            if seen.sum() < SHARED_SHARE * len(seen)
        ],
        "little is shared with other cameras: let people walk where views meet",
    )
    note(
        [f"'{c.name}'" for c in result.cameras if not c.after.keypoints],
        "no held-out keypoint checks it: record longer, with people where views meet",
    )
    note(
        [
            f"'{c.name}' ({c.before.median_px:.1f} -> {c.after.median_px:.1f} px)"
            for c in result.cameras
            if result.improved and better(c.before, c.after)
        ],
        "fits worse than before although all together fit better: check its lens and its clock",
    )
    note(
        [
            f"'{c.name}' ({c.after.median_px:.1f} px)"
            for c, lens, _ in cameras
            if c.after.median_px * lens.pixel_scale > LEFT_PX
        ],
        "more remains than a detector's scatter; camera poses alone do not explain it: check the "
        "lens (fusecap calibrate intrinsics) and the clock (fusecap doctor)",
    )
    if abs(result.feet_m) > 0.05:
        notes.append(
            f"feet stand {1e3 * result.feet_m:+.0f} mm from the floor of this world: mark the "
            "floor if that is not what they stood on (fusecap calibrate world)"
        )
    return tuple(notes)
