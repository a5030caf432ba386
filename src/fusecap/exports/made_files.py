"""What was made from a take and stands beside it: exports, pictures, tables, characters.

    duo.npz    duo.files.json  {"files": ["duo.png", "duo_anna.bvh"]}

Whoever writes another take to that name sets those files aside, `duo_anna.earlier1.bvh`: nobody
takes them for results of the take beside them, and nothing is lost. Only files with the take's name
in front are listed; what has a name of its own is its owner's. What is made from a recording has
`.live` in its name, for the take that it is solved to stands beside it under the same name:

    duo.mcap   duo.live.files.json  {"files": ["duo.live_anna.bvh"]}
"""

from __future__ import annotations

import itertools
import json
import re
from collections.abc import Iterable
from pathlib import Path

from fusecap.errors import InputError, TakeError
from fusecap.exports.formats import FORMATS, format_named
from fusecap.files import write_whole
from fusecap.inputs import MADE_FILES, read_json

_EARLIER = "earlier"


def made_stem(take: Path) -> str:
    """What the names of files made from the take or recording at `take` begin with."""
    return take.stem if take.suffix == ".npz" else f"{take.stem}.live"


def list_made(take: Path, files: Iterable[Path]) -> None:
    """Adds files to the list of the take (or recording) at `take`; raises `TakeError`."""
    _write_list(take, _listed(take) | _beside(take, files))


def set_aside_others(take: Path, files: Iterable[Path]) -> list[Path]:
    """Lists `files` alone; renames what else was listed and is there, and returns the new paths.

    Raises `TakeError` with the system's reason.
    """
    kept = _beside(take, files)
    others = (take.with_name(name) for name in sorted(_listed(take) - kept))
    aside = [_renamed(path) for path in others if path.exists()]
    _write_list(take, kept)
    return aside


def _list_path(take: Path) -> Path:
    return take.with_name(f"{made_stem(take)}.files.json")


def _listed(take: Path) -> set[str]:
    try:
        found = read_json(_list_path(take), MADE_FILES)
    except InputError:
        return set()
    names = found.get("files") if isinstance(found, dict) else None
    listed = map(str, names) if isinstance(names, list) else ()
    return {name for name in listed if _could_be_of(take, name)}


def _beside(take: Path, files: Iterable[Path]) -> set[str]:
    """Names of those in the folder of the take that have its name in front."""
    folder = take.parent.resolve()
    here = {file.name for file in files if file.parent.resolve() == folder}
    return {name for name in here if _could_be_of(take, name)}


def _write_list(take: Path, names: set[str]) -> None:
    path = _list_path(take)
    if names:
        write_whole(path, json.dumps({"files": sorted(names)}, indent=1, ensure_ascii=False) + "\n")
    elif path.is_file():
        path.unlink()


def _could_be_of(take: Path, name: str) -> bool:
    """A list is text that anybody can write: it names no inputs and nothing elsewhere."""
    endings = {*(format_named(each).suffix for each in FORMATS), ".png", ".vrm", ".mp4"}
    ours = re.fullmatch(rf"{re.escape(made_stem(take))}[_.][^/\\\0]+", name)
    return ours is not None and name != take.name and Path(name).suffix.lower() in endings


def _renamed(path: Path) -> Path:
    """To a name that no file has."""
    bare = path.name.removesuffix(path.suffix)
    names = (f"{bare}.{_EARLIER}{number}{path.suffix}" for number in itertools.count(1))
    aside = next(path.with_name(name) for name in names if not path.with_name(name).exists())
    try:
        path.replace(aside)
    except OSError as error:
        raise TakeError(f"cannot rename {path}: {error.strerror or error}") from error
    return aside
