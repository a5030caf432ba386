"""A recorded session to a take: sort, then solve.

The first pass (`sorting`) finds who is who, a pose for everybody at every instant, and the bodies
of people nobody measured. The second (`second_pass`) goes on from these with one body throughout,
from the instant somebody was first seen rather than the one they were confirmed at, in a window so
long that its poses are those of the whole take.

Interrupted (Ctrl-C), either pass ends at the instant it had reached and the take holds what was
solved.
"""

from __future__ import annotations

import time
from array import array
from collections import Counter
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from fusecap.batch.assignments import Assignments
from fusecap.batch.second_pass import Instant, SecondPass
from fusecap.batch.sorting import Instants, sort_instants
from fusecap.checks import check_measurements
from fusecap.errors import SessionError
from fusecap.files import plain
from fusecap.findings import Finding
from fusecap.progress import Progress
from fusecap.setup import Setup, setup_of
from fusecap.solve.reprojection import Reprojection
from fusecap.sources.session_data import SessionData
from fusecap.take import Take, TakeBuilder, provenance
from fusecap.types import Detections, ImuReading


class SessionInstants:
    """The instants `first` to `end` (excluded) of an opened session; all of them unless told."""

    def __init__(self, data: SessionData, first: int = 0, end: int | None = None) -> None:
        self._data = data
        self._instants = range(len(data.times_s))[first:end]

    def __len__(self) -> int:
        return len(self._instants)

    def detections(self, instant: int) -> Detections:
        """Everyone in every camera."""
        return self._data.detections(self._instants[instant])

    def readings(self, instant: int) -> Mapping[str, ImuReading]:
        """By subject name, what its sensors say."""
        row = self._instants[instant]
        return {imus.subject: imus.reading(row) for imus in self._data.imus}


SMALL_M = 0.75
"""Simulated, of 0.6 m: followed 71 % of the time, measured 4.3 % off."""


@dataclass(frozen=True, kw_only=True)
class SolveReport:
    """What a solve can say about itself; `as_json` is the `--json` output."""

    instants: int
    duration_s: float
    cameras: int
    subjects: dict[str, dict[str, float]]
    """Per subject: tracked_share (of all instants), bone_sigma_deg, position_sigma_m, height_m."""
    reprojection_px: dict[str, dict[str, float]]
    """Per camera, in its own pixels: median, p90, and how many keypoints were used."""
    solve_ms_median: float
    solve_ms_p99: float
    solves: int
    statuses: dict[str, int]
    elapsed_s: float
    interrupted: bool
    notes: tuple[str, ...] = ()

    def as_json(self) -> dict[str, Any]:
        """Plain values; NaN becomes None."""
        return plain(asdict(self))


@dataclass(frozen=True, kw_only=True)
class Solved:
    """A take and how it came about."""

    take: Take
    report: SolveReport


def solve_session(
    data: SessionData, *, progress: Progress | None = None, anyway: bool = False
) -> Solved:
    """Solve an opened session; what is odd about it is in the report's notes.

    Raises `SessionError` for what is an error to doctor, unless `anyway`.
    """
    found = check_measurements(data.session, data.rig, data.keypoints, data.samples, data.times_s)
    if not anyway:
        refuse_errors(data.session.path, [*data.findings, *found])
    odd = [f for f in (*data.findings, *found.sorted()) if f.severity != "info"]
    return solve_instants(
        setup_of(data.session, data.rig, data.landmarks),
        SessionInstants(data),
        progress=progress,
        session_sha256=data.content_hash,
        notes=tuple(map(str, odd)),
    )


def refuse_errors(path: Path, findings: Sequence[Finding]) -> None:
    """Raises `SessionError` with what is an error of a session or a recording, if anything is."""
    errors = [finding for finding in findings if finding.severity == "error"]
    if errors:
        listed = "\n".join(f"{path}: {finding}" for finding in errors)
        raise SessionError(f"{listed}\nto solve it all the same: fusecap solve --anyway")


