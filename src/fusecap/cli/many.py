"""Commands on many sessions or takes: all cores or Ray, gone on with, failures reported, one table.

A worker runs the command as it is for one, with `--json`, and hands over what that prints. What is
done is told by the files themselves: results that are newer than what they were made from.
"""

from __future__ import annotations

import glob
import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import redirect_stderr, redirect_stdout, suppress
from dataclasses import dataclass
from importlib import import_module
from io import StringIO
from pathlib import Path
from typing import Annotated, Any

import typer

from fusecap.cli.common import print_json
from fusecap.cli.terminal import console, err, note, progress, remark, table_of
from fusecap.errors import FusecapError, InputError

Workers = Annotated[
    int | None, typer.Option(min=1, help="Of many: processes; default: one per core.")
]
OnRay = Annotated[
    str | None,
    typer.Option("--ray", metavar="ADDRESS", help="Of many: on Ray: 'local', 'auto' or host:port."),
]
Again = Annotated[
    bool, typer.Option("--again", help="Of many: also those whose results are there and newer.")
]
_SHOWN = 200
"""Rows of the table at the end; of more, those that failed."""

Row = Callable[[dict[str, Any]], Sequence[str]]


@dataclass(frozen=True, kw_only=True)
class OneOfMany:
    """A command on one path."""

    command: str
    path: Path
    options: dict[str, Any]
    again: bool


def run_one(one: OneOfMany) -> dict[str, Any]:
    """What the command prints with `--json`; an error is its `error`."""
    module = import_module(f"fusecap.cli.{one.command}")
    try:
        known = None if one.again else module.already(one.path, **one.options)
        if known is not None:
            return {**known, "already": True}
        out, said = StringIO(), StringIO()
        with redirect_stdout(out), redirect_stderr(said), suppress(typer.Exit):
            getattr(module, one.command)([one.path], **one.options, as_json=True)
        return json.loads(out.getvalue()) | {"said": said.getvalue().splitlines()}
    except FusecapError as error:
        return {"error": str(error)}


def is_pattern(paths: Sequence[Path]) -> bool:
    """Whether these may be many: several, or one that is a pattern."""
    return len(paths) != 1 or (glob.has_magic(str(paths[0])) and not paths[0].exists())


def matching(paths: Sequence[Path], *, wanted: Callable[[Path], bool], what: str) -> list[Path]:
    """Paths as they are, and of patterns those that are `wanted`; each once.

    Raises `InputError` for a pattern that matches none.
    """
    found: list[Path] = []
    for path in paths:
        if path.exists() or not glob.has_magic(str(path)):
            found.append(path)
            continue
        matches = map(Path, sorted(glob.glob(str(path.expanduser()), recursive=True)))
        some = [match for match in matches if wanted(match)]
        # A recording that was solved is there as its take.
        some = [path for path in some if wanted is not is_take_file or not _is_solved(path, some)]
        if not some:
            raise InputError(f"{path}: no {what} matches this pattern")
        found += some
    once = {_resolved(path): path for path in found}
    return list(once.values())


def is_session(path: Path) -> bool:
    """A folder with a session file, such a file, or a recording."""
    from fusecap.recording.layout import SUFFIX
    from fusecap.sources.session import FILE_NAME

    return (path / FILE_NAME).is_file() or path.name == FILE_NAME or path.suffix == SUFFIX


def is_take_file(path: Path) -> bool:
    """A take, or a recording, by its name; a broken one is found out when it is opened."""
    from fusecap.exports.formats.npz import FORMAT
    from fusecap.recording.layout import SUFFIX

    return path.suffix in (SUFFIX, ".npz") and FORMAT.tag not in path.suffixes


def _is_solved(path: Path, others: Sequence[Path]) -> bool:
    return path.suffix != ".npz" and path.with_suffix(".npz") in others


