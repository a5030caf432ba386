"""`fusecap evaluate session`, `totalcapture`, `human36m`, `shelf`, `panoptic`: the user's own data.

Each loads, solves with default options, scores, prints a table and writes it as Markdown, CSV and
JSON. docs/datasets.md says which files belong where.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Annotated

import typer

from fusecap.cli.common import Json, SessionPath, check_choice, print_json
from fusecap.cli.terminal import console, note, progress, table_of, wrote
from fusecap.errors import InputError

if TYPE_CHECKING:
    from fusecap.evaluate.datasets.recording import DatasetSequence
    from fusecap.evaluate.datasets.score import TruthScore
    from fusecap.evaluate.tables import Table

Folder = Annotated[
    Path, typer.Argument(help="The data set's folder, see docs/datasets.md.", show_default=False)
]
Out = Annotated[Path, typer.Option(help="Folder for the table: Markdown, CSV, JSON.")]
_OUT = Path("evaluation")


def add_to(app: typer.Typer) -> None:
    """Add the commands to `fusecap evaluate`."""
    for command, example in (
        (session, "session recordings/duo"),
        (totalcapture, "totalcapture TotalCapture --sequences 'S1 walking2,S5 acting3'"),
        (human36m, "human36m Human36M --monocular"),
        (shelf, "shelf Shelf"),
        (panoptic, "panoptic Panoptic/160906_band2"),
    ):
        app.command(epilog=f"Example: fusecap evaluate {example}")(command)


def session(
    session: SessionPath,
    truth: Annotated[
        Path | None, typer.Option(help="The true take; default: truth.npz beside session.toml.")
    ] = None,
    out: Out = _OUT,
    as_json: Json = False,
) -> None:
    """Solve a session and score it against its truth, as `fusecap simulate` writes it."""
    from fusecap.batch.solve import solve_session
    from fusecap.evaluate.datasets.session import session_table
    from fusecap.evaluate.score import main_figures, score_take
    from fusecap.sources.session_data import open_session
    from fusecap.sources.session_file import load_session
    from fusecap.stored_take import load_take

    loaded = load_session(session)
    known = load_take(truth or loaded.folder / "truth.npz")
    with progress(quiet=as_json) as show:
        solved = solve_session(open_session(loaded, show), progress=show)
        take = solved.whole_take
    _notes(solved.report.notes, as_json)
    score = score_take(take, known)
    simulated = bool(known.provenance.get("simulated"))
    table = session_table(score, loaded.settings.name, simulated=simulated)
    _report(table, out, "session", as_json, main_figures(score))


def totalcapture(
    folder: Folder,
    sequences: Annotated[
        str | None, typer.Option(help="Such as 'S1 walking2,S5 acting3'; default: the test takes.")
    ] = None,
    skeleton: Annotated[str, typer.Option(help="paper21 or extended23.")] = "paper21",
    out: Out = _OUT,
    as_json: Json = False,
) -> None:
    """Total Capture: position and orientation error per sequence, 8 cameras and 13 IMUs."""
    from fusecap.body.skeleton import SKELETONS, skeleton_named
    from fusecap.evaluate.datasets.total_capture import (
        TEST_SEQUENCES,
        list_sequences,
        load_sequence,
    )

    check_choice("--skeleton", skeleton, tuple(SKELETONS))
    found = {each.key: each for each in list_sequences(folder)}
    chosen = _chosen(sequences, found, [k for k in found if k.split()[1] in TEST_SEQUENCES])
    recordings = (load_sequence(found[key], skeleton=skeleton_named(skeleton)) for key in chosen)
    scores = _scores(recordings, as_json)
    _report(_table("Total Capture", scores), out, "totalcapture", as_json)


def human36m(
    folder: Folder,
    monocular: Annotated[
        bool, typer.Option("--monocular", help="One camera at a time; read the Procrustes column.")
    ] = False,
    actions: Annotated[
        str | None, typer.Option(help="Such as 'S9 Directions 1,S11 Sitting'; default: all.")
    ] = None,
    out: Out = _OUT,
    as_json: Json = False,
) -> None:
    """Human3.6M, subjects S9 and S11: joint position error per activity."""
    from fusecap.evaluate.datasets.human36m import list_takes, load_take36, read_rig

    takes = {f"{take.subject} {take.action}": take for take in list_takes(folder)}
    chosen = _chosen(actions, takes, list(takes))

    def recordings() -> Iterable[DatasetSequence]:
        for key in chosen:
            rig = read_rig(folder / "cameras.json", takes[key].subject)
            for cameras in [[name] for name in rig.names] if monocular else [list(rig.names)]:
                yield load_take36(folder, takes[key], cameras)

    activity = {key: takes[key].activity for key in chosen}
    scores = [(activity[name], score) for name, score in _scores(recordings(), as_json)]
    how = "one camera" if monocular else "4 cameras"
    _report(_table(f"Human3.6M, {how}", scores, averaged=True), out, "human36m", as_json)


def shelf(folder: Folder, out: Out = _OUT, as_json: Json = False) -> None:
    """Shelf or Campus: 3D PCP per actor and kind of limb."""
    from fusecap.evaluate.datasets.shelf import (
        load_shelf,
        load_shelf_truth,
        pcp_table,
        score_people,
    )

    truth = load_shelf_truth(folder)
    recording = load_shelf(folder)
    with progress(quiet=as_json) as show:
        take = recording.solve(show)
    _report(pcp_table(recording.name, score_people(take, truth)), out, "shelf", as_json)


def panoptic(folder: Folder, out: Out = _OUT, as_json: Json = False) -> None:
    """CMU Panoptic: position error of the 19 joints of everyone."""
    from fusecap.evaluate.datasets.panoptic import load_panoptic

    scores = _scores([load_panoptic(folder)], as_json)
    _report(_table("CMU Panoptic", scores), out, "panoptic", as_json)


def _scores(recordings: Iterable[DatasetSequence], as_json: bool) -> list[tuple[str, TruthScore]]:
    from fusecap.evaluate.datasets.score import score_truth

    scores = []
    for recording in recordings:
        assert recording.truth is not None
        with progress(quiet=as_json) as show:
            take = recording.solve(show)
        _notes(recording.notes, as_json)
        score = score_truth(take, recording.truth, recording.rate_hz)
        scores.append((recording.name, score))
    return scores


def _table(title: str, scores: list[tuple[str, TruthScore]], *, averaged: bool = False) -> Table:
    from fusecap.evaluate.datasets.score import mean_by_name, score_table

    table = score_table(title, scores)
    return mean_by_name(table) if averaged else table


def _chosen(text: str | None, known: Iterable[str], default: list[str]) -> list[str]:
    names = tuple(known)
    if text is None:
        if not default:
            raise InputError(f"no test sequence among {', '.join(names)}; name some")
        return default
    chosen = [part.strip() for part in text.split(",") if part.strip()]
    for name in chosen:
        check_choice("sequence", name, names)
    return chosen


def _notes(notes: Iterable[str], as_json: bool) -> None:
    for text in () if as_json else notes:
        note(text)


def _report(
    table: Table,
    out: Path,
    name: str,
    as_json: bool,
    figures: Mapping[str, float] = MappingProxyType({}),
) -> None:
    """Writes a table, and shows it; `figures` go to `--json` beside it."""
    from fusecap.evaluate.datasets.score import write_table

    files = write_table(table, out, name)
    if as_json:
        print_json({**table.as_json(), **figures, "files": [str(path) for path in files]})
        return
    shown = table_of(*table.columns, title=table.title, title_justify="left")
    for row in table.rows:
        shown.add_row(*(table.shown(value) for value in row))
    console.print(shown)
    if table.note:
        console.print(table.note, soft_wrap=True)
    wrote(*files)