def solve_instants(
    setup: Setup,
    instants: Instants,
    *,
    progress: Progress | None = None,
    session_sha256: str | None = None,
    simulated: bool = False,
    notes: tuple[str, ...] = (),
) -> Solved:
    """Both passes over recorded instants."""
    assigned = Assignments(
        cameras=len(setup.rig),
        landmarks=len(setup.landmarks.landmark_names),
        pose_size=setup.skeleton.pose_size,
    )
    with closing(assigned):
        return _both_passes(
            setup, instants, assigned, progress, session_sha256, simulated=simulated, notes=notes
        )


def _both_passes(
    setup: Setup,
    instants: Instants,
    assigned: Assignments,
    progress: Progress | None,
    session_sha256: str | None,
    *,
    simulated: bool,
    notes: tuple[str, ...],
) -> Solved:
    started = time.perf_counter()
    tracked = sort_instants(setup, instants, assigned, progress)
    reprojection = Reprojection(setup.rig, setup.landmarks)
    builder = TakeBuilder(
        skeleton=setup.skeleton,
        rate_hz=setup.rate_hz,
        subject_names=_in_order([model.name for model in setup.subjects], tracked.shapes),
        provenance=provenance(
            options={"solver": asdict(setup.options), "cameras": list(setup.rig.names)},
            session_sha256=session_sha256,
            simulated=simulated,
        ),
    )
    second = SecondPass(setup, tracked.shapes)
    solve_s, statuses = array("d"), Counter()
    interrupted = tracked.interrupted

    def keep(finished: Iterator[Instant]) -> None:
        for instant in finished:
            people = instant.people.values()
            builder.add(instant.timestamp_ns, [estimate for estimate, _ in people])
            for estimate, observation in people:
                reprojection.add(estimate, observation.keypoints)

    try:
        for instant in range(len(assigned)):
            detections, readings = instants.detections(instant), instants.readings(instant)
            second.begin(tracked.begun.get(instant, ()))
            for seed in second.step(detections, readings, assigned[instant]):
                solve_s.append(seed.solve_s)
                statuses[seed.status.name.lower()] += 1
            keep(second.finished())
            if progress:
                progress("solving", instant + 1, len(assigned))
    except KeyboardInterrupt:
        interrupted = True
    keep(second.rest())
    take = builder.build()
    solve_ms = np.array(solve_s or [np.nan]) * 1e3
    return Solved(
        take=take,
        report=SolveReport(
            instants=len(take.timestamps_ns),
            duration_s=len(take.timestamps_ns) / setup.rate_hz,
            cameras=len(setup.rig),
            subjects=describe_subjects(take),
            reprojection_px=reprojection.summary(),
            solve_ms_median=float(np.median(solve_ms)),
            solve_ms_p99=float(np.percentile(solve_ms, 99)),
            solves=len(solve_s),
            statuses=dict(statuses),
            elapsed_s=time.perf_counter() - started,
            interrupted=interrupted,
            notes=(*notes, *tracked.notes, *_small_people(take)),
        ),
    )


def _small_people(take: Take) -> list[str]:
    return [
        f"{name}: {height_m:.2f} m tall; people under {SMALL_M} m are followed with gaps and "
        "measured up to 5 % off: state height_m, or check the calibration's scale"
        for name, height_m in zip(take.subject_names, take.heights_m, strict=True)
        if height_m < SMALL_M
    ]


def _in_order(named: list[str], found: Collection[str]) -> list[str]:
    """Named subjects as the session lists them, then person1, person2, ... person10."""
    return named + sorted(set(found) - set(named), key=lambda name: (len(name), name))


def describe_subjects(take: Take) -> dict[str, dict[str, float]]:
    """As `SolveReport.subjects`."""
    return {name: _describe(take, s) for s, name in enumerate(take.subject_names)}


def _describe(take: Take, subject: int) -> dict[str, float]:
    tracked = take.tracked[subject]
    turn, place = take.bone_sigma_deg[subject, tracked], take.position_sigma_m[subject, tracked]
    return {
        "tracked_share": float(tracked.mean()) if tracked.size else 0.0,
        "bone_sigma_deg": float(np.median(turn)) if turn.size else float("nan"),
        "position_sigma_m": float(np.median(place)) if place.size else float("nan"),
        "height_m": float(take.heights_m[subject]),
    }
