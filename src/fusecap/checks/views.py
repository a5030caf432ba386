"""Whether the cameras agree about the people in front of them, and if not, why.

A camera that disagrees is late, or takes left for right, or its keypoints are of another
resolution or of turned pictures, or it was moved. Each of the first four is tried: what makes the
disagreement fall to less than half (a shift in time: to three quarters) is named, else it stays
with the last. Of a late camera slow people tell nothing, so that is tried on the instants at which
people are fastest.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from fusecap.findings import Findings
from fusecap.geometry.camera import Rig
from fusecap.sources import view_agreement
from fusecap.sources.keypoint_files import KeypointTrack
from fusecap.sources.people_store import changed
from fusecap.sources.synchronizer import people_at

SAMPLED_INSTANTS = 60
FAST_SHARE = 3
"""One in so many of the instants looked at is a fast one."""
SPEED_OVER_S = 0.1
MAX_DISAGREEMENT_SHARE = 0.01
"""Of the image's diagonal: 22 px of a 1920 x 1080 image."""
NOTABLE_DISAGREEMENT_SHARE = 0.005
"""The same of a camera that disagrees twice as much as the others, and of a typical pair."""
LATE_DISAGREEMENT_SHARE, LATE_OVER_OTHERS = 0.0024, 1.25
"""The same of a camera that a shift in time makes agree, and over the others' median."""
EXPLAINED = 0.5
"""A cause is named that leaves less than this of a disagreement."""
EXPLAINED_BY_TIME, AS_OTHERS = 0.75, 1.3
"""The same of a shift, at instants that did not choose it, that leaves no more than this of what
others disagree by. Right cameras, simulated and recorded, keep 0.85 or more, and nearly all of them
want no shift."""
SHIFT_RANGE_S = 1.0
LEAST_SHIFT_S = 0.03
RESOLUTIONS = (0.25, 1 / 3, 0.5, 2 / 3, 0.75, 4 / 3, 1.5, 2.0, 3.0, 4.0)
"""Of one video over another's: 480, 540, 720, 1080, 1440 and 2160 lines."""
TURNS_DEG = (90, 180, 270)
"""Clockwise, of phones held upright, of cameras on their side."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ComparedViews:
    """Two or more cameras through ideal lenses, and instants at which to compare them."""

    rig: Rig
    tracks: tuple[KeypointTrack, ...]
    times_s: np.ndarray
    """(T,) over what all cameras cover."""
    fast_s: np.ndarray
    """(T,) those at which people move most."""
    people: list[np.ndarray]
    """Of `times_s`, as `view_agreement.people_in_world`."""

    @classmethod
    def of(cls, rig: Rig, keypoints: Sequence[KeypointTrack]) -> ComparedViews | None:
        """None where nothing can be compared."""
        if len(keypoints) < 2 or not all(any(map(len, track.people)) for track in keypoints):
            return None
        rig, tracks = view_agreement.without_distortion(
            rig.subset([track.name for track in keypoints]), keypoints
        )
        start = max(float(track.times_s[0]) for track in tracks)
        end = min(float(track.times_s[-1]) for track in tracks)
        if start >= end:
            return None
        fastest_hz = max(track.rate_hz for track in tracks)
        count = int((end - start) * fastest_hz) + 1
        step = max(1, count // (FAST_SHARE * SAMPLED_INSTANTS))
        every_s = start + np.arange(0, count, step) / fastest_hz
        speeds = _speeds(tracks, every_s)
        fast = np.sort(np.argsort(-speeds, kind="stable")[: max(1, len(every_s) // FAST_SHARE)])
        times_s = every_s[:: max(1, len(every_s) // SAMPLED_INSTANTS)]
        return cls(
            rig=rig,
            tracks=tuple(tracks),
            times_s=times_s,
            fast_s=every_s[fast],
            people=view_agreement.people_in_world(rig, tracks, times_s),
        )

    def disagreement_px(self, times_s: np.ndarray) -> np.ndarray:
        """(C, C) medians."""
        return view_agreement.disagreement_px(self.rig, self.tracks, times_s)

    def with_track(self, index: int, track: KeypointTrack) -> ComparedViews:
        """One camera's keypoints as they may have been meant."""
        return replace(
            self, tracks=tuple(track if i == index else t for i, t in enumerate(self.tracks))
        )

    def own_px(self, index: int, times_s: np.ndarray) -> float:
        """What one camera disagrees by with the typical other one."""
        return view_agreement.camera_disagreement_px(self.rig, self.tracks, index, times_s)

    def share(self, index: int, disagreement_px: float) -> float:
        """Of the image's diagonal."""
        return disagreement_px / float(np.hypot(*self.rig.cameras[index].size_px))


