"""The command line: one file per command, each with its own example.

Heavy imports wait until a command needs them, so `--help` is quick. Exit codes: 0 done, 1 failed,
2 misuse, 130 interrupted. Results go to stdout, everything else to stderr; with `--json` stdout is
one JSON object, also when the command fails.
"""

from __future__ import annotations

import logging
import os
import sys
from importlib import metadata
from typing import Annotated

import typer

from fusecap.cli import (
    angles,
    calibrate_board,
    calibrate_extrinsics,
    calibrate_imu,
    calibrate_intrinsics,
    calibrate_offsets,
    calibrate_prior,
    calibrate_shape,
    calibrate_sync,
    calibrate_world,
    demo,
    detect,
    doctor,
    edit,
    evaluate_datasets,
    evaluate_twin,
    export,
    init,
    live,
    models,
    overlay,
    report,
    retarget,
    simulate,
    solve,
    stream,
    view,
)
from fusecap.cli.common import print_json
from fusecap.cli.terminal import err, remark
from fusecap.errors import FusecapError
from fusecap.interrupts import ends_are_ctrl_c

# It warns wherever it cannot keep its list of fonts, as in a home that is read only.
logging.getLogger("matplotlib").setLevel(logging.ERROR)

app = typer.Typer(
    name="fusecap",
    epilog="Start with: fusecap demo",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)
calibrate = typer.Typer(
    no_args_is_help=True,
    help="Calibrations: cameras, world, clocks, IMUs, bodies, landmark offsets, prior.",
)
app.add_typer(calibrate, name="calibrate")
evaluate = typer.Typer(no_args_is_help=True, help="The paper's tables and figures.")
app.add_typer(evaluate, name="evaluate")
networks = typer.Typer(no_args_is_help=True, help="Networks that find people: list, fetch, import.")
app.add_typer(networks, name="models")


def _print_version(asked: bool) -> None:
    if asked:
        typer.echo(f"fusecap {metadata.version('fusecap')}")
        raise typer.Exit


@app.callback()
def _root(
    version: Annotated[
        bool, typer.Option("--version", callback=_print_version, is_eager=True, help="Version.")
    ] = False,
) -> None:
    """Full 6-DoF motion of several people from a few calibrated cameras and body-worn IMUs."""


app.command(epilog=demo.EXAMPLE)(demo.demo)
app.command(epilog=detect.EXAMPLE)(detect.detect)
app.command(epilog=solve.EXAMPLE)(solve.solve)
app.command(epilog=edit.EXAMPLE)(edit.edit)
app.command(epilog=export.EXAMPLE)(export.export)
app.command(epilog=angles.EXAMPLE)(angles.angles)
app.command(epilog=overlay.EXAMPLE)(overlay.overlay)
app.command(epilog=report.EXAMPLE)(report.report)
app.command(epilog=retarget.EXAMPLE)(retarget.retarget)
app.command(epilog=doctor.EXAMPLE)(doctor.doctor)
app.command(epilog=init.EXAMPLE)(init.init)
app.command(epilog=live.EXAMPLE)(live.live)
app.command(epilog=simulate.EXAMPLE)(simulate.simulate)
app.command(epilog=stream.EXAMPLE)(stream.stream)
app.command(epilog=view.EXAMPLE)(view.view)
calibrate.command(epilog=calibrate_board.EXAMPLE)(calibrate_board.board)
calibrate.command(epilog=calibrate_intrinsics.EXAMPLE)(calibrate_intrinsics.intrinsics)
calibrate.command(epilog=calibrate_extrinsics.EXAMPLE)(calibrate_extrinsics.extrinsics)
calibrate.command(epilog=calibrate_world.EXAMPLE)(calibrate_world.world)
calibrate.command(epilog=calibrate_sync.EXAMPLE)(calibrate_sync.sync)
calibrate.command(epilog=calibrate_imu.EXAMPLE)(calibrate_imu.imu)
calibrate.command(epilog=calibrate_shape.EXAMPLE)(calibrate_shape.shape)
calibrate.command(epilog=calibrate_offsets.EXAMPLE)(calibrate_offsets.offsets)
calibrate.command(epilog=calibrate_prior.EXAMPLE)(calibrate_prior.prior)
networks.command("list", epilog=models.LIST_EXAMPLE)(models.list_models)
networks.command("fetch", epilog=models.FETCH_EXAMPLE)(models.fetch_models)
networks.command("import", epilog=models.IMPORT_EXAMPLE)(models.import_packages)
evaluate_twin.add_to(evaluate)
evaluate_datasets.add_to(evaluate)


def main() -> None:
    """Entry point: errors become one readable line, never a traceback."""
    ends_are_ctrl_c()
    try:
        app()
    except FusecapError as error:
        _fail(str(error))
    except SystemExit as leaving:
        # Typer turns Ctrl-C into Exit(130) without a word.
        if isinstance(getattr(leaving.__context__, "__cause__", None), KeyboardInterrupt):
            _say_interrupted()
        raise
    except KeyboardInterrupt:
        _say_interrupted()
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


def _say_interrupted() -> None:
    if "--json" in sys.argv:
        print_json({"error": "interrupted"})
    err.print("interrupted; no unfinished file was left behind")


def _fail(message: str) -> None:
    if "--json" in sys.argv:
        print_json({"error": message})
    remark(("error", "bold red"), message)
    sys.exit(1)
