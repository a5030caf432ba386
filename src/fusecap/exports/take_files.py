"""A take in the formats of other programs.

A file's name says what is not the usual thing: `duo_anna.bvh` is in metres, `duo_anna.cm.bvh` in
centimetres, `duo.mixamo.glb` has Mixamo's bones. Names of people hold no dot, so no two of these
are ever the same file.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from fusecap.body.rigs import rig_preset
from fusecap.errors import InputError, TakeError, nearest
from fusecap.exports.formats import FORMATS, format_named
from fusecap.exports.take_format import UNITS_PER_M, AnyTake, ExportOptions, TakeFormat
from fusecap.files import distinct_names

_SPANS_TOLD = 3


@dataclass(frozen=True, slots=True, kw_only=True)
class TakeFile:
    """One file of an export, named before it is written."""

    path: Path
    format: TakeFormat
    options: ExportOptions
    rows: tuple[int, ...]
    """Of the subjects in it."""
    frames: tuple[int, int]
    """From the first up to, and without, the second."""

    def write(self, take: AnyTake) -> None:
        """Whole or not at all, of the take that it was planned for."""
        part = take if len(self.rows) == len(take.subject_names) else take.of_subjects(self.rows)
        if self.frames != (0, len(take.timestamps_ns)):
            part = part.of_frames(*self.frames)
        self.format.write(part, self.path, self.options)


def export(
    take: AnyTake,
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
    format, settings = _checked(name, unit, rig, options)
    if format.per_person and len(_people(take)) > 1:
        ending = _unusual(format, settings) + path.suffix
        files = _one_each(take, path.with_name(path.stem), ending, format, settings)
    else:
        files = _together(take, path, format, settings)
    return write_files(take, files)


def export_take(
    take: AnyTake,
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
    return write_files(
        take, _planned(take, Path(folder) / stem, *_checked(format, unit, rig, options))
    )


def plan_files(
    take: AnyTake,
    folder: Path | str,
    *,
    formats: Sequence[str],
    stem: str,
    unit: str | None = None,
    rig: str = "native",
    options: ExportOptions | None = None,
) -> list[TakeFile]:
    """What to write in each format; a unit or a rig goes to the formats that have a choice.

    `stem` begins the files' names: see `made_stem`.
    Raises `InputError` where none of them has that choice.
    """
    chosen = check_formats(formats, unit=unit, rig=rig, options=options)
    base = Path(folder) / stem
    return [file for each in chosen for file in _planned(take, base, *each)]


def check_formats(
    formats: Sequence[str],
    *,
    unit: str | None = None,
    rig: str = "native",
    options: ExportOptions | None = None,
) -> list[tuple[TakeFormat, ExportOptions]]:
    """Each format and what is chosen for it.

    Raises `InputError` for what is not known, for a choice that none of the formats has, and for a
    library or program that one of them needs and that is not there.
    """
    known = {name: _known_format(name) for name in formats}
    if known and unit is not None and not any(unit in format.units for format in known.values()):
        _checked(formats[0], unit, "native", options)
    if known and rig != "native" and not any(format.has_rig for format in known.values()):
        _checked(formats[0], None, rig, options)
    return [
        _checked(
            name,
            unit if unit in format.units else None,
            rig if format.has_rig else "native",
            options,
        )
        for name, format in known.items()
    ]


def write_files(take: AnyTake, files: Iterable[TakeFile]) -> list[Path]:
    """Writes what was planned for the take; returns the paths."""
    paths: list[Path] = []
    for file in files:
        file.write(take)
        paths.append(file.path)
    return paths


def held_poses(take: AnyTake, files: Sequence[TakeFile]) -> list[str]:
    """Of everyone who is not tracked throughout: when, and which files show the last pose then."""
    told = []
    for row, name in enumerate(take.subject_names):
        endings = {f.path.suffix: None for f in files if f.format.holds and row in f.rows}
        if endings:
            told += held_pose(take, name, endings)
    return told


def held_pose(take: AnyTake, subject: str, endings: Iterable[str]) -> list[str]:
    """When files of these endings show the last pose of somebody who is not tracked throughout."""
    tracked = take.tracked[take.subject(subject)]
    if tracked.all() or not tracked.any():
        return []
    edges = np.flatnonzero(np.diff(np.concatenate([[True], tracked, [True]])))
    spans = [(int(first), int(end)) for first, end in edges.reshape(-1, 2)]
    times = [
        f"{take.time_s[first]:.2f}-{take.time_s[end - 1]:.2f}" for first, end in spans[:_SPANS_TOLD]
    ]
    more = f" and {len(spans) - len(times)} more" if len(spans) > len(times) else ""
    return [
        f"'{subject}' is not tracked in {int((~tracked).sum())} frames ({', '.join(times)} s"
        f"{more}): {', '.join(endings)} hold the last pose there"
    ]


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
    format.check_needs()
    return format, replace(options or ExportOptions(), unit=unit or format.units[0], rig=rig)


def _people(take: AnyTake) -> list[int]:
    people = [row for row in range(len(take.subject_names)) if take.tracked[row].any()]
    if not people:
        raise TakeError("nobody is tracked in any frame of the take: there is nothing to export")
    return people


def _planned(
    take: AnyTake, base: Path, format: TakeFormat, options: ExportOptions
) -> list[TakeFile]:
    ending = _unusual(format, options) + format.tag + format.suffix
    if format.per_person:
        return _one_each(take, base, ending, format, options)
    return _together(take, base.with_name(base.name + ending), format, options)


def _unusual(format: TakeFormat, options: ExportOptions) -> str:
    """What a made-up name says of a file that is not the usual one."""
    rig = f".{options.rig}" if options.rig != "native" else ""
    return rig + (f".{options.unit}" if options.unit != format.units[0] else "")


def _together(
    take: AnyTake, path: Path, format: TakeFormat, options: ExportOptions
) -> list[TakeFile]:
    people = _people(take)
    rows = people if format.per_person else range(len(take.subject_names))
    return _in_parts(take, path, format, options, tuple(rows))


def _one_each(
    take: AnyTake, base: Path, ending: str, format: TakeFormat, options: ExportOptions
) -> list[TakeFile]:
    names = distinct_names(take.subject_names)
    return [
        file
        for row in _people(take)
        for file in _in_parts(
            take, base.with_name(f"{base.name}_{names[row]}{ending}"), format, options, (row,)
        )
    ]


def _in_parts(
    take: AnyTake, path: Path, format: TakeFormat, options: ExportOptions, rows: tuple[int, ...]
) -> list[TakeFile]:
    """One file, or `x.part1.c3d`, `x.part2.c3d` where the format holds no more frames."""
    count = len(take.timestamps_ns)
    step = format.max_frames or count
    if count <= step:
        return [TakeFile(path=path, format=format, options=options, rows=rows, frames=(0, count))]
    return [
        TakeFile(
            path=path.with_name(f"{path.stem}.part{first // step + 1}{path.suffix}"),
            format=format,
            options=options,
            rows=rows,
            frames=(first, min(first + step, count)),
        )
        for first in range(0, count, step)
        if take.tracked[list(rows), first : first + step].any()
    ]