def _speeds(tracks: Sequence[KeypointTrack], times_s: np.ndarray) -> np.ndarray:
    """(T,) how far the typical keypoint moves soon after, over all views; 0 where nobody does."""
    result = np.zeros(len(times_s))
    for track in tracks:
        for i, t_s in enumerate(times_s):
            now, soon = people_at(track, t_s), people_at(track, t_s + SPEED_OVER_S)
            if len(now) == len(soon):
                moved = np.linalg.norm(soon[:, :, :2] - now[:, :, :2], axis=2)
                if np.isfinite(moved).any():
                    result[i] += float(np.nanmedian(moved))
    return result


def check_views(views: ComparedViews, findings: Findings) -> None:
    """Cameras that stand out, else all of them together."""
    pairs = views.disagreement_px(views.times_s)
    own = view_agreement.per_camera_px(pairs)
    fast = view_agreement.per_camera_px(views.disagreement_px(views.fast_s))
    if _check_pictures(views, pairs, findings):
        return
    single = False
    for index in range(len(views.rig)):
        share, median = views.share(index, own[index]), _median_of_others(own, index)
        grave = share > MAX_DISAGREEMENT_SHARE or (
            share > NOTABLE_DISAGREEMENT_SHARE and own[index] > 2 * median
        )
        maybe_late = views.share(index, fast[index]) > LATE_DISAGREEMENT_SHARE and (
            len(views.rig) == 2 or fast[index] > LATE_OVER_OTHERS * _median_of_others(fast, index)
        )
        if not (grave or maybe_late):
            continue
        told = _cause(views, index, own[index], _median_of_others(fast, index))
        if told is None and grave:
            told = (
                "if it was moved: fusecap calibrate extrinsics, --from-people without a board; "
                "if its clock is off: fusecap calibrate sync"
            )
        if told is not None:
            findings.add(
                "warning",
                f"camera '{views.tracks[index].name}'",
                f"disagrees with the others: median {own[index]:.0f} px, "
                f"{fast[index]:.0f} px where people are fast",
                told,
            )
            single = True
            if len(views.rig) == 2:
                break
    if not single:
        _check_all_together(views, pairs, findings)


def _median_of_others(values: np.ndarray, index: int) -> float:
    others = np.delete(values, index)
    others = others[np.isfinite(others)]
    return float(np.median(others)) if len(others) else np.inf


def _cause(views: ComparedViews, index: int, own_px: float, others_px: float) -> str | None:
    """The remedy for the one cause that leaves least, where any leaves little."""
    track = views.tracks[index]
    causes = []
    mirror = track.landmarks.mirror
    mirrored = replace(track, people=changed(track.people, lambda people: people[:, mirror]))
    left_px = views.with_track(index, mirrored).own_px(index, views.times_s)
    causes.append(
        (
            left_px / own_px,
            f"with left and right exchanged in it {left_px:.0f} px are left: its pictures are "
            "mirrored, or the detector takes left for right; mend them and detect again",
        )
    )
    for scale in RESOLUTIONS:
        scaled = _scaled(track, scale)
        left_px = views.with_track(index, scaled).own_px(index, views.times_s)
        causes.append((left_px / own_px, _resolution_remedy(views, index, scale, left_px)))
    for turn_deg in TURNS_DEG:
        back = _turned_back(track, views.rig.cameras[index].size_px, turn_deg)
        left_px = views.with_track(index, back).own_px(index, views.times_s)
        causes.append((left_px / own_px, _turn_remedy(track.name, turn_deg, left_px)))
    share, remedy = min(causes, key=lambda cause: _known(cause[0]))
    late_share, late_px, late_remedy = _shift(views, index)
    as_others = late_px < AS_OTHERS * others_px < np.inf
    if late_share < min(EXPLAINED_BY_TIME if as_others else EXPLAINED, _known(share)):
        return late_remedy
    return remedy if share < EXPLAINED else None


def _known(value: float) -> float:
    """Infinite for what nobody measured, which is then least of nothing."""
    return value if np.isfinite(value) else np.inf


