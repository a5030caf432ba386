"""Reading `session.toml`: that it can be read, that its files exist, and what is wrong with it.

It opens none of the named files but the sensors' calibration.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from fusecap.errors import SessionError
from fusecap.inputs import SESSION, read_toml
from fusecap.sources.imu_calibration_files import read_imu_calibration
from fusecap.sources.session import FILE_NAME, Session


def load_session(path: Path | str) -> Session:
    """Reads a session file, or the `session.toml` of a folder; raises `SessionError`.

    The error lists everything that is wrong, one line each, missing files included.
    """
    session = parse_session(path)
    missing = missing_files(session)
    if missing:
        raise SessionError("\n".join(f"{session.path}: {line}" for line in missing))
    return with_imu_calibration(session)


def with_imu_calibration(session: Session) -> Session:
    """The session with the sensors' constants of its `imu_calibration`; raises `SessionError`."""
    path = session.settings.imu_calibration
    if path is None:
        return session
    found = {(imu.subject, imu.bone): imu for imu in read_imu_calibration(path)}
    known = {(subject.name, imu.bone) for subject in session.subjects for imu in subject.imus}
    for subject, bone in found.keys() - known:
        raise SessionError(
            f"{path}: holds imu '{bone}' of '{subject}', which {session.path} does not have; "
            "calibrate this session with: fusecap calibrate imu"
        )
    subjects = []
    for subject in session.subjects:
        imus = []
        for imu in subject.imus:
            own = found.get((subject.name, imu.bone))
            update = (
                {}
                if own is None
                else {
                    "bone_from_imu_wxyz": own.bone_from_imu_wxyz,
                    "heading_deg": own.heading_deg,
                }
            )
            imus.append(imu.model_copy(update=update))
        subjects.append(subject.model_copy(update={"imus": tuple(imus)}))
    return session.model_copy(update={"subjects": tuple(subjects)})


def parse_session(path: Path | str) -> Session:
    """`load_session` without looking whether the files it names exist."""
    file = session_file(path)
    data = read_toml(file, SESSION)
    try:
        return Session.model_validate(data, context={"file": file})
    except ValidationError as error:
        raise SessionError(_readable(error, file, data)) from None


def session_file(path: Path | str) -> Path:
    """The session file that `path` (a file or its folder) means; raises `SessionError`."""
    path = Path(path)
    file = path / FILE_NAME if path.is_dir() else path
    if not file.exists():
        raise SessionError(
            f"{file}: no such file; expected a session file or a folder with a {FILE_NAME}"
        )
    return file


def missing_files(session: Session) -> list[str]:
    """One line per file or folder that the session names and that is not there."""
    lines = []

    def check(where: str, path: Path | None, *, or_folder: bool) -> None:
        if path is None:
            return
        kind = "file or folder" if or_folder else "file"
        if not path.exists():
            lines.append(f"{where}: no {kind} {path}; check the path (relative to {FILE_NAME})")
        elif not or_folder and not path.is_file():
            lines.append(f"{where}: {path} is not a {kind}")

    check("[session] calibration", session.settings.calibration, or_folder=True)
    check("[session] landmark_offsets", session.settings.landmark_offsets, or_folder=False)
    check("[session] imu_calibration", session.settings.imu_calibration, or_folder=False)
    check("[session] sync", session.settings.sync, or_folder=False)
    for camera in session.cameras:
        check(f"[[camera]] '{camera.name}' keypoints", camera.keypoints, or_folder=True)
        check(f"[[camera]] '{camera.name}' video", camera.video, or_folder=False)
    for subject in session.subjects:
        for imu in subject.imus:
            where = f"[[subject]] '{subject.name}' imu '{imu.bone}'"
            check(f"{where} file", imu.file, or_folder=False)
            check(f"{where} static_file", imu.static_file, or_folder=False)
    return lines


def input_files(session: Session) -> list[Path]:
    """The session file and all files and folders that it names, or that stand for its videos."""
    settings = session.settings
    named = [settings.calibration, settings.landmark_offsets]
    named += [settings.imu_calibration, settings.sync]
    for camera in session.cameras:
        named += [camera.video, camera.keypoints or session.detection_folder(camera)]
    for subject in session.subjects:
        named += [file for imu in subject.imus for file in (imu.file, imu.static_file)]
    folders = [path for path in named if path is not None and path == settings.calibration]
    inside = [file for folder in folders if folder.is_dir() for file in folder.iterdir()]
    return [session.path, *(path for path in named if path is not None), *inside]


_EXPECTED = {
    "missing": "missing; this key is required",
    "float_type": "found {found}, expected a number",
    "int_type": "found {found}, expected a whole number",
    "bool_type": "found {found}, expected true or false",
    "string_type": "found {found}, expected text in quotes",
    "path_type": "found {found}, expected a path in quotes",
    "string_too_short": "found an empty text",
    "finite_number": "found {found}, expected a finite number",
    "tuple_type": "found {found}, expected a list",
    "greater_than_equal": "found {found}, expected at least {ge}",
    "model_type": "found {found}, expected a table",
    "dict_type": "found {found}, expected a table",
}


def _readable(error: ValidationError, file: Path, data: Mapping[str, Any]) -> str:
    lines = []
    for item in error.errors():
        where = _where(item["loc"], data)
        text = _EXPECTED.get(item["type"], item["msg"])
        found = item.get("input")
        if item["type"] == "tuple_type" and isinstance(found, dict):
            text = f"found a single table; write [[{'.'.join(map(str, item['loc']))}]]"
        if item["type"] == "model_type" and isinstance(found, list):
            text = f"found a list of tables; write [{'.'.join(map(str, item['loc']))}]"
        context = {"found": repr(found), **item.get("ctx", {})}
        if text is _EXPECTED.get(item["type"]):
            text = text.format_map(context)
        lines += [f"{file}: {where}{': ' if where else ''}{line}" for line in text.splitlines()]
    return "\n".join(lines)


def _where(loc: tuple[int | str, ...], data: Any) -> str:
    """`("camera", 1, "rate_hz")` as "[[camera]] 'left' rate_hz"."""
    words, tables = [], ""
    for part in loc:
        below = None
        if isinstance(data, Mapping) and isinstance(part, str):
            below = data.get(part)
        elif isinstance(data, list) and isinstance(part, int) and part < len(data):
            below = data[part]
        if isinstance(part, int):
            label = below.get("name", below.get("bone")) if isinstance(below, Mapping) else None
            words.append(f"'{label}'" if isinstance(label, str) else f"no. {part + 1}")
        elif isinstance(below, list) and any(isinstance(entry, Mapping) for entry in below):
            tables = f"{tables}.{part}" if tables else part
            words.append(f"[[{tables}]]")
        elif len(words) == 0:
            words.append(f"[{part}]")
        else:
            words.append(part)
        data = below
    return " ".join(words)
