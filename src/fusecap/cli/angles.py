"""`fusecap angles`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from fusecap.cli.common import Json, print_json
from fusecap.cli.many import (
    Again,
    OnRay,
    Workers,
    are_newer,
    is_pattern,
    is_take_file,
    matching,
    refuse_out,
    run_many,
)
from fusecap.cli.terminal import console, note, table_of, wrote
from fusecap.errors import InputError, TakeError

EXAMPLE = "Example: fusecap angles duo/duo.npz --out duo/angles.csv --mot --plot --gait"


def angles(
    take: Annotated[
        list[Path],
        typer.Argument(
            help="A solved take (.npz), or the recording (.mcap) of a live run; several, or a "
            "pattern in quotes.",
            show_default=False,
        ),
    ],
    out: Annotated[
        Path | None, typer.Option(help="The table to write; default <take>_angles.csv.")
    ] = None,
    mot: Annotated[bool, typer.Option("--mot", help="Also one MOT a person, for OpenSim.")] = False,
    plot: Annotated[
        bool, typer.Option("--plot", help="Also one picture per person, with bands of one sd.")
    ] = False,
    gait: Annotated[
        bool,
        typer.Option(
            "--gait",
            help="Also the legs from foot strike to foot strike: mean and band.",
        ),
    ] = False,
    workers: Workers = None,
    ray: OnRay = None,
    again: Again = False,
    as_json: Json = False,
) -> None:
    """Joint angles by ISB conventions, in degrees, each with one standard deviation.

    Hips, knees, ankles, shoulders, elbows, wrists, trunk and neck; docs/angles.md says about which
    axes, and what is positive.
    """
    if not is_pattern(take):
        _angles_of(take[0], out, mot=mot, plot=plot, gait=gait, as_json=as_json)
        return
    refuse_out(out)
    run_many(
        "angles",
        matching(take, wanted=is_take_file, what="take or recording"),
        {"mot": mot, "plot": plot, "gait": gait},
        columns=("people", "files"),
        row=lambda result: [str(len(result["people"])), str(len(result["files"]))],
        workers=workers,
        ray=ray,
        again=again,
        as_json=as_json,
    )


def already(path: Path, *, mot: bool, plot: bool, gait: bool) -> dict[str, Any] | None:
    """What was made of a take before; None where some of it is missing, or older."""
    from fusecap.files import distinct_names
    from fusecap.stored_take import StoredTake

    if path.suffix != ".npz":
        return None
    target = _target(path)
    files = [target, *([target.with_name(f"{target.stem}_gait.csv")] if gait else [])]
    with StoredTake(path) as stored:
        people = np.flatnonzero(stored.tracked.any(axis=1)).tolist()
        names = distinct_names(stored.subject_names)
    endings = [ending for ending, asked in ((".mot", mot), (".png", plot)) if asked]
    files += [target.with_name(f"{target.stem}_{names[row]}{e}") for row in people for e in endings]
    if not are_newer(files, [path]):
        return None
    return {"people": [names[row] for row in people], "files": [str(file) for file in files]}


def _target(take: Path) -> Path:
    from fusecap.exports.made_files import made_stem

    return take.with_name(f"{made_stem(take)}_angles.csv")


def _angles_of(
    take: Path, out: Path | None, *, mot: bool, plot: bool, gait: bool, as_json: bool
) -> None:
    from fusecap.angles.gait import gait_cycles
    from fusecap.angles.joint_angles import joint_angles
    from fusecap.batch.replay import opened_take
    from fusecap.checks.keypoints import UNMEASURED
    from fusecap.edits.edit import solve_notes
    from fusecap.exports import angle_files
    from fusecap.exports.made_files import list_made
    from fusecap.files import distinct_names

    target = out or _target(take)
    if target.suffix != ".csv":
        raise InputError(f"--out {target}: the table of angles is a .csv file")
    with opened_take(take, note) as opened:
        people = np.flatnonzero(opened.tracked.any(axis=1)).tolist()
        if not people:
            raise TakeError(
                f"{take}: nobody is tracked in any frame of the take: there are no angles"
            )
        found = joint_angles(opened)
        unmeasured = [text for text in solve_notes(opened) if UNMEASURED in text]
        walks = {}
        if gait:
            whole = opened.of_frames(0, len(opened.timestamps_ns))
            walks = {
                row: [gait_cycles(whole, found, row, side) for side in ("left", "right")]
                for row in people
            }
    angle_files.write_angles_csv(found, target)
    files = [target]
    names = distinct_names(found.subject_names)

    def beside(row: int, ending: str) -> Path:
        files.append(target.with_name(f"{target.stem}_{names[row]}{ending}"))
        return files[-1]

    if mot:
        for row in people:
            angle_files.write_angles_mot(found, row, beside(row, ".mot"))
    if plot:
        from fusecap.exports.angle_plot import plot_angles

        for row in people:
            plot_angles(found, row, beside(row, ".png"))
    cycles: dict[str, dict[str, int]] = {}
    if gait:
        from fusecap.exports.angle_plot import plot_gait

        files.append(target.with_name(f"{target.stem}_gait.csv"))
        angle_files.write_gait_csv(
            [(found.subject_names[row], each) for row, sides in walks.items() for each in sides],
            files[-1],
        )
        for row, sides in walks.items():
            name = found.subject_names[row]
            cycles[name] = {each.side: len(each.deg) for each in sides}
            if any(cycles[name].values()):
                plot_gait(sides, beside(row, "_gait.png"))
            for each in sides:
                if not len(each.deg):
                    note(f"'{name}' has no gait cycle of the {each.side} foot: {each.why_none}")
    list_made(take, files)
    for text in unmeasured:
        note(text)
    summary = {
        found.subject_names[row]: _summary(found.names, found.deg[row], found.sd_deg[row])
        for row in people
    }
    if as_json:
        result: dict[str, Any] = {
            "files": [str(path) for path in files],
            "people": summary,
            "notes": unmeasured,
        }
        print_json(result | ({"gait_cycles": cycles} if gait else {}))
        return
    for name, rows in summary.items():
        table = table_of("angle [deg]", "min", "median", "max", "sd", title=name)
        for angle, row in rows.items():
            table.add_row(angle, *(f"{row[key]:.1f}" for key in ("min", "median", "max", "sd")))
        console.print(table)
    wrote(*files)


def _summary(names: tuple[str, ...], deg: np.ndarray, sd_deg: np.ndarray) -> dict[str, Any]:
    """Per angle its least, median and largest value and its median standard deviation [deg]."""
    seen = np.isfinite(deg).all(axis=1)
    return {
        name: {
            "min": float(curve.min()),
            "median": float(np.median(curve)),
            "max": float(curve.max()),
            "sd": float(np.median(sd)),
        }
        for name, curve, sd in zip(names, deg[seen].T, sd_deg[seen].T, strict=True)
    }
