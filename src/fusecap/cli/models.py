"""`fusecap models`: networks that find people: what is here, from where, under what terms."""

from __future__ import annotations

import sys
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from fusecap.cli.common import Json, print_json
from fusecap.cli.terminal import console, err, progress, table_of
from fusecap.errors import InputError

if TYPE_CHECKING:
    from fusecap.detect.detector import DetectorOptions

LIST_EXAMPLE = "Example: fusecap models list"
FETCH_EXAMPLE = "Example: fusecap models fetch rtmpose-s-halpe26 rtmdet-nano-person"
IMPORT_EXAMPLE = "Example: fusecap models import mediapipe-0.10.14-cp311-cp311-linux_x86_64.whl"


def list_models(as_json: Json = False) -> None:
    """Networks known by name: which are on this machine, and where the others come from."""
    from fusecap.detect.model_store import MODELS, cache_dir, kept_at

    rows = []
    for name, stored in MODELS.items():
        path = kept_at(name, stored)
        rows.append(
            {
                "name": name,
                "about": stored.about,
                "licence": stored.licence,
                "from": stored.url or stored.package,
                "path": str(path) if path.is_file() else None,
                "bytes": path.stat().st_size if path.is_file() else None,
            }
        )
    if as_json:
        print_json({"folder": str(cache_dir()), "models": rows})
        return
    table = table_of("network", "what", "licence", "here")
    for row in rows:
        here = "-" if row["bytes"] is None else _megabytes(row["bytes"])
        licence, _, remark = row["licence"].partition("; ")
        table.add_row(row["name"], row["about"], f"{licence} *" if remark else licence, here)
    console.print(table)
    console.print("* some data sets it was trained on allow research only")
    console.print(f"kept in {cache_dir()}", soft_wrap=True)


def fetch_models(
    names: Annotated[
        list[str] | None, typer.Argument(help="Networks by name; the two default ones, if none.")
    ] = None,
) -> None:
    """Download networks, once."""
    from fusecap.detect.detector import DEFAULT_MODEL, DEFAULT_PERSON_MODEL
    from fusecap.detect.model_store import MODELS, model_path
    from fusecap.errors import nearest

    wanted = names or [DEFAULT_MODEL, DEFAULT_PERSON_MODEL]
    for name in wanted:
        if name not in MODELS:
            raise InputError(f"no network '{name}'{nearest(name, MODELS)}")
    for name in wanted:
        err.print(f"{name}: {MODELS[name].licence}", soft_wrap=True)
        with progress(quiet=False) as show:
            path = model_path(name, show)
        console.print(f"{name} is in {path}", soft_wrap=True)


def import_packages(
    packages: Annotated[
        list[Path],
        typer.Argument(help="A wheel of mediapipe, an npm package, an archive, a folder, a file."),
    ],
) -> None:
    """Take networks out of packages that are on this machine; nothing is downloaded."""
    from fusecap.detect.model_import import import_models
    from fusecap.detect.model_store import MODELS

    for package in packages:
        for name in import_models(package):
            console.print(f"{name}: {MODELS[name].about}; {MODELS[name].licence}", soft_wrap=True)
    console.print(
        "fusecap init names them in new sessions; in others write model and person_model under "
        "[detector]",
        soft_wrap=True,
    )


def ask_for_networks(options: DetectorOptions, *, quiet: bool) -> None:
    """Ask a person at a terminal once before networks are downloaded.

    Raises `InputError` for a no. Scripts are not asked.
    """
    from fusecap.detect.model_store import MODELS, download_size, to_download

    model = MODELS.get(options.model)
    names = [options.model]
    if model is None or model.finds == "keypoints":
        names.append(options.person_model)
    missing = {name: one for name in dict.fromkeys(names) if (one := to_download(name))}
    if quiet or not sys.stdin.isatty() or not any(one.url for one in missing.values()):
        return
    for name, stored in missing.items():
        size = download_size(stored)
        told = "size unknown" if size is None else _megabytes(size)
        source = stored.url or stored.package
        err.print(f"{name}: {told}, from {source}; {stored.licence}", soft_wrap=True)
    if not typer.confirm(f"download {_and(missing)} once?", default=True, err=True):
        raise InputError(
            "without networks there are no keypoints; fusecap models list has others, and "
            "[detector] model or --model takes a file of your own"
        )


def _megabytes(size: int) -> str:
    return f"{size / 1e6:.1f} MB"


def _and(names: Iterable[str]) -> str:
    return " and ".join(names)
