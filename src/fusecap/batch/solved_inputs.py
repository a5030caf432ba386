"""What a take was solved from, found again: its session, or the recording of its live run."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from fusecap.batch.solve import Instants, SessionInstants
from fusecap.batch.stored_instants import StoredInstants
from fusecap.checks import check_measurements
from fusecap.errors import FusecapError
from fusecap.findings import Finding
from fusecap.progress import Progress
from fusecap.recording.layout import SUFFIX
from fusecap.recording.reader import Recording
from fusecap.setup import Setup, setup_of
from fusecap.sources.session import FILE_NAME
from fusecap.sources.session_cameras import with_detections
from fusecap.sources.session_data import content_hash, open_session
from fusecap.sources.session_file import load_session
from fusecap.stored_take import StoredTake
from fusecap.take import Take


@dataclass(frozen=True, kw_only=True)
class SolvedInputs:
    """Opened anew."""

    setup: Setup
    instants: Instants
    sha256: str
    findings: tuple[Finding, ...] = ()
    """What is odd about a session; of a recording nothing is checked."""


def inputs_beside(path: Path, take: Take | StoredTake) -> tuple[Path | None, str]:
    """The session or recording in a take's folder that it was solved from, or why there is none.

    A recording has its samples in itself.
    """
    if path.suffix == SUFFIX:
        return path, ""
    expected = take.provenance.get("session_sha256")
    if not expected:
        return None, "the take does not say what it was solved from; name it with --session"
    told = Path(str(take.provenance.get("recording") or "")).name
    stem = path.stem.removesuffix("-interrupted").removesuffix("-as-live")
    recording = path.with_name(told) if told else path.with_name(stem + SUFFIX)
    if not recording.is_file():
        recording = path.with_name(stem + SUFFIX)
    session = path.with_name(FILE_NAME)
    changed = ""
    try:
        if recording.is_file():
            if Recording(recording).sha256() == expected:
                return recording, ""
            changed = f"{recording.name} beside the take is not what it was solved from"
        if session.is_file():
            if content_hash(with_detections(load_session(session))) == expected:
                return session, ""
            changed = f"{FILE_NAME} beside the take, or a file it names, is not as it was solved"
    except FusecapError as error:
        changed = f"what stands beside the take cannot be opened: {error}"
    nothing = "its session does not stand beside the take"
    return None, f"{changed or nothing}; name it with --session"


def open_solved_inputs(path: Path, progress: Progress | None = None) -> SolvedInputs:
    """A session (its file or folder) or a recording (.mcap); raises `InputError`."""
    if path.suffix == SUFFIX:
        recording = Recording(path)
        instants = StoredInstants(recording, progress)
        return SolvedInputs(setup=instants.setup, instants=instants, sha256=recording.sha256())
    data = open_session(load_session(path), progress)
    checked = check_measurements(data.session, data.rig, data.keypoints, data.samples, data.times_s)
    return SolvedInputs(
        setup=setup_of(data.session, data.rig, data.landmarks),
        instants=SessionInstants(data),
        sha256=data.content_hash,
        findings=(*data.findings, *checked.sorted()),
    )
