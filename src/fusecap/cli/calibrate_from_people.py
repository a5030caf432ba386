"""`fusecap calibrate extrinsics --from-people`: cameras refined from the people they see."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import typer

from fusecap.cli.calibrations import (
    check_stated,
    from_folder_of,
    output_of,
    print_use,
    print_verdict,
)
from fusecap.cli.common import check_choice, print_json
from fusecap.cli.terminal import console, progress, table_of, wrote

if TYPE_CHECKING:
    from fusecap.calibrate.cameras.people_report import PeopleCalibration

REFINE = ("focal", "centre", "distortion")


def from_people(
    session: Path,
    *,
    out: Path | None,
    write: bool = False,
    refine: Sequence[str] = (),
    as_json: bool = False,
) -> None:
    """Refine the session's cameras, report, and write them where held-out keypoints agree better.

    Exit code 1, and neither cameras nor session written, where they do not.
    """
    for name in refine:
        check_choice("--refine", name, REFINE)

    from fusecap.calibrate.cameras.people import refine_from_people
    from fusecap.calibrate.pictures import plot_people
    from fusecap.sources.calibration_files.writer import check_rig_path, write_rig
    from fusecap.sources.session_data import open_session
    from fusecap.sources.session_edit import edit_session
    from fusecap.sources.session_file import load_session

    check_stated(out, write)
    if out is not None:
        check_rig_path(out)
    loaded = load_session(session)
    out = output_of(loaded.path, out, write, "refined.toml" if write else "calibration.toml")
    with progress(quiet=as_json) as show:
        data = open_session(loaded, show)
        found = refine_from_people(data, refine=refine, progress=show)
    files: list[Path] = []
    if found.improved:
        files += write_rig(out, found.rig, notes=_origin(found, data.session.settings.name))
        if write:
            values = {"calibration": out.name, "up": "y", "calibration_unit": None}
            edit_session(loaded.path, values)
    picture = out.with_suffix(".png")
    plot_people(found, picture)
    files.append(picture)
    if as_json:
        print_json(_as_json(found, files))
    else:
        _print_report(found)
        wrote(*files)
        if found.improved:
            named = from_folder_of(loaded.path, out)
            by_hand = f'under [session] calibration = "{named}" and up = "y", no calibration_unit'
            print_use(loaded.path, write, by_hand)
    if not found.improved:
        raise typer.Exit(1)


def _origin(found: PeopleCalibration, session: str) -> list[str]:
    return [
        f"refined from the people of '{session}', {found.fit_person_instants} person-instants; "
        f"world y up, metres, floor and origin of the rough calibration",
        f"held-out keypoints, median: {found.before.median_px:.2f} -> "
        f"{found.after.median_px:.2f} px",
    ]


def _as_json(found: PeopleCalibration, files: Sequence[Path]) -> dict[str, object]:
    from dataclasses import asdict, replace

    from fusecap.geometry.camera import Rig

    report = asdict(replace(found, rig=Rig(cameras=()), residuals_px={}))
    del report["rig"], report["residuals_px"]
    return report | {"verdict": found.verdict, "files": [str(path) for path in files]}


def _change(before: float, after: float) -> str:
    return f"{before:.1f} -> {after:.1f}"


def _print_report(found: PeopleCalibration) -> None:

    console.print(
        f"{found.fit_person_instants} person-instants of {found.blocks[0]} blocks adjusted in "
        f"{found.rounds} rounds; {found.check_person_instants} of {found.blocks[1]} other blocks "
        f"({found.block_s:.2g} s each) checked",
        soft_wrap=True,
    )
    table = table_of(
        *("camera", "median px", "90 % px", "skeleton px", "moved mm, deg", "known mm, deg"),
        box=None,
        padding=(0, 2, 0, 0),
    )
    for column in table.columns[1:]:
        column.justify = "right"
    for c in found.cameras:
        table.add_row(
            c.name,
            _change(c.before.median_px, c.after.median_px),
            _change(c.before.p90_px, c.after.p90_px),
            _change(c.skeleton_before_px, c.skeleton_after_px),
            f"{c.moved_mm:.0f}, {c.turned_deg:.2f}",
            f"{c.repeat_mm:.0f}, {c.repeat_deg:.2f}",
        )
    console.print(table)
    console.print(
        "  before -> after on held-out keypoints, and from the solved skeleton; known to: scatter "
        "over resampled blocks",
        soft_wrap=True,
    )
    refined = f"poses and {', '.join(found.refined)}" if found.refined else "poses"
    feet = f"feet {1e3 * found.feet_m:+.0f} mm from the floor"
    console.print(
        f"  {refined}; scale {found.scale:.4f}, from {found.scale_from}; people were seen over "
        f"{found.walked_m[0]:.1f} x {found.walked_m[1]:.1f} m of floor; "
        f"{feet if found.feet_m == found.feet_m else 'the keypoints have no heels or toes'}",
        soft_wrap=True,
    )
    if found.refined:
        console.print(
            "  focal lengths "
            + ", ".join(f"{c.name} {100 * (c.focal_share - 1):+.1f} %" for c in found.cameras),
            soft_wrap=True,
        )
    console.print(
        f"  {'better than before' if found.improved else 'not better: keep the old calibration'}; "
        f"all cameras, held out: median {found.before.median_px:.1f} -> "
        f"{found.after.median_px:.1f} px, 90 % {found.before.p90_px:.1f} -> "
        f"{found.after.p90_px:.1f} px",
        soft_wrap=True,
    )
    print_verdict("calibration", found.verdict, found.notes)