def _resolved(path: Path) -> Path:
    from fusecap.sources.session import FILE_NAME

    whole = path.resolve()
    return whole.parent if whole.name == FILE_NAME else whole


def refuse_out(out: Path | None) -> None:
    """Many results have no one name."""
    if out is not None:
        raise InputError(f"--out {out}: of one alone; of many, each goes beside what it is made of")


def are_newer(files: Iterable[Path], than: Iterable[Path]) -> bool:
    """Whether all of `files` are there and none is older than any of `than`."""
    files = list(files)
    if not all(file.exists() for file in files):
        return False
    newest = max((path.stat().st_mtime_ns for path in than if path.exists()), default=0)
    return all(file.stat().st_mtime_ns >= newest for file in files)


def run_many(
    command: str,
    paths: Sequence[Path],
    options: dict[str, Any],
    *,
    columns: Sequence[str],
    row: Row,
    workers: int | None,
    ray: str | None,
    again: bool,
    as_json: bool,
    lines: Row = lambda _: (),
    fails: Callable[[dict[str, Any]], bool] = lambda _: False,
) -> None:
    """All of them, then a table; exits with 1 where any failed, with 130 where it was interrupted.

    `lines`: what is said of one under the table. `fails`: a result that counts as a failure
    although it is one.
    """
    from fusecap.evaluate.runner import compute

    jobs = {
        str(path): OneOfMany(command=command, path=path, options=options, again=again)
        for path in paths
    }
    ended: dict[str, dict[str, Any]] = {}
    interrupted = False
    with progress(quiet=as_json) as show:
        show(command, 0, len(jobs))
        try:
            for path, result, error, seconds in compute(jobs, run_one, workers=workers, ray=ray):
                outcome = {"error": error} if result is None else dict(result)
                ended[path] = {**outcome, "seconds": round(seconds, 3)}
                for line in () if as_json else outcome.get("said", ()):
                    note(f"{path}: {line}")
                if "error" in outcome and not as_json:
                    remark(("failed", "bold red"), f"{path}: {outcome['error']}")
                show(command, len(ended), len(jobs))
        except KeyboardInterrupt:
            interrupted = True
    failed = [path for path in ended if "error" in ended[path] or fails(ended[path])]
    already = sum(bool(ended[path].get("already")) for path in ended)
    if as_json:
        results = {path: ended[path] for path in jobs if path in ended}
        counts = {"paths": len(jobs), "ended": len(ended), "already": already}
        print_json({**counts, "failed": len(failed), "interrupted": interrupted} | {"of": results})
    else:
        _print_table(jobs, ended, failed, columns, row, lines)
        done = len(ended) - len(failed)
        console.print(f"{done} of {len(jobs)} done ({already} already), {len(failed)} failed")
    if interrupted:
        err.print("interrupted: what is done stays; the same command goes on")
        raise typer.Exit(130)
    if failed:
        raise typer.Exit(1)


def _print_table(
    jobs: Mapping[str, OneOfMany],
    ended: Mapping[str, dict[str, Any]],
    failed: Sequence[str],
    columns: Sequence[str],
    row: Row,
    lines: Row,
) -> None:
    """Failures last, where they are seen; what is said as lines, which no column narrows."""
    well = [path for path in jobs if path in ended and path not in set(failed)]
    errors = [path for path in failed if "error" in ended[path]]
    shown = [
        *(well if len(ended) <= _SHOWN else ()),
        *(path for path in failed if "error" not in ended[path]),
    ]
    table = table_of("", *columns, "s", "")
    for path in shown:
        result = ended[path]
        word = "already" if result.get("already") else ""
        table.add_row(path, *row(result), f"{result['seconds']:.1f}", word)
    if shown:
        console.print(table)
    for path in shown:
        for line in lines(ended[path]):
            console.print(f"{path}: {line}", soft_wrap=True)
    for path in errors:
        console.print(f"failed {path}: {ended[path]['error'].splitlines()[0]}", soft_wrap=True)
