"""Whether each person is as tall as stated, and not as another is.

Limbs of one person measure a stature; whose they are is told by sensors, or by where people stand
as the session begins. People of the same stature differ in their limbs: 3 % in the median over
limbs is a standard deviation of simulated people, detector included, so a tenth is found in two
cases of three. Where two exchange places or statures, each measures as the other should.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations

import numpy as np
from jaxtyping import Float

from fusecap.checks.people import LEAST_PEOPLE, stated_stature_m, stature_m
from fusecap.checks.views import ComparedViews
from fusecap.checks.wearers import Wearer
from fusecap.findings import Findings
from fusecap.sources import view_agreement
from fusecap.sources.session import Session

TOLERANCE = 0.09
"""Of the logarithm of a stature."""
SWAPPED = 0.4
"""Of what two are stated to differ by, the wrong way round."""
LEAST_DIFFERENCE = 0.05
BEGIN_S, STEP_S = 2.0, 0.1
REACH_M = 0.4
"""Between two steps: people run 4 m/s."""


def check_sizes(
    session: Session, views: ComparedViews, wearers: Sequence[Wearer], findings: Findings
) -> None:
    """Of people whose stature is stated, and who can be told from others."""
    if any(finding.where == "calibration" for finding in findings):
        return
    people = _at_their_starts(session, views)
    people |= {wearer.name: own for wearer in wearers if len(own := wearer.people(views)) > 0}
    measured: dict[str, tuple[float, float]] = {}
    for subject in session.subjects:
        stated_m = stated_stature_m(subject)
        if stated_m is not None and len(people.get(subject.name, ())) >= LEAST_PEOPLE:
            seen_m = stature_m(people[subject.name], views.tracks[0].landmarks)
            if np.isfinite(seen_m):
                measured[subject.name] = (seen_m, stated_m)
    exchanged: set[str] = set()
    for one, other in combinations(measured, 2):
        (seen_a, stated_a), (seen_b, stated_b) = measured[one], measured[other]
        stated, seen = np.log(stated_a / stated_b), np.log(seen_a / seen_b)
        if abs(stated) > LEAST_DIFFERENCE and seen * np.sign(stated) < -SWAPPED * abs(stated):
            exchanged |= {one, other}
            findings.add(
                "warning",
                f"subject '{one}'",
                f"limbs measure as of somebody {seen_a:.2f} m tall and those of '{other}' "
                f"{seen_b:.2f} m, the session states {stated_a:.2f} and {stated_b:.2f} m",
                "their height_m, start_m or sensors are exchanged: see who is who",
            )
    for name, (seen_m, stated_m) in measured.items():
        if name not in exchanged and abs(np.log(seen_m / stated_m)) > TOLERANCE:
            findings.add(
                "warning",
                f"subject '{name}'",
                f"limbs measure as of somebody {seen_m:.2f} m tall, the session states "
                f"{stated_m:.2f} m",
                "correct height_m, or let fusecap calibrate shape measure the bones: limbs of "
                "people of one height differ by less",
            )


def _at_their_starts(
    session: Session, views: ComparedViews
) -> dict[str, Float[np.ndarray, "n k 3"]]:
    """Followed from `start_m` for a while, where all say where they start."""
    places = {s.name: np.array(s.start_m) for s in session.subjects if s.start_m is not None}
    if len(places) < len(session.subjects):
        return {}
    found: dict[str, list[np.ndarray]] = {name: [] for name in places}
    times_s = views.times_s[0] + np.arange(0.0, BEGIN_S, STEP_S)
    for everybody in view_agreement.people_in_world(views.rig, views.tracks, times_s):
        at = _middle(everybody)[:, [0, 2]]
        away = np.array([np.linalg.norm(at - place, axis=1) for place in places.values()])
        away = np.where(np.isfinite(away), away, np.inf)
        for index, name in enumerate(places):
            own = (away[index] < REACH_M) & (away.argmin(axis=0) == index)
            if own.any():
                found[name].append(everybody[own])
                places[name] = np.median(at[own], axis=0)
    return {name: np.concatenate(own) for name, own in found.items() if own}


def _middle(people: Float[np.ndarray, "n k 3"]) -> Float[np.ndarray, "n 3"]:
    """Of what is seen of each; NaN of who is not."""
    known = np.all(np.isfinite(people), axis=2)
    total = np.nansum(people, axis=1)
    count = np.sum(known, axis=1)[:, None]
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)
