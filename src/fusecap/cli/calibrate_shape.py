"""`fusecap calibrate shape`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from fusecap.calibrate.verdict import Verdict
from fusecap.cli.calibrations import Write, check_stated, output_of, print_use, print_verdict
from fusecap.cli.common import Json, SessionPath, print_json
from fusecap.cli.terminal import console, progress, table_of, wrote

if TYPE_CHECKING:
    from fusecap.calibrate.shape import MeasuredBody, ShapeCalibration

EXAMPLE = "Example: fusecap calibrate shape recordings/rom --subject anna --write"
_LIMBS = tuple(
    f"{side}_{bone}" for side in ("left", "right") for bone in ("forearm", "hand", "shank", "foot")
)
"""Named after the bones at the far end of upper arm, forearm, thigh and shank."""


def shape(
    session: SessionPath,
    subject: Annotated[str | None, typer.Option(help="Only this person.")] = None,
    out: Annotated[
        Path | None,
        typer.Option(
            help="Subject tables to write, shape.toml; a plot goes beside, as .png.",
            show_default=False,
        ),
    ] = None,
    write: Write = False,
    as_json: Json = False,
) -> None:
    """Bone lengths from a recording in which every joint bends, with their uncertainty.

    Measures on the first three quarters of the session and checks the result on the rest. With
    --write a poor result leaves session.toml as it is, exit code 1.
    """
    from dataclasses import asdict

    from fusecap.batch.solve import SessionInstants
    from fusecap.calibrate.pictures import plot_bodies
    from fusecap.calibrate.shape import calibrate_shape, shape_toml, subject_keys
    from fusecap.files import write_whole
    from fusecap.setup import setup_of
    from fusecap.sources.session_data import open_session
    from fusecap.sources.session_edit import edit_session
    from fusecap.sources.session_file import load_session

    check_stated(out, write)
    loaded = load_session(session)
    out = output_of(loaded.path, out, write, "shape.toml")
    with progress(quiet=as_json) as show:
        data = open_session(loaded, show)
        found = calibrate_shape(
            setup_of(data.session, data.rig, data.landmarks),
            lambda first, end: SessionInstants(data, first, end),
            len(data.times_s),
            heights_m={s.name: s.height_m for s in data.session.subjects if s.height_m},
            subject=subject,
            progress=show,
        )
    origin = f"measured in '{data.session.settings.name}'"
    write_whole(out, shape_toml(found.bodies, origin=origin))
    picture = out.with_suffix(".png")
    plot_bodies(found.bodies, picture)
    problems = _problems(found)
    if write and not loaded.subjects and len(found.bodies) > 1:
        problems.append(
            f"{len(found.bodies)} people and no [[subject]] to tell them by; add one for each, "
            "with name and start_m, and run again"
        )
    verdict = Verdict.POOR if problems else Verdict.GOOD
    used = write and not problems
    if used:
        edit_session(loaded.path, subjects={body.name: subject_keys(body) for body in found.bodies})
    if as_json:
        bodies = [
            {key: value for key, value in vars(body).items() if key not in ("shape", "bones")}
            | {"bones": [asdict(bone) for bone in body.bones]}
            for body in found.bodies
        ]
        print_json(
            {
                "bodies": bodies,
                "held_out_before_px": asdict(found.held_out_before_px),
                "held_out_after_px": asdict(found.held_out_after_px),
                "verdict": verdict,
                "problems": problems,
                "files": [str(out), str(picture)],
            }
        )
    else:
        _print_report(found, verdict, problems)
        wrote(out, picture)
        if write and problems:
            console.print(f"{loaded.path} stays as it is", soft_wrap=True)
        else:
            by_hand = "copy height_m and bone_lengths_m into the session's [[subject]]"
            print_use(loaded.path, used, by_hand)
    if write and problems:
        raise typer.Exit(1)


def _print_report(found: ShapeCalibration, verdict: Verdict, problems: list[str]) -> None:
    for body in found.bodies:
        _print_body(body)
    before, after = found.held_out_before_px, found.held_out_after_px
    console.print(
        f"held-out instants: reprojection {before.median:.2f} -> {after.median:.2f} px median, "
        f"{before.mean:.2f} -> {after.mean:.2f} px mean, {after.count} keypoints",
        soft_wrap=True,
    )
    print_verdict("bodies", verdict, problems)


def _problems(found: ShapeCalibration) -> list[str]:
    problems = []
    for body in found.bodies:
        untold = [name for name in _LIMBS if name not in body.lengths_m]
        if untold:
            problems.append(
                f"{body.name}: {', '.join(untold)} follow the stature; bend the joints on both "
                "ends of these bones in view of two cameras or more"
            )
        odd = [
            bone.bone.removeprefix("left_")
            for bone in body.bones
            if bone.asymmetry_m is not None
            and bone.asymmetry_sigma_m is not None
            and abs(bone.asymmetry_m) > 3 * bone.asymmetry_sigma_m
        ]
        if odd:
            problems.append(
                f"{body.name}: left and right differ beyond their uncertainty ({', '.join(odd)}); "
                "look for left taken for right, or a camera that is calibrated loosely"
            )
    if not found.held_out_after_px.median <= 1.02 * found.held_out_before_px.median:
        problems.append(
            "the held-out instants are not explained as well as before; the landmarks' offsets "
            "may not be this detector's: run fusecap calibrate offsets first"
        )
    return problems


def _print_body(body: MeasuredBody) -> None:

    how = "stated" if body.height_stated else f"+- {1e3 * body.height_sigma_m:.0f} mm"
    console.print(
        f"{body.name}: stature {body.height_m:.3f} m ({how}), {body.instants} instants",
    )
    table = table_of("bone", "length mm", "+-", "by stature mm", "left - right mm", "told by")
    for column in table.columns[1:5]:
        column.justify = "right"
    for bone in body.bones:
        difference = ""
        if bone.asymmetry_m is not None and bone.asymmetry_sigma_m is not None:
            difference = f"{1e3 * bone.asymmetry_m:.1f} +- {1e3 * bone.asymmetry_sigma_m:.1f}"
        table.add_row(
            bone.bone,
            f"{1e3 * bone.length_m:.1f}",
            f"{1e3 * bone.sigma_m:.1f}",
            f"{1e3 * bone.from_height_m:.1f}",
            difference,
            "data" if bone.told else "stature",
        )
    console.print(table)
    console.print(
        "  length: from the joint before to the bone's own; left_shank is the left thigh's",
        soft_wrap=True,
    )
