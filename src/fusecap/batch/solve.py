"""A recorded session to a take: sort, then solve.

The first pass (`sorting`) finds who is who, a pose for everybody at every instant, and the bodies
of people nobody measured. The second (`second_pass`) goes on from these with one body throughout,
from the instant somebody was first seen rather than the one they were confirmed at, in a window so
long that its poses are those of the whole take.

Interrupted (Ctrl-C), either pass ends at the instant it had reached and the take holds what was
solved; what is sorted is solved all the same. A second Ctrl-C ends both at once.
"""

from __future__ import annotations

import time
from array import array
from collections import Counter
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from fusecap.batch.assignments import Assignments
from fusecap.batch.second_pass import Instant, SecondPass
from fusecap.batch.sorting import Instants, sort_instants
from fusecap.body.shape import REFERENCE_HEIGHT_M
from fusecap.checks import check_measurements
from fusecap.errors import SessionError
from fusecap.files import plain
from fusecap.findings import Finding
from fusecap.interrupts import ctrl_c_held
from fusecap.progress import Progress
from fusecap.setup import Setup, setup_of
from fusecap.solve.quantiles import Quantiles
from fusecap.solve.reprojection import Reprojection
from fusecap.sources.session_data import SessionData
from fusecap.take import Take, provenance
from fusecap.take_builder import TakeBuilder
from fusecap.types import Detections, Estimate, ImuReading, Status


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
    """Per subject: tracked_share and measured_share (of all instants), bone_sigma_deg,
    position_sigma_m, height_m, and found_anew: how often a pose that did not fit was replaced."""
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
    """A take, with a report in its provenance, and how it came about."""

    builder: TakeBuilder
    report: SolveReport

    @cached_property
    def take(self) -> Take:
        """All of it in memory, which `save` does not need."""
        return self.builder.build(self._provenance)

    @property
    def whole_take(self) -> Take:
        """The take, for whom a part of it will not do; Ctrl-C that cut it off is raised here."""
        if self.report.interrupted:
            raise KeyboardInterrupt
        return self.take

    @property
    def is_empty(self) -> bool:
        """Nobody was followed."""
        return not any(told["tracked_share"] for told in self.report.subjects.values())

    def save(self, path: Path) -> None:
        """The take as a file; raises `TakeError`."""
        self.builder.save(path, self._provenance)

    @property
    def _provenance(self) -> dict[str, Any]:
        return {**self.builder.provenance, "report": self.report.as_json()}


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
    recording: str | None = None,
    simulated: bool = False,
    notes: tuple[str, ...] = (),
) -> Solved:
    """Both passes over recorded instants."""
    started = time.perf_counter()
    assigned = Assignments(
        cameras=len(setup.rig),
        landmarks=len(setup.landmarks.landmark_names),
        pose_size=setup.skeleton.pose_size,
    )
    reprojection = Reprojection(setup.rig, setup.landmarks)
    solve_s, statuses = array("d"), Counter()
    with ctrl_c_held() as stop:
        tracked = sort_instants(setup, instants, assigned, progress, stop)
        interrupted = len(assigned) < len(instants)
        names = _in_order([model.name for model in setup.subjects], tracked.shapes)
        subjects = SubjectSums(names)
        builder = TakeBuilder(
            skeleton=setup.skeleton,
            rate_hz=setup.rate_hz,
            subject_names=names,
            provenance=provenance(
                options={"solver": asdict(setup.options), "cameras": list(setup.rig.names)},
                session_sha256=session_sha256,
                recording=recording,
                simulated=simulated,
            ),
        )

        def keep(finished: Iterator[Instant]) -> None:
            for instant in finished:
                people = instant.people.values()
                builder.add(instant.timestamp_ns, [estimate for estimate, _ in people])
                for estimate, observation in people:
                    subjects.add(estimate)
                    reprojection.add(estimate, observation.keypoints)

        second = SecondPass(setup, tracked.shapes)
        answered = stop.asked
        what = "solving what is sorted" if answered else "solving"
        for instant in range(len(assigned)):
            if stop.asked and not answered:
                interrupted = True
                break
            detections, readings = instants.detections(instant), instants.readings(instant)
            second.begin(tracked.begun.get(instant, ()))
            for seed in second.step(detections, readings, assigned[instant]):
                solve_s.append(seed.solve_s)
                statuses[seed.status.name.lower()] += 1
            keep(second.finished())
            if progress:
                progress(what, instant + 1, len(assigned))
        keep(second.rest())
    solve_ms = np.array(solve_s or [np.nan]) * 1e3
    return Solved(
        builder=builder,
        report=SolveReport(
            instants=len(builder),
            duration_s=len(builder) / setup.rate_hz,
            cameras=len(setup.rig),
            subjects=subjects.as_report(len(builder), tracked.found_anew),
            reprojection_px=reprojection.summary(),
            solve_ms_median=float(np.median(solve_ms)),
            solve_ms_p99=float(np.percentile(solve_ms, 99)),
            solves=len(solve_s),
            statuses=dict(statuses),
            elapsed_s=time.perf_counter() - started,
            interrupted=interrupted,
            notes=(
                *notes,
                *tracked.notes,
                *([] if interrupted else _never_found(subjects.never_found)),
                *_small_people(subjects.heights_m),
            ),
        ),
    )


