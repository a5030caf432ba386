"""Rounds of following people and moving cameras, until the cameras rest."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from fusecap.body.landmarks import LandmarkSet
from fusecap.calibrate.cameras.people_adjust import (
    AdjustedByPeople,
    Evidence,
    Free,
    State,
    adjust,
    lengths_of,
)
from fusecap.calibrate.cameras.people_gauge import align
from fusecap.calibrate.cameras.people_sightings import Sightings, roughness, sight
from fusecap.errors import InputError
from fusecap.geometry.camera import Rig
from fusecap.geometry.similarity import Similarity
from fusecap.geometry.triangulation import ROBUST_SCALE_PX, triangulate
from fusecap.progress import Progress
from fusecap.sources.session_data import SessionData
from fusecap.types import Detections

CHECK_EVERY = 4
"""Of this many blocks one is held out."""
BLOCK_S = 2.0
"""Length of a block: a step of walking or two, after which people stand elsewhere."""
MIN_BLOCKS = 8
"""A shorter session has shorter blocks."""
ADJUSTED = 160
"""Person-instants in an adjustment, spread evenly; more of the same poses add little."""
MAX_ROUNDS = 6
RESTED_PX = 0.2
"""Of a 1920-pixel-wide image: cameras rest when a round moves images by less, in the mean."""
MIN_INSTANTS = 20

_WIDER = (1.0, 2.0, 4.0)
_LIMBS = [
    *(("left_shoulder", "right_shoulder"), ("left_hip", "right_hip")),
    *(
        (f"{side}_{a}", f"{side}_{b}")
        for side in ("left", "right")
        for a, b in (
            *(("shoulder", "elbow"), ("elbow", "wrist"), ("hip", "knee"), ("knee", "ankle")),
            *(("ankle", "heel"), ("ankle", "big_toe")),
        )
    ),
]


@dataclass(frozen=True, kw_only=True)
class Split:
    """Time in blocks; every `CHECK_EVERY`th is held out."""

    block_of: np.ndarray
    """Per instant of the session."""
    count: int
    block_s: float

    @classmethod
    def of(cls, data: SessionData, instants: Sequence[int]) -> Split:
        span_s = float(data.times_s[instants[-1]] - data.times_s[instants[0]])
        count = max(MIN_BLOCKS, round(span_s / BLOCK_S))
        share = np.arange(len(data.times_s)) / len(data.times_s)
        return cls(
            block_of=np.floor(share * count).astype(int), count=count, block_s=span_s / count
        )

    def held_out(self, instant: np.ndarray) -> np.ndarray:
        """Which of the instants check."""
        return self.block_of[instant] % CHECK_EVERY == CHECK_EVERY - 2

    @property
    def fit_blocks(self) -> np.ndarray:
        blocks = np.arange(self.count)
        return blocks[blocks % CHECK_EVERY != CHECK_EVERY - 2]


@dataclass(frozen=True, kw_only=True)
class Alternation:
    """The end of an alternation, in the rough calibration's world."""

    rig: Rig
    adjusted: AdjustedByPeople
    evidence: Evidence
    rows: Sightings
    """Person-instants of the adjustment."""
    sightings: Sightings
    """All."""
    free: Free
    rounds: int


@dataclass(frozen=True, kw_only=True)
class Rounds:
    """What the steps share."""

    data: SessionData
    detections: Sequence[tuple[int, Detections]]
    split: Split
    progress: Progress | None

    def alternate(self, rig: Rig, free: Free, trusted: Rig | None = None) -> Alternation:
        """Follow, adjust, align, until the cameras rest; `trusted` is the rough calibration."""
        rough = trusted or rig
        found = None
        for number in range(1, MAX_ROUNDS + 1):
            seen = self._sight(rig, first=number == 1)
            rows = self._fit_rows(seen)
            evidence = _evidence(self.landmarks, rows)
            scale_px = ROBUST_SCALE_PX + roughness(rig, self.data).pixels
            points = triangulated(rig, rows, scale_px)
            state = State(rig=rig, points=points, lengths_m=lengths_of(points, evidence))
            self.show("adjusting", number - 1, MAX_ROUNDS)
            adjusted = adjust(state, rough, evidence, free, sigma_px=max(scale_px / 2, 5.0))
            similarity = align(adjusted.state.rig, rough).similarity
            adjusted = _in_world(adjusted, similarity)
            new = adjusted.state.rig
            moved_px = _image_motion_px(rig, new, adjusted.state.points)
            rig = new
            found = Alternation(
                rig=new,
                adjusted=adjusted,
                evidence=evidence,
                rows=rows,
                sightings=seen,
                free=free,
                rounds=number,
            )
            if moved_px < RESTED_PX:
                break
        assert found is not None
        self.show("adjusting", MAX_ROUNDS, MAX_ROUNDS)
        return replace(found, sightings=self._sight(rig, first=False))

    @property
    def landmarks(self) -> LandmarkSet:
        assert self.data.landmarks is not None
        return self.data.landmarks

    def show(self, what: str, done: int, total: int) -> None:
        if self.progress:
            self.progress(what, done, total)

    def _sight(self, rig: Rig, *, first: bool) -> Sightings:
        """People under `rig`; the first time with wider gates until enough are found."""
        rough = roughness(rig, self.data)
        seen = None
        for factor in _WIDER if first else _WIDER[:1]:
            seen = sight(self.data, rig, rough.gates(factor), self.detections, self.progress)
            fit = ~self.split.held_out(seen.instant)
            if fit.sum() >= MIN_INSTANTS and not _apart(seen.views[fit]):
                return seen
        assert seen is not None
        raise InputError(_nobody(self.data, seen, rough.pixels, ~self.split.held_out(seen.instant)))

    def _fit_rows(self, seen: Sightings) -> Sightings:
        rows = np.flatnonzero(~self.split.held_out(seen.instant))
        spread = np.linspace(0, len(rows) - 1, min(ADJUSTED, len(rows))).round().astype(int)
        return seen.rows(rows[spread])


