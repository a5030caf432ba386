"""`fusecap demo`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from fusecap.cli.common import (
    Exports,
    Json,
    check_choice,
    finish,
    print_json,
    print_speed,
    write_take,
)
from fusecap.cli.terminal import console, progress, styled

if TYPE_CHECKING:
    from fusecap.evaluate.simulator import Simulation
    from fusecap.take import Take

EXAMPLE = "Example: fusecap demo --out demo --json"
LAG_S = 0.1


def demo(
    out: Annotated[Path, typer.Option(help="Folder for the take, BVH files and picture.")] = Path(
        "demo"
    ),
    seconds: Annotated[
        float | None, typer.Option(min=0.5, help="Solve only the first seconds.")
    ] = None,
    seed: Annotated[int, typer.Option(min=0, help="Of the simulated noise.")] = 0,
    associate: Annotated[str, typer.Option(help="tracker, or paper: its Algorithm 1.")] = "tracker",
    write_session: Annotated[
        Path | None, typer.Option(help="Also write the scene as a session folder.")
    ] = None,
    view: Annotated[
        bool, typer.Option("--view", help="Then look at it in a browser, until Ctrl-C.")
    ] = False,
    as_json: Json = False,
) -> None:
    """Solve a simulated scene with known truth: 2 subjects, 1 bystander, 4 cameras, 13 IMUs each.

    Prints the error against the truth and the speed; writes a take, BVH files and a picture.
    """
    from dataclasses import asdict

    from fusecap.evaluate import simulated_session
    from fusecap.evaluate.demo_scene import demo_scene
    from fusecap.evaluate.score import main_figures, score_take
    from fusecap.evaluate.simulated_solve import live_takes, solve_simulation

    if view and as_json:
        raise typer.BadParameter(
            "it serves a page until Ctrl-C; leave --json out", param_hint="--view"
        )
    check_choice("--associate", associate, ("tracker", "paper"))
    simulation = demo_scene(seed, seconds=seconds)
    if write_session:
        simulated_session.write_session(simulation, write_session)
    with progress(quiet=as_json) as show:
        solved = solve_simulation(simulation, associate=associate, progress=show)
        take = solved.whole_take
        live = live_takes(simulation, associate=associate, lag_s=LAG_S, progress=show)
    files = write_take(
        solved,
        out / "demo.npz",
        Exports(formats=["bvh"]),
        picture=True,
    )
    score = score_take(take, simulation.truth)
    newest, settled = (score_take(each, simulation.truth) for each in live)
    result = {
        "simulated": True,
        **main_figures(score),
        "newest": main_figures(newest),
        "lag": main_figures(settled) | {"lag_s": LAG_S},
        "solve_ms_median": solved.report.solve_ms_median,
        "solve_ms_p99": solved.report.solve_ms_p99,
        "subjects": score.subjects,
        "identity_switches": score.identity_switches,
        "found_share": score.found_share,
        "extra_share": score.extra_share,
        "score": asdict(score),
        "solve": solved.report.as_json(),
        "files": [str(path) for path in files],
    }
    if as_json:
        print_json(result)
    else:
        what = ": 2 subjects, 1 bystander, 4 cameras, 13 IMUs each"
        console.print(styled(("Simulated scene", "bold"), what))
        console.print(f"  position error     {_spread(score.position_error_mm)} mm")
        console.print(f"  orientation error  {_spread(score.orientation_error_deg)} deg")
        console.print(
            f"  as live            {newest.position_error_mm.mean:.1f} mm at once, "
            f"{settled.position_error_mm.mean:.1f} mm {1e3 * LAG_S:.0f} ms late (means)"
        )
        console.print(
            f"  motion             jitter {score.jitter_km_s3:.2f} km/s3 (the truth's "
            f"{score.true_jitter_km_s3:.2f}), feet on the floor slide at "
            f"{score.foot_skate_m_s:.2f} m/s ({score.true_foot_skate_m_s:.2f})"
        )
        console.print(
            f"  people             {score.subjects} subjects, {score.identity_switches} identity "
            f"switches, {100 * score.found_share:.1f} % of frames found"
        )
        print_speed(solved)
    finish(solved, files, as_json)
    if view:
        _show(take, simulation)


def _show(take: Take, simulation: Simulation) -> None:
    from fusecap.cli.view import error_curves, look

    curves = error_curves(take, simulation.truth)
    look(take, "fusecap demo", rig=simulation.rig, curves=curves)


def _spread(summary: Any) -> str:
    return f"{summary.mean:.1f} mean, {summary.median:.1f} median, {summary.std:.1f} std"
