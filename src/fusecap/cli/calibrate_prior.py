"""`fusecap calibrate prior`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from fusecap.cli.common import Json, print_json
from fusecap.cli.terminal import console, progress

EXAMPLE = "Example: fusecap calibrate prior cmu_mocap --out prior.npz"


def prior(
    motion: Annotated[
        Path, typer.Argument(help="Folder of AMC/ASF, BVH and exponential-map motion, or archives.")
    ],
    out: Annotated[Path, typer.Option(help="The prior to write.")] = Path("prior.npz"),
    skeleton: Annotated[str, typer.Option(help="paper21 or extended23.")] = "paper21",
    seed: Annotated[int, typer.Option(min=0, help="Of the clustering.")] = 0,
    as_json: Json = False,
) -> None:
    """Train the PCA pose prior on motion; reports how well it covers held-out takes."""
    from dataclasses import asdict

    from fusecap.body.prior import save_prior
    from fusecap.body.skeleton import skeleton_named
    from fusecap.files import check_writable
    from fusecap.motion.train_prior import train_prior

    check_writable(out)
    body = skeleton_named(skeleton)
    with progress(quiet=as_json) as show:
        trained, report = train_prior(
            motion,
            body,
            seed=seed,
            progress=show,
        )
    save_prior(trained, out)
    if as_json:
        print_json(asdict(report) | {"file": str(out)})
        return
    console.print(
        f"{report.training_takes} takes, {report.training_frames} frames at 60 Hz, "
        f"{report.clusters} clusters -> {report.components} components"
    )
    console.print(
        f"  variance explained  training {100 * report.explained_training:.1f} %, "
        f"held out {100 * report.explained_held_out:.1f} %"
    )
    for take in report.held_out:
        console.print(f"    {take.key:<40} {100 * take.explained:6.1f} %")
    console.print(f"wrote {out}")