def _never_found(names: Sequence[str]) -> list[str]:
    return [
        f"{name}: never found; nobody was where start_m says, or moved as the sensors say: see "
        "whether they are of this calibration's world"
        for name in names
    ]


def _small_people(heights_m: Mapping[str, float]) -> list[str]:
    return [
        f"{name}: {height_m:.2f} m tall; people under {SMALL_M} m are followed with gaps and "
        "measured up to 5 % off: state height_m, or check the calibration's scale"
        for name, height_m in heights_m.items()
        if height_m < SMALL_M
    ]


def _in_order(named: list[str], found: Collection[str]) -> list[str]:
    """Named subjects as the session lists them, then person1, person2, ... person10."""
    return named + sorted(set(found) - set(named), key=lambda name: (len(name), name))


class SubjectSums:
    """What a report says of everybody, while their poses come."""

    def __init__(self, names: Sequence[str]) -> None:
        self._people = {name: _Sums() for name in names}

    def add(self, estimate: Estimate) -> None:
        """The next pose of somebody."""
        sums = self._people.setdefault(estimate.name, _Sums())
        sums.height_m = estimate.shape.height_m
        if estimate.status is not Status.DIVERGED:
            sums.tracked += 1
            sums.measured += estimate.measured
            sums.turn_deg.add(estimate.bone_sigma_deg)
            sums.place_m.add(estimate.position_sigma_m)

    @property
    def never_found(self) -> list[str]:
        """Who has no pose."""
        return [name for name, sums in self._people.items() if not sums.tracked]

    @property
    def heights_m(self) -> dict[str, float]:
        """Statures."""
        return {name: sums.height_m for name, sums in self._people.items()}

    def as_report(
        self, instants: int, found_anew: Mapping[str, int]
    ) -> dict[str, dict[str, float]]:
        """As `SolveReport.subjects`."""
        return {
            name: {
                "tracked_share": sums.tracked / max(instants, 1),
                "measured_share": sums.measured / max(instants, 1),
                "bone_sigma_deg": sums.turn_deg.at(0.5),
                "position_sigma_m": sums.place_m.at(0.5),
                "height_m": sums.height_m,
                "found_anew": found_anew.get(name, 0),
            }
            for name, sums in self._people.items()
        }


class _Sums:
    def __init__(self) -> None:
        self.height_m = REFERENCE_HEIGHT_M
        self.tracked = self.measured = 0
        self.turn_deg, self.place_m = Quantiles(), Quantiles()
