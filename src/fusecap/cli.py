"""The command line. Heavy imports wait until a command needs them, so `--help` is quick.

Exit codes: 0 done, 1 failed, 2 misuse, 130 interrupted. Results go to stdout, everything else to
stderr; with `--json` stdout is one JSON object, also when the command fails.
"""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.console import Console

from fusecap.errors import FusecapError, InputError, nearest

if TYPE_CHECKING:
    from fusecap.offline import Solved
    from fusecap.sinks.take import Take

app = typer.Typer(
    name="fusecap",
    help="Full 6-DoF motion of several people from a few calibrated cameras and body-worn IMUs.",
    epilog="Start with: fusecap demo",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode="rich",
    context_settings={"help_option_names": ["-h", "--help"]},
)
calibrate = typer.Typer(no_args_is_help=True, help="Calibrations: prior.")
app.add_typer(calibrate, name="calibrate")

_err = Console(stderr=True, highlight=False)
_out = Console(highlight=False)
_EXPORTS = ("bvh",)

Json = Annotated[bool, typer.Option("--json", help="Print one JSON object for machines.")]
Unit = Annotated[str, typer.Option(help="Length unit of BVH: m (Blender) or cm (engines).")]


@app.command(epilog="Example: fusecap demo --out demo --json")
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
    as_json: Json = False,
) -> None:
    """Solve a simulated scene with known truth: 2 subjects, 1 bystander, 4 cameras, 13 IMUs each.

    Prints the error against the truth and the speed; writes a take, BVH files and a picture.
    """
    from dataclasses import asdict

    from fusecap.evaluate import simulated_session
    from fusecap.evaluate.demo_scene import demo_scene
    from fusecap.evaluate.score import score_take
    from fusecap.evaluate.simulated_solve import solve_simulation

    _check_choice("--associate", associate, ("tracker", "paper"))
    simulation = demo_scene(seed, seconds=seconds)
    if write_session:
        simulated_session.write_session(simulation, write_session)
    with _progress(quiet=as_json) as progress:
        solved = solve_simulation(simulation, associate=associate, progress=progress)
    files = _write(solved.take, out / "demo.npz", exports=["bvh"], unit="m", picture=True)
    score = score_take(solved.take, simulation.truth)
    result = {
        "simulated": True,
        "position_error_mm": score.position_error_mm.mean,
        "orientation_error_deg": score.orientation_error_deg.mean,
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
        _print_json(result)
    else:
        _out.print("[bold]Simulated scene[/]: 2 subjects, 1 bystander, 4 cameras, 13 IMUs each")
        _out.print(f"  position error     {_spread(score.position_error_mm)} mm")
        _out.print(f"  orientation error  {_spread(score.orientation_error_deg)} deg")
        _out.print(
            f"  people             {score.subjects} subjects, {score.identity_switches} identity "
            f"switches, {100 * score.found_share:.1f} % of their frames found"
        )
        _print_speed(solved)
    _finish(solved, files, as_json)


@app.command(epilog="Example: fusecap solve recordings/duo --export bvh --json > report.json")
def solve(
    session: Annotated[Path, typer.Argument(help="session.toml, or the folder that holds it.")],
    out: Annotated[
        Path | None, typer.Option(help="The take to write; default SESSION/<name>.npz.")
    ] = None,
    export: Annotated[
        str | None, typer.Option(help="Other formats beside the take, e.g. bvh.")
    ] = None,
    unit: Unit = "m",
    picture: Annotated[bool, typer.Option("--picture", help="Also draw the motion.")] = False,
    as_json: Json = False,
) -> None:
    """Solve a recorded session: keypoints and IMU files to each person's motion."""
    from fusecap.offline import solve_session
    from fusecap.sources.session import load_session
    from fusecap.sources.session_data import open_session

    exports = _exports(export)
    _check_choice("--unit", unit, ("m", "cm"))
    loaded = load_session(session)
    target = out or loaded.folder / f"{_safe_name(loaded.settings.name)}.npz"
    if target.suffix != ".npz":
        raise InputError(f"--out {target}: a take is one .npz file")
    with _progress(quiet=as_json) as progress:
        data = open_session(loaded, progress)
        solved = solve_session(data, progress=progress)
    files = _write(solved.take, target, exports=exports, unit=unit, picture=picture)
    if as_json:
        _print_json(solved.report.as_json() | {"files": [str(path) for path in files]})
    else:
        for note in solved.report.notes:
            _err.print(f"[yellow]note[/] {note}", soft_wrap=True)
        _print_report(solved)
    _finish(solved, files, as_json)


@app.command(epilog="Example: fusecap export take.npz --format bvh --unit cm --out bvh")
def export(
    take: Annotated[Path, typer.Argument(help="A solved take (.npz).")],
    format: Annotated[str, typer.Option(help="bvh")] = "bvh",
    out: Annotated[Path | None, typer.Option(help="Folder; default: beside the take.")] = None,
    unit: Unit = "m",
    as_json: Json = False,
) -> None:
    """Write a take in another format, one file per person."""
    from fusecap.sinks.bvh import export_bvh
    from fusecap.sinks.take import load_take

    _check_choice("--format", format, _EXPORTS)
    _check_choice("--unit", unit, ("m", "cm"))
    files = export_bvh(load_take(take), out or take.parent, stem=take.stem, unit=unit)
    if as_json:
        _print_json({"files": [str(path) for path in files], "unit": unit})
    for path in files if not as_json else ():
        _out.print(f"wrote {path} ({unit})", soft_wrap=True)


@app.command(epilog="Example: fusecap doctor recordings/duo")
def doctor(
    session: Annotated[Path, typer.Argument(help="session.toml, or the folder that holds it.")],
    as_json: Json = False,
) -> None:
    """Check a session before it is solved: what is wrong, and what to do about it."""
    from dataclasses import asdict

    from fusecap.sources.doctor import diagnose

    with _progress(quiet=as_json) as progress:
        findings = diagnose(session, progress)
    errors = sum(finding.severity == "error" for finding in findings)
    if as_json:
        _print_json({"findings": [asdict(f) for f in findings], "errors": errors})
    else:
        colours = {"error": "red", "warning": "yellow", "info": "cyan"}
        for finding in findings:
            colour = colours[finding.severity]
            _out.print(f"[{colour}]{finding.severity}[/] ", end="")
            _out.print(f"{finding.where}: {finding.found}", markup=False, soft_wrap=True)
            if finding.remedy:
                _out.print(f"  -> {finding.remedy}", markup=False, soft_wrap=True)
        _out.print("nothing is wrong" if not findings else f"{errors} errors in {len(findings)}")
    if errors:
        raise typer.Exit(1)


@calibrate.command(epilog="Example: fusecap calibrate prior cmu_mocap --out prior.npz")
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
    from fusecap.calibrate.prior import train_prior

    body = skeleton_named(skeleton)
    with _progress(quiet=as_json) as progress:
        trained, report = train_prior(
            motion,
            body,
            seed=seed,
            progress=lambda done, total, text: progress(text, done, total),
        )
    save_prior(trained, out)
    if as_json:
        _print_json(asdict(report) | {"file": str(out)})
        return
    _out.print(
        f"{report.training_takes} takes, {report.training_frames} frames at 60 Hz, "
        f"{report.clusters} clusters -> {report.components} components"
    )
    _out.print(f"  variance explained  training {100 * report.explained_training:.1f} %, ", end="")
    _out.print(f"held out {100 * report.explained_held_out:.1f} %")
    for take in report.held_out:
        _out.print(f"    {take.key:<40} {100 * take.explained:6.1f} %")
    _out.print(f"wrote {out}")


def main() -> None:
    """Entry point: errors become one readable line, never a traceback."""
    try:
        app()
    except FusecapError as error:
        _fail(str(error))
    except KeyboardInterrupt:
        _err.print("interrupted; nothing was written")
        sys.exit(130)
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(1)
    except Exception as error:
        if os.environ.get("FUSECAP_DEBUG"):
            raise
        _fail(
            f"internal error: {type(error).__name__}: {error}. This is a fault of fusecap; "
            "please report it with the output of the same command under FUSECAP_DEBUG=1"
        )


def _fail(message: str) -> None:
    if "--json" in sys.argv:
        _print_json({"error": message})
    _err.print("[bold red]error[/] ", end="")
    _err.print(message, markup=False, soft_wrap=True)
    sys.exit(1)


def _check_choice(option: str, value: str, known: tuple[str, ...]) -> None:
    if value not in known:
        raise typer.BadParameter(f"'{value}'{nearest(value, known)}", param_hint=option)


def _exports(text: str | None) -> list[str]:
    formats = [part.strip() for part in (text or "").split(",") if part.strip()]
    for name in formats:
        _check_choice("--export", name, _EXPORTS)
    return formats


def _safe_name(name: str) -> str:
    from fusecap.sinks.files import safe_name

    return safe_name(name)


def _write(take: Take, path: Path, *, exports: list[str], unit: str, picture: bool) -> list[Path]:
    from fusecap.sinks.bvh import export_bvh
    from fusecap.sinks.take import save_take

    save_take(take, path)
    files = [path]
    if "bvh" in exports:
        files += export_bvh(take, path.parent, stem=path.stem, unit=unit)
    frames = len(take.timestamps_ns)
    if picture and frames:
        from fusecap.sinks.plot import plot_take

        image = path.with_suffix(".png")
        plot_take(take, sorted({0, frames // 3, 2 * frames // 3, frames - 1}), image)
        files.append(image)
    return files


@contextmanager
def _progress(*, quiet: bool) -> Iterator[Callable[[str, int, int], None]]:
    """A bar with ETA on stderr, one per kind of work; silent with --json."""
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        TextColumn,
        TimeElapsedColumn,
        TimeRemainingColumn,
    )

    columns = (
        TextColumn("{task.description:<28.28}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TextColumn("ETA"),
        TimeRemainingColumn(),
    )
    with Progress(*columns, console=_err, disable=quiet, transient=True) as bars:
        tasks: dict[str, Any] = {}

        def show(what: str, done: int, total: int) -> None:
            if what not in tasks:
                tasks[what] = bars.add_task(what, total=total)
            bars.update(tasks[what], completed=done, total=total)

        yield show


def _print_report(solved: Solved) -> None:
    from rich.table import Table

    report = solved.report
    _out.print(
        f"[bold]{report.instants}[/] instants ({report.duration_s:.2f} s), "
        f"{report.cameras} cameras, {len(report.subjects)} subjects"
    )
    people = Table("subject", "tracked", "quality", "height m")
    for name, values in report.subjects.items():
        people.add_row(
            name,
            f"{100 * values['tracked_share']:.1f} %",
            f"{values['mean_quality']:.2f}",
            f"{values['height_m']:.2f}",
        )
    _out.print(people)
    if report.reprojection_px:
        cameras = Table("camera", "reprojection median px", "p90 px", "keypoints")
        for name, values in report.reprojection_px.items():
            cameras.add_row(
                name,
                f"{values['median']:.1f}",
                f"{values['p90']:.1f}",
                f"{values['keypoints']:.0f}",
            )
        _out.print(cameras)
    _print_speed(solved)


def _print_speed(solved: Solved) -> None:
    report = solved.report
    _out.print(
        f"  solve              {report.solve_ms_median:.2f} ms median, "
        f"{report.solve_ms_p99:.2f} ms p99, {report.solves} solves; "
        f"{report.elapsed_s:.1f} s in all"
    )


def _spread(summary: Any) -> str:
    return f"{summary.mean:.1f} mean, {summary.median:.1f} median, {summary.std:.1f} std"


def _finish(solved: Solved, files: list[Path], as_json: bool) -> None:
    if not as_json:
        for path in files:
            _out.print(f"wrote {path}", soft_wrap=True)
    if solved.report.interrupted:
        _err.print("interrupted: the files hold what was solved until then")
        raise typer.Exit(130)


def _print_json(value: dict[str, Any]) -> None:
    typer.echo(json.dumps(value, indent=2))
