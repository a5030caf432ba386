"""All edits of a take in one call, in a fixed order, written into its provenance."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from fusecap.edits.butterworth import butterworth
from fusecap.edits.foot_lock import lock_feet
from fusecap.edits.gaps import fill_gaps, mark_gaps
from fusecap.errors import InputError
from fusecap.stored_take import StoredTake
from fusecap.take import Take, made_by

SOLVE_REPORT = "report_before_edits"
"""Where an edited take's provenance has the report of its solve: people and frames were others."""


def solve_report(take: Take | StoredTake) -> Mapping[str, Any]:
    """What the solve said of itself, also before edits; nothing where a take does not tell it."""
    report = take.provenance.get("report", take.provenance.get(SOLVE_REPORT))
    return report if isinstance(report, Mapping) else {}


def solve_notes(take: Take | StoredTake) -> list[str]:
    """The notes in it."""
    notes = solve_report(take).get("notes")
    return [str(note) for note in notes] if isinstance(notes, list) else []


@dataclass(frozen=True, slots=True, kw_only=True)
class EditOptions:
    """What is done to a take, from top to bottom; what is not set is not done."""

    only: tuple[str, ...] = ()
    """Subjects that stay."""
    rename: Mapping[str, str] = field(default_factory=dict)
    """New names by old ones."""
    start_s: float | None = None
    """On the take's clock, which begins at 0."""
    end_s: float | None = None
    gaps_above_deg: float | None = None
    """Frames whose bones have a wider mean error bar become gaps."""
    fill_gaps_s: float | None = None
    """Gaps up to this long are bridged."""
    butterworth_hz: float | None = None
    foot_lock: float | None = None
    """0-1."""
    floor_shift_m: float | None = None
    """Added to everybody's height."""


def edit_take(take: Take, options: EditOptions) -> Take:
    """The edited take; what was done stands in `provenance["edits"]`, after earlier edits.

    Raises `TakeError` for names that are not there, `InputError` for values without sense.
    """
    done: list[dict[str, Any]] = []
    if options.only:
        take = take.of_subjects([take.subject(name) for name in dict.fromkeys(options.only)])
        done.append({"edit": "only", "subjects": list(take.subject_names)})
    if options.rename:
        for name in options.rename:
            take.subject(name)
        names = tuple(options.rename.get(name, name) for name in take.subject_names)
        take = replace(take, subject_names=names)
        done.append({"edit": "rename", "names": dict(options.rename)})
    if options.start_s is not None or options.end_s is not None:
        take = _trimmed(take, options.start_s, options.end_s)
        done.append({"edit": "trim", "start_s": options.start_s, "end_s": options.end_s})
    if options.gaps_above_deg is not None:
        _check("gaps above", options.gaps_above_deg, low=0.0, unit="deg")
        take, frames = mark_gaps(take, options.gaps_above_deg)
        done.append({"edit": "mark gaps", "above_deg": options.gaps_above_deg, "frames": frames})
    if options.fill_gaps_s is not None:
        _check("fill gaps", options.fill_gaps_s, low=0.0, unit="s")
        take, frames = fill_gaps(take, options.fill_gaps_s)
        done.append({"edit": "fill gaps", "up_to_s": options.fill_gaps_s, "frames": frames})
    if options.butterworth_hz is not None:
        take, frames = butterworth(take, options.butterworth_hz)
        done.append(
            {
                "edit": "Butterworth, zero lag, fourth order",
                "cutoff_hz": options.butterworth_hz,
                "frames_too_short": frames,
            }
        )
    if options.floor_shift_m is not None:
        _check("floor shift", options.floor_shift_m, low=-10.0, high=10.0, unit="m")
        theta = take.theta + np.eye(1, take.theta.shape[2], 1)[0] * options.floor_shift_m
        take = take.with_theta(theta)
        done.append({"edit": "floor shift", "by_m": options.floor_shift_m})
    if options.foot_lock is not None:
        _check("foot lock", options.foot_lock, low=0.0, high=1.0)
        take, stances = lock_feet(take, options.foot_lock)
        done.append({"edit": "foot lock", "strength": options.foot_lock, "stances": stances})
    if not done:
        raise InputError("no edit was asked for: nothing would change")
    told = dict(take.provenance)
    for entry in done:
        entry["made_by"] = made_by()
    told["edits"] = [*told.get("edits", ()), *done]
    if "report" in told:
        told[SOLVE_REPORT] = told.pop("report")
    return replace(take, provenance=told)


def _trimmed(take: Take, start_s: float | None, end_s: float | None) -> Take:
    time_s = take.time_s
    first_s = 0.0 if start_s is None else start_s
    last_s = np.inf if end_s is None else end_s
    inside = np.flatnonzero((time_s >= first_s - 1e-9) & (time_s <= last_s + 1e-9))
    if not len(inside):
        length_s = time_s[-1] if len(time_s) else 0.0
        raise InputError(
            f"nothing lies between {first_s:g} and {last_s:g} s: the take goes from 0 to "
            f"{length_s:g} s"
        )
    return take.of_frames(int(inside[0]), int(inside[-1]) + 1)


def _check(what: str, value: float, *, low: float, high: float = np.inf, unit: str = "") -> None:
    if not (np.isfinite(value) and low <= value <= high):
        above = f" to {high:g}" if np.isfinite(high) else " or more"
        raise InputError(f"{what}: {value:g} {unit}, expected {low:g}{above} {unit}".rstrip())
