"""A take in the formats of other programs.

A file's name says what is not the usual thing: `duo_anna.bvh` is in metres, `duo_anna.cm.bvh` in
centimetres, `duo.mixamo.glb` has Mixamo's bones. Names of people hold no dot, so no two of these
are ever the same file.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

from fusecap.errors import InputError, TakeError, nearest
from fusecap.exports.formats import FORMATS, format_named
from fusecap.exports.rigs import rig_preset
from fusecap.exports.take_format import UNITS_PER_M, ExportOptions, TakeFormat
from fusecap.files import safe_name
from fusecap.take import Take

_EARLIER = "earlier"
"""Put before the ending of a file that a new solve did not write again."""


def export(
    take: Take,
    path: Path | str,
    *,
    unit: str | None = None,
    rig: str = "native",
    options: ExportOptions | None = None,
) -> list[Path]:
    """Writes a take in the format that `path` ends with, say "x.glb"; returns the paths.

    Of formats that hold one person there is a file per person, `x_anna.bvh`, unless the take has
    one alone. Raises `InputError` for an ending, a unit or a rig that is not known.
    """
    path = Path(path)
    by_suffix = {format_named(name).suffix: name for name in FORMATS}
    name = by_suffix.get(path.suffix.lower())
    if name is None:
        known = nearest(path.suffix, by_suffix)
        raise InputError(f"{path}: no format ends with '{path.suffix}'{known}")
    format, chosen = _checked(name, unit, rig, options)
    people = _people(take)
    if not format.per_person or len(people) == 1:
        one = take.of_subjects(people) if format.per_person else take
        return _written(format, one, path, chosen)
    paths: list[Path] = []
    for one, safe in _one_by_one(take, people):
        paths += _written(format, one, path.with_name(f"{path.stem}_{safe}{path.suffix}"), chosen)
    return paths


def export_take(
    take: Take,
    folder: Path | str,
    *,
    format: str,
    stem: str,
    unit: str | None = None,
    rig: str = "native",
    options: ExportOptions | None = None,
) -> list[Path]:
    """Writes `<stem>`, or one `<stem>_<subject>` for everyone who was tracked; returns the paths.

    `unit`: the format's usual one unless told. Raises `InputError` for what is not known, and for
    a take with nobody in it.
    """
    chosen, settings = _checked(format, unit, rig, options)
    people = _people(take)
    ending = ""
    if chosen.has_rig and rig != "native":
        ending += f".{rig}"
    if settings.unit != chosen.units[0]:
        ending += f".{settings.unit}"
    ending += chosen.tag + chosen.suffix
    base = Path(folder) / safe_name(stem)
    if not chosen.per_person:
        return _written(chosen, take, base.with_name(base.name + ending), settings)
    paths: list[Path] = []
    for one, safe in _one_by_one(take, people):
        paths += _written(chosen, one, base.with_name(f"{base.name}_{safe}{ending}"), settings)
    return paths


def export_all(
    take: Take,
    folder: Path | str,
    *,
    formats: Sequence[str],
    stem: str,
    unit: str | None = None,
    rig: str = "native",
    options: ExportOptions | None = None,
) -> list[Path]:
    """`export_take` in each format; a unit or a rig goes to the formats that have a choice.

    Raises `InputError` where none of them has that choice, before anything is written.
    """
    chosen = {name: _known_format(name) for name in formats}
    if unit is not None and not any(unit in format.units for format in chosen.values()):
        _checked(formats[0], unit, "native", options)
    if rig != "native" and not any(format.has_rig for format in chosen.values()):
        _checked(formats[0], None, rig, options)
    paths: list[Path] = []
    for name, format in chosen.items():
        paths += export_take(
            take,
            folder,
            format=name,
            stem=stem,
            unit=unit if unit in format.units else None,
            rig=rig if format.has_rig else "native",
            options=options,
        )
    return paths


def set_aside(stem: str, folder: Path, subjects: Sequence[str], kept: Sequence[Path]) -> list[Path]:
    """Renames what an earlier take exported under this stem, but for the files just written.

    `subjects` are the earlier take's. `duo_ben.bvh` becomes `duo_ben.earlier1.bvh`, so nobody takes
    it for a result of the take beside it. Returns the new paths.
    """
    base = safe_name(stem)
    people = {f"{base}_{safe}" for safe in _safe_names(subjects)}
    moved: list[Path] = []
    for name in FORMATS:
        format = format_named(name)
        for path in sorted(folder.glob(f"{base}*{format.tag}{format.suffix}")):
            first, *parts = path.name.split(".")
            ours = first in people if format.per_person else first == base
            if ours and path not in kept and not any(p.startswith(_EARLIER) for p in parts):
                moved.append(_renamed(path))
    return moved


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


def _known_format(name: str) -> TakeFormat:
    if name not in FORMATS:
        raise InputError(f"no export format '{name}'{nearest(name, FORMATS)}")
    return format_named(name)


def _checked(
    name: str, unit: str | None, rig: str, options: ExportOptions | None
) -> tuple[TakeFormat, ExportOptions]:
    format = _known_format(name)
    if unit is not None and unit not in UNITS_PER_M:
        raise InputError(f"no unit '{unit}'{nearest(unit, UNITS_PER_M)}")
    if unit is not None and unit not in format.units:
        raise InputError(f"{name} is written in {' or '.join(format.units)}, not in {unit}")
    rig_preset(rig)
    if rig != "native" and not format.has_rig:
        raise InputError(f"{name} has no rig: export it without --rig {rig}")
    return format, replace(options or ExportOptions(), unit=unit or format.units[0], rig=rig)


def _people(take: Take) -> list[int]:
    people = [row for row in range(len(take.subject_names)) if take.tracked[row].any()]
    if not people:
        raise TakeError("nobody is tracked in any frame of the take: there is nothing to export")
    return people


def _one_by_one(take: Take, people: Sequence[int]) -> Iterator[tuple[Take, str]]:
    """A take of each person, and a name for files that no other has."""
    names = _safe_names(take.subject_names)
    for row in people:
        yield take.of_subjects([row]), names[row]


def _safe_names(subjects: Sequence[str]) -> list[str]:
    names: list[str] = []
    for row, subject in enumerate(subjects):
        name = safe_name(subject)
        names.append(f"{name}_{row + 1}" if name in names else name)
    return names


def _written(format: TakeFormat, take: Take, path: Path, options: ExportOptions) -> list[Path]:
    """One file, or `x.part1.c3d`, `x.part2.c3d` where the format holds no more frames."""
    frames = len(take.timestamps_ns)
    step = format.max_frames or frames
    if frames <= step:
        format.write(take, path, options)
        return [path]
    paths: list[Path] = []
    for first in range(0, frames, step):
        part = take.of_frames(first, first + step)
        if part.tracked.any():
            paths.append(path.with_name(f"{path.stem}.part{first // step + 1}{path.suffix}"))
            format.write(part, paths[-1], options)
    return paths