def _shift(views: ComparedViews, index: int) -> tuple[float, float, str]:
    """The share and the pixels it leaves; chosen on some of the fast instants, judged on others."""
    track = views.tracks[index]
    frames = np.round(SHIFT_RANGE_S * track.rate_hz)
    shifts_s = np.arange(-frames, frames + 1, max(1, frames // 20)) / track.rate_hz
    shift_s, _ = _best_shift(views, index, views.fast_s[::3], shifts_s)
    if abs(shift_s) < LEAST_SHIFT_S:
        return np.inf, np.inf, ""
    _, before_px = _best_shift(views, index, views.fast_s[1::3], np.zeros(1))
    _, left_px = _best_shift(views, index, views.fast_s[1::3], np.array([shift_s]))
    remedy = (
        f"add about {shift_s:+.2f} s to its offset_s: then {left_px:.0f} px are left; "
        "fusecap calibrate sync finds it exactly"
    )
    return _known(left_px / max(before_px, 1e-9)), left_px, remedy


def _best_shift(
    views: ComparedViews, index: int, times_s: np.ndarray, shifts_s: np.ndarray
) -> tuple[float, float]:
    return view_agreement.best_shift_s(views.rig, views.tracks, index, times_s, shifts_s)


def _scaled(track: KeypointTrack, scale: float) -> KeypointTrack:
    scales = [scale, scale, 1.0]
    return replace(track, people=changed(track.people, lambda people: people * scales))


def _turned_back(
    track: KeypointTrack, size_px: tuple[int, int], clockwise_deg: int
) -> KeypointTrack:
    """Of pictures that were turned clockwise, as of the calibrated ones of this size."""
    width, height = size_px

    def back(people: np.ndarray) -> np.ndarray:
        u, v, confidence = np.moveaxis(people, -1, 0)
        old = {
            90: (v, height - 1 - u),
            180: (width - 1 - u, height - 1 - v),
            270: (width - 1 - v, u),
        }[clockwise_deg]
        return np.stack([*old, confidence], axis=-1)

    return replace(track, people=changed(track.people, back))


def _turn_remedy(cameras: str, clockwise_deg: int, left_px: float) -> str:
    return (
        f"as of pictures turned clockwise by {clockwise_deg} deg {left_px:.0f} px are left: turn "
        "them back and detect again, or turn the calibration: fusecap calibrate world --turned "
        f"{cameras}={clockwise_deg}"
    )


def _resolution_remedy(views: ComparedViews, index: int, scale: float, left_px: float) -> str:
    width, height = views.rig.cameras[index].size_px
    return (
        f"as of {width / scale:.0f} x {height / scale:.0f} pictures {left_px:.0f} px are left: the "
        f"detector ran at another resolution than the calibration's {width} x {height}; "
        "detect at that, or calibrate at this"
    )


def _check_pictures(views: ComparedViews, pairs_px: np.ndarray, findings: Findings) -> bool:
    """Whether keypoints of all views are of other pictures than their calibration's."""
    typical_px = _median(pairs_px)
    if not views.share(0, typical_px) > NOTABLE_DISAGREEMENT_SHARE:
        return False
    causes = []
    for scale in RESOLUTIONS:
        scaled = replace(views, tracks=tuple(_scaled(track, scale) for track in views.tracks))
        left_px = _median(scaled.disagreement_px(views.times_s))
        causes.append((left_px, _resolution_remedy(views, 0, scale, left_px)))
    for turn_deg in TURNS_DEG:
        back = replace(
            views,
            tracks=tuple(
                _turned_back(track, camera.size_px, turn_deg)
                for track, camera in zip(views.tracks, views.rig.cameras, strict=True)
            ),
        )
        left_px = _median(back.disagreement_px(views.times_s))
        causes.append((left_px, _turn_remedy("CAMERA", turn_deg, left_px)))
    left_px, remedy = min(causes, key=lambda cause: _known(cause[0]))
    if not left_px < EXPLAINED * typical_px:
        return False
    findings.add(
        "warning",
        "calibration",
        f"cameras disagree by a median of {typical_px:.0f} px",
        remedy,
    )
    return True


def _median(pairs_px: np.ndarray) -> float:
    return float(np.nanmedian(pairs_px)) if np.isfinite(pairs_px).any() else float("nan")


def _check_all_together(views: ComparedViews, pairs_px: np.ndarray, findings: Findings) -> None:
    """Pairs that all disagree a little: nobody stands out, but something is wrong with all."""
    rig = views.rig
    shares = pairs_px / np.mean([np.hypot(*camera.size_px) for camera in rig.cameras])
    if not np.isfinite(shares).any() or np.nanmedian(shares) <= NOTABLE_DISAGREEMENT_SHARE:
        return
    typical_px = _median(pairs_px)
    i, j = np.unravel_index(np.nanargmax(shares), shares.shape)
    findings.add(
        "warning",
        "calibration",
        f"cameras disagree by a median of {typical_px:.0f} px; worst are "
        f"'{rig.cameras[i].name}' and '{rig.cameras[j].name}' with {pairs_px[i, j]:.0f} px",
        "fusecap calibrate sync where clocks may differ; else fusecap calibrate extrinsics "
        "--from-people, which needs no board",
    )
