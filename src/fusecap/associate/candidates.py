"""People found from scratch: skeletons that several views agree on.

The problem: two rays always pass near each other somewhere, so with p people in each of two views,
p(p - 1) of the p² pairs are ghosts, and those on one epipolar plane fit as well as the truth. The
mechanism, after the paper's Algorithm 1: every pair of detections in two views makes a hypothesis;
it must reproject well and have a human's limbs. What Algorithm 1 leaves to the scan order is here
decided by evidence: a hypothesis is worth the sum over all views of how well its best detection
there fits, the best is taken first, and its detections leave the game. A ghost has the support of
two views, a person that of all views that see them.

Worked number: six people in eight views make 1008 hypotheses; about 200 pass, each real person
stands in up to 28 of them with a support near 8, the ghosts near 2.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from fusecap.associate.anatomy import Anatomy
from fusecap.associate.views import MIN_COMMON, Views
from fusecap.geometry.triangulation import ROBUST_SCALE_PX
from fusecap.kernels import association as kernels


@dataclass(frozen=True, slots=True, kw_only=True)
class CandidateOptions:
    """What counts as one person seen from several views."""

    max_error_px: float = 0.015 * 1920
    """Mean reprojection error of a pair, in pixels of a 1920-pixel-wide image: the paper's 1.5 % of
    the image width."""
    support_m: float = 0.3
    """Mean distance at which a further view stops supporting a hypothesis: two people's torsos
    cannot come closer, and the paper takes the same distance for the same person."""
    consistency_m: float = 0.2
    """Mean distance of one view's detection to the skeleton of all views beyond which it is left
    out. A detector scatters by 0.03-0.06 m with a few wild keypoints; two people in contact differ
    by 0.25 m and more."""
    robust_scale_px: float = ROBUST_SCALE_PX
    """Where triangulation's Cauchy loss turns, in pixels of a 1920-pixel-wide image."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Candidate:
    """A skeleton, and the detections that make it."""

    person: Int[np.ndarray, " c"]
    """Per camera the row in `Views.rays`, or -1."""
    landmarks_in_world_m: Float[np.ndarray, "k 3"]


def find_candidates(
    views: Views,
    free: np.ndarray,
    anatomy: Anatomy,
    options: CandidateOptions,
) -> list[Candidate]:
    """People among the free detections (n,), best supported first; each detection at most once."""
    pairs = _pairs_of_views(views, free)
    points, error = triangulate_pairs(views, pairs, options.max_error_px)
    good = np.isfinite(error)
    if not good.any():
        return []
    good[good] = anatomy.possible(points[good])
    pairs, points = pairs[good], np.ascontiguousarray(points[good])
    if len(pairs) == 0:
        return []

    distance = views.distances(points, 2 * options.support_m, free)
    support = np.clip(1 - distance / options.support_m, 0, None)
    filled = [c for c in range(len(views.first) - 1) if views.first[c] < views.first[c + 1]]
    starts = [views.first[c] for c in filled]
    alive = np.ones(len(pairs), dtype=bool)
    candidates = []
    while alive.any():
        best_in_view = np.maximum.reduceat(support, starts, axis=1)
        best = int(np.argmax(np.where(alive, best_in_view.sum(axis=1), -1)))
        person = np.full(len(views.first) - 1, -1)
        for place, c in enumerate(filled):
            if best_in_view[best, place] > 0:
                view = slice(views.first[c], views.first[c + 1])
                person[c] = views.first[c] + int(np.argmax(support[best, view]))
        for n in pairs[best]:
            person[views.camera_of[n]] = n
        alive[best] = False
        landmarks = views.triangulate(
            person[None], distance[best : best + 1], options.consistency_m, options.robust_scale_px
        )
        used = person[person >= 0]
        if len(used) < 2 or not anatomy.possible(landmarks)[0]:
            continue
        candidates.append(Candidate(person=person, landmarks_in_world_m=landmarks[0]))
        support[:, used] = 0
        alive &= ~np.isin(pairs, used).any(axis=1)
    return candidates


def triangulate_pairs(
    views: Views, pairs: np.ndarray, max_error_px: float, min_common: int = MIN_COMMON
) -> tuple[np.ndarray, np.ndarray]:
    """Landmarks (h, k, 3) and mean error [px at 1920] (h,), infinite beyond the limit."""
    points = np.empty((len(pairs), *views.rays.shape[1:]))
    error = np.empty(len(pairs))
    kernels.triangulate_pairs(
        views.cameras, views.camera_of, views.rays, pairs, max_error_px, min_common, points, error
    )
    return points, error


def _pairs_of_views(views: Views, free: np.ndarray) -> np.ndarray:
    """All pairs (h, 2) of free detections in two different views."""
    rows = np.flatnonzero(free)
    camera_of = views.camera_of[rows]
    a, b = np.nonzero(np.less.outer(camera_of, camera_of))
    return np.stack([rows[a], rows[b]], axis=1)
