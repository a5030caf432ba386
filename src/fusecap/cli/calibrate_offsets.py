"""`fusecap calibrate offsets`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from fusecap.cli.calibrations import print_verdict
from fusecap.cli.common import Json, SessionPath, print_json
from fusecap.cli.terminal import console, progress, table_of

if TYPE_CHECKING:
    from fusecap.calibrate.offsets import OffsetCalibration

EXAMPLE = "Example: fusecap calibrate offsets recordings/duo --out recordings/duo/offsets.toml"


def offsets(
    session: SessionPath,
    truth: Annotated[
        Path | None,
        typer.Option(help="A take with the true poses; without, the session's own solves serve."),
    ] = None,
    out: Annotated[Path, typer.Option(help="The offsets to write.")] = Path("offsets.toml"),
    per_subject: Annotated[
        bool, typer.Option("--per-subject", help="Also a table for each subject.")
    ] = False,
    as_json: Json = False,
) -> None:
    """Where the detector's keypoints lie on the body; a session uses it as landmark_offsets.

    Calibrates on the first three quarters of the session and checks the result on the rest.
    """
    from dataclasses import asdict

    from fusecap.calibrate.offsets import calibrate_session, origin
    from fusecap.files import check_writable, write_whole
    from fusecap.sources.offset_files import offsets_toml
    from fusecap.sources.session_data import open_session
    from fusecap.sources.session_file import load_session
    from fusecap.stored_take import load_take

    check_writable(out)
    take = load_take(truth) if truth else None
    with progress(quiet=as_json) as show:
        data = open_session(load_session(session), show)
        found = calibrate_session(data, take, per_subject=per_subject, progress=show)
    write_whole(out, offsets_toml(found.landmarks, origin=origin(found, truth)))
    if as_json:
        report = asdict(found) | {
            "landmarks": found.landmarks.name,
            "verdict": found.verdict,
            "advice": found.advice,
            "file": str(out),
        }
        print_json(report)
        return
    _print_report(found)
    console.print(f"wrote {out}; use it: landmark_offsets under [session]", soft_wrap=True)


def _print_report(found: OffsetCalibration) -> None:

    how = "the truth's poses" if found.with_truth else f"{len(found.step_mm)} rounds of solves"
    console.print(f"{found.person_frames} person-frames, {how}")
    table = table_of("landmark", "x, y, z on its bone mm", "moved", "spread", "samples")
    for column in table.columns:
        column.no_wrap = True
    for column in table.columns[1:]:
        column.justify = "right"
    for row in found.rows:
        table.add_row(
            row.landmark,
            " ".join(f"{value:6.1f}" for value in row.offset_mm),
            f"{row.moved_mm:.1f}",
            f"{max(row.mad_mm):.1f}",
            str(row.samples),
        )
    console.print(table)
    before, after = found.held_out_before_px, found.held_out_after_px
    console.print(
        f"  held-out instants  reprojection {before.median:.2f} -> {after.median:.2f} px median, "
        f"{before.mean:.2f} -> {after.mean:.2f} px mean, {after.count} keypoints",
        soft_wrap=True,
    )
    print_verdict("offsets", found.verdict, found.advice)