def _apart(views: np.ndarray) -> list[int]:
    """Cameras (n, c) not linked to the one that sees most by people seen together."""
    shared = views.T.astype(int) @ views.astype(int) >= MIN_INSTANTS // 2
    if not len(views):
        return list(range(views.shape[1]))
    linked = {int(np.argmax(views.sum(axis=0)))}
    while True:
        more = {int(b) for a in linked for b in np.flatnonzero(shared[a])} - linked
        if not more:
            return [c for c in range(views.shape[1]) if c not in linked]
        linked |= more


def _nobody(data: SessionData, seen: Sightings, pixels: float, fit: np.ndarray) -> str:
    path = data.session.path
    found = sum(len(people) for track in data.keypoints for people in track.people)
    if found == 0:
        return f"{path}: no camera has a keypoint; detect people first, and see: fusecap doctor"
    if fit.sum() < MIN_INSTANTS:
        return (
            f"{path}: people could be followed at {int(fit.sum())} instants, expected "
            f"{MIN_INSTANTS} or more; views disagree by {pixels:.0f} px of a 1920-pixel-wide "
            "image. Either cameras never see the same person, clocks disagree (fusecap doctor "
            "tells), or the calibration is too rough to start from: calibrate with a board first"
        )
    lost = ", ".join(f"'{data.rig.names[c]}'" for c in _apart(seen.views[fit]))
    return (
        f"{path}: camera {lost} sees nobody together with the others at {MIN_INSTANTS // 2} "
        "instants or more; let people walk where its view meets theirs, leave it out of the "
        "session, or calibrate it with a board"
    )


def limbs_of(landmarks: LandmarkSet) -> np.ndarray:
    names = landmarks.landmark_names
    return np.array(
        [(names.index(a), names.index(b)) for a, b in _LIMBS if a in names and b in names]
    )


def _evidence(landmarks: LandmarkSet, rows: Sightings) -> Evidence:
    return Evidence(
        keypoints=rows.keypoints,
        person=rows.person,
        limbs=limbs_of(landmarks),
        weight=np.ones(len(rows)),
    )


def triangulated(rig: Rig, rows: Sightings, scale_px: float) -> Float[np.ndarray, "n k 3"]:
    return np.array([triangulate(rig, seen, scale_px)[0] for seen in rows.keypoints])


def _in_world(adjusted: AdjustedByPeople, similarity: Similarity) -> AdjustedByPeople:
    state = adjusted.state
    cameras = len(state.rig)
    unit = np.ones((cameras, len(adjusted.information) // cameras))
    unit[:, 3:6] = similarity.scale
    return replace(
        adjusted,
        state=State(
            rig=similarity.rig(state.rig),
            points=similarity.points(state.points),
            lengths_m=similarity.scale * state.lengths_m,
        ),
        information=adjusted.information / np.outer(unit, unit),
    )


def _image_motion_px(old: Rig, new: Rig, points: Float[np.ndarray, "n k 3"]) -> float:
    """Mean motion of the landmarks' images, in pixels of a 1920-pixel-wide image."""
    flat = points[np.isfinite(points[:, :, 0])]
    moved = [
        np.linalg.norm(a.project(flat) - b.project(flat), axis=1) * a.pixel_scale
        for a, b in zip(old.cameras, new.cameras, strict=True)
    ]
    return float(np.nanmean(moved))
