"""Who is who in every view, under a calibration that is not to be trusted yet.

The tracker's gates are metres and pixels around where a sound calibration puts a person. A rough
one adds an error of its own, and `Roughness` measures it without knowing anybody: the distance of
keypoints from each other's epipolar lines, the pair of cameras that disagrees most. Gates grow by
twice what that error is at the people's distance, and shrink to the defaults as cameras fall into
place.

A worked number: 30 px of a 1920-pixel-wide image at 5 m with a focal length of 1100 px are 14 cm,
so a person is looked for within 0.35 + 0.27 m instead of 0.35 m.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int

from fusecap.associate.candidates import CandidateOptions
from fusecap.associate.options import TrackerOptions
from fusecap.geometry.camera import Rig
from fusecap.pipeline import Pipeline, observation_of
from fusecap.progress import Progress
from fusecap.setup import setup_of
from fusecap.sources.session_data import SessionData
from fusecap.sources.view_agreement import disagreement_px, without_distortion
from fusecap.types import Detections, TrackState

MIN_CONFIDENCE = 0.3
"""Keypoints below it are guesses about what is hidden; they neither calibrate nor check."""
MIN_KEYPOINTS = 4
"""Of a person in a view that counts as seeing it."""
ENOUGH_HZ = 25.0
"""People are followed at this rate where a session is long; more only repeats the same poses."""
LONG = 2000
"""Instants beyond which a session is long."""
_SAMPLED = 40


@dataclass(frozen=True, kw_only=True)
class Sightings:
    """N person-instants in C views of K landmarks."""

    instant: Int[np.ndarray, " n"]
    """Index into the session's instants."""
    person: Int[np.ndarray, " n"]
    """Index into `names`."""
    names: tuple[str, ...]
    keypoints: Float[np.ndarray, "n c k 3"]
    """x, y [px], confidence; 0 where missing or below `MIN_CONFIDENCE`."""

    def __len__(self) -> int:
        return len(self.instant)

    def rows(self, rows: np.ndarray) -> Sightings:
        """Some of them."""
        return replace(
            self,
            instant=self.instant[rows],
            person=self.person[rows],
            keypoints=self.keypoints[rows],
        )

    @property
    def views(self) -> np.ndarray:
        """(n, c) which cameras see which person-instant."""
        return (self.keypoints[:, :, :, 2] > 0).sum(axis=2) >= MIN_KEYPOINTS


@dataclass(frozen=True, kw_only=True)
class Roughness:
    """What a calibration is off by."""

    pixels: float
    """Of a 1920-pixel-wide image, the pair of cameras that disagrees most."""
    metres: float
    """The same at the distance of the people."""

    def gates(self, factor: float = 1.0) -> TrackerOptions:
        """The tracker's options, widened."""
        usual, find = TrackerOptions(), CandidateOptions()
        more_m, more_px = 2 * factor * self.metres, 2 * factor * self.pixels
        return TrackerOptions(
            gate_m=usual.gate_m + more_m,
            reach_m=usual.reach_m + more_m,
            candidates=CandidateOptions(
                max_error_px=find.max_error_px + more_px,
                support_m=find.support_m + more_m,
                consistency_m=find.consistency_m + more_m,
                robust_scale_px=find.robust_scale_px + more_px / 2,
            ),
        )


def roughness(rig: Rig, data: SessionData) -> Roughness:
    """Of `rig`, judged by the session's keypoints; zero where no two cameras see a person."""
    instants = np.linspace(0, len(data.times_s) - 1, min(_SAMPLED, len(data.times_s)))
    times_s = data.times_s[np.unique(instants.astype(int))]
    ideal, tracks = without_distortion(rig, data.keypoints)
    scale = float(np.median([camera.pixel_scale for camera in rig.cameras]))
    apart = disagreement_px(ideal, tracks, times_s) * scale
    pixels = float(np.nanmax(apart)) if np.isfinite(apart).any() else 0.0
    focal_px = float(np.median([c.matrix[0, 0] * c.pixel_scale for c in rig.cameras]))
    return Roughness(pixels=pixels, metres=pixels / focal_px * _distance_m(rig))


def stride_of(data: SessionData) -> int:
    """Every how many-th instant is followed."""
    if len(data.times_s) <= LONG:
        return 1
    return max(1, int(data.session.settings.rate_hz // ENOUGH_HZ))


def sight(
    data: SessionData,
    rig: Rig,
    gates: TrackerOptions,
    detections: Sequence[tuple[int, Detections]],
    progress: Progress | None = None,
) -> Sightings:
    """Follow and solve everyone under `rig`; person-instants of people who became subjects.

    `detections` are the instants to follow, with their index.
    """
    setup = setup_of(data.session, rig, data.landmarks)
    settings = data.session.settings
    options = replace(gates, max_subjects=settings.max_subjects, volume_m=settings.volume_m)
    pipeline = Pipeline(replace(setup, associate="tracker", tracker=options))
    count = len(setup.landmarks.landmark_names)
    names: dict[int, str] = {}
    seen: list[tuple[int, int, np.ndarray]] = []
    for done, (instant, moment) in enumerate(detections, start=1):
        readings = {imus.subject: imus.reading(instant) for imus in data.imus}
        for update in pipeline.step(moment, readings).updates:
            if update.state is not TrackState.TENTATIVE:
                names[update.track_id] = update.name
            if (update.person >= 0).sum() > 1:
                keypoints = observation_of(update, moment, count, None).keypoints
                seen.append((instant, update.track_id, keypoints))
        if progress:
            progress("following people", done, len(detections))
    people = tuple(dict.fromkeys(names.values()))
    kept = [row for row in seen if row[1] in names]
    keypoints = np.array([row[2] for row in kept]).reshape(-1, len(rig), count, 3)
    keypoints[..., 2] = np.where(
        np.isfinite(keypoints).all(axis=-1) & (keypoints[..., 2] >= MIN_CONFIDENCE),
        np.minimum(keypoints[..., 2], 1.0),
        0.0,
    )
    found = Sightings(
        instant=np.array([row[0] for row in kept], dtype=np.int64),
        person=np.array([people.index(names[row[1]]) for row in kept], dtype=np.int64),
        names=people,
        keypoints=keypoints,
    )
    return found.rows(found.views.sum(axis=1) >= 2)


def _distance_m(rig: Rig) -> float:
    """From the cameras to the people: the median distance between cameras, on a ring 1.4 radii."""
    centres = np.array([camera.position_in_world for camera in rig.cameras])
    first, second = np.triu_indices(len(centres), 1)
    return float(np.median(np.linalg.norm(centres[first] - centres[second], axis=1)))
