"""`fusecap calibrate intrinsics`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from fusecap.cli.calibrations import (
    named_sources,
    print_verdict,
    write_report,
)
from fusecap.cli.common import Json, check_choice, print_json
from fusecap.cli.terminal import console, err, progress, table_of, wrote

if TYPE_CHECKING:
    from fusecap.calibrate.cameras.intrinsics import Intrinsics

EXAMPLE = (
    "Example: fusecap calibrate intrinsics left=videos/left.mp4 right=images/right "
    "--board board.toml --out intrinsics.toml"
)

Sources = Annotated[
    list[str],
    typer.Argument(
        help="CAMERA=SOURCE: a video, a folder of images or a quoted pattern; repeat it.",
        show_default=False,
    ),
]
BoardFile = Annotated[
    Path,
    typer.Option("--board", help="board.toml: kind, columns, rows, square_m.", show_default=False),
]
Every = Annotated[
    int | None,
    typer.Option(help="Search the board in every n-th frame; default: 240 frames of a video."),
]


def intrinsics(
    sources: Sources,
    board: BoardFile,
    out: Annotated[Path, typer.Option(help="The calibration to write, .toml.")] = Path(
        "intrinsics.toml"
    ),
    every: Every = None,
    model: Annotated[
        str | None,
        typer.Option(
            help="Distortion: none, k1, 'k1 k2' or 'k1 k2 p1 p2 k3'; default: what held-out images "
            "support."
        ),
    ] = None,
    seed: Annotated[int, typer.Option(help="Of the resampled images.")] = 0,
    as_json: Json = False,
) -> None:
    """Focal length, centre and distortion of each camera, from images of a board.

    Writes the calibration, a report (.json) and a picture of what the board covered (.png).
    """
    from fusecap.calibrate.cameras.board import read_board
    from fusecap.calibrate.cameras.board_views import read_shots
    from fusecap.calibrate.cameras.intrinsics import MODELS, calibrate_intrinsics
    from fusecap.calibrate.pictures import plot_lenses
    from fusecap.geometry.camera import Rig
    from fusecap.sources.calibration_files.writer import check_rig_path, write_rig

    named = named_sources(sources)
    if model is not None:
        check_choice("--model", model, tuple(MODELS))
    check_rig_path(out)
    target = read_board(board)
    with progress(quiet=as_json) as show:
        found = [
            read_shots(name, source, target, every=every, progress=show)
            for name, source in named.items()
        ]
        lenses = [
            calibrate_intrinsics(shots, target, model=model, seed=seed, progress=show)
            for shots in found
        ]
    notes = [
        f"{lens.camera.name}: {lens.verdict}, {lens.held_out_px:.2f} px held out" for lens in lenses
    ]
    files = write_rig(
        out,
        Rig(cameras=tuple(lens.camera for lens in lenses)),
        notes=["Intrinsics alone; all cameras stand at the origin.", *notes],
    )
    picture = out.with_suffix(".png")
    plot_lenses(lenses, found, picture)
    report = {"cameras": [lens_report(lens) for lens in lenses], "board": target.words}
    files += [picture, write_report(out, report)]
    if as_json:
        print_json(report | {"files": [str(file) for file in files]})
        return
    _print(lenses)
    wrote(*files)


def lens_report(lens: Intrinsics) -> dict[str, Any]:
    """What `--json` and the report file say of one camera."""
    from dataclasses import asdict

    matrix = lens.camera.matrix
    report = {
        "name": lens.camera.name,
        "size_px": list(lens.camera.size_px),
        "focal_px": [matrix[0, 0], matrix[1, 1]],
        "centre_px": [matrix[0, 2], matrix[1, 2]],
        "distortion": lens.camera.distortion,
    }
    fields = asdict(lens)
    del fields["camera"]
    return report | fields


def _print(lenses: list[Intrinsics]) -> None:

    table = table_of("camera", "fx fy", "+-", "cx cy", "model", "rms px", "used", "covered")
    console.print("pixels; +- of fx over resampled images; rms on held-out images")
    for column in table.columns:
        column.no_wrap = True
    for lens in lenses:
        matrix = lens.camera.matrix
        used = sum(not image.left_out for image in lens.images)
        table.add_row(
            lens.camera.name,
            f"{matrix[0, 0]:.0f} {matrix[1, 1]:.0f}",
            f"{lens.focal_spread_px:.1f}",
            f"{matrix[0, 2]:.0f} {matrix[1, 2]:.0f}",
            lens.model,
            f"{lens.held_out_px:.2f}",
            f"{used}/{lens.shown}",
            f"{100 * lens.coverage:.0f} %",
        )
    console.print(table)
    for lens in lenses:
        left_out = [image.label for image in lens.images if image.left_out]
        if left_out:
            err.print(
                f"camera '{lens.camera.name}': left out, they contradict the rest: "
                f"{', '.join(left_out)}",
                soft_wrap=True,
            )
        print_verdict(f"camera '{lens.camera.name}'", lens.verdict, lens.advice)
