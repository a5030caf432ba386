"""Names and paths are shown as they are, whatever they hold."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest
from typer.testing import CliRunner

import fusecap.cli
from fusecap.cli import app, terminal
from session_files import edit, ring, write_session

CAMERA = "[/L] cam2"
MARKUP = ("[/", "[bold", "[red", "[green", "[yellow", "[cyan", "[dim")


@pytest.fixture(scope="module")
def session(tmp_path_factory) -> Path:
    """One of its cameras has a name that rich would read as markup."""
    path = write_session(tmp_path_factory.mktemp("bracketed") / "duo [take]")
    old = ring().cameras[1].name
    edit(path, f'name = "{old}"', f'name = "{CAMERA}"')
    edit(path.with_name("calibration.toml"), f"[{old}]", f'["{CAMERA}"]')
    return path


def said(*arguments: object, code: int = 0) -> str:
    """Both streams of a command, without line breaks; it ends with `code`."""
    result = CliRunner().invoke(app, [*map(str, arguments)])
    assert result.exit_code == code, result.output
    return result.output


def test_a_session_is_solved_and_its_files_named_whatever_their_names_hold(session, tmp_path):
    out = tmp_path / "takes [b]" / "duo [take].npz"
    output = said("solve", session, "--out", out, "--export", "bvh")
    assert CAMERA in output
    assert f"wrote {out}" in output
    assert out.is_file()
    assert f"wrote {out.parent}/" in said("export", out)


def test_messages_about_tables_of_the_session_name_them(session, capsys, monkeypatch):
    broken = session.with_name("broken.toml")
    broken.write_text(session.read_text() + "\n[[subject.imu]]\nbone = 3\n")
    monkeypatch.setattr("sys.argv", ["fusecap", "solve", str(broken)])
    with pytest.raises(SystemExit):
        fusecap.cli.main()
    output = capsys.readouterr().err
    assert str(broken) in output
    with terminal.err.capture() as shown:
        terminal.note("imu_calibration under [session] or [[subject.imu]]")
    assert shown.get() == "note imu_calibration under [session] or [[subject.imu]]\n"


def test_progress_and_tables_show_brackets():
    with terminal.cells_bar(quiet=True) as bars:
        bars.add_task(CAMERA, total=1, eta="[red]")
        with terminal.console.capture() as shown:
            terminal.console.print(bars.make_tasks_table(bars.tasks))
    assert CAMERA in shown.get() and "ETA [red]" in shown.get()
    table = terminal.table_of("[session]", title=CAMERA)
    table.add_row("[bold]x")
    with terminal.console.capture() as shown:
        terminal.console.print(table, terminal.styled((CAMERA, "red")))
    assert shown.get().count(CAMERA) == 2
    assert "[session]" in shown.get() and "[bold]x" in shown.get()


def test_what_a_terminal_would_obey_is_shown_by_its_number():
    hostile = "a\x1b[2J\x1b]0;title\x07\r\u202egnp.exe\udcff\x9b1m"
    told = "a\\x1b[2J\\x1b]0;title\\x07\\r\\u202egnp.exe\\udcff\\x9b1m"
    with terminal.err.capture() as shown:
        terminal.note(hostile)
        terminal.err.print(hostile)
    assert shown.get() == f"note {told}\n{told}\n"
    table = terminal.table_of("name")
    table.add_row(hostile)
    with terminal.console.capture() as shown:
        terminal.console.print(table)
        terminal.wrote(f"/tmp/{hostile}.npz")
    assert shown.get().count(told) == 2 and "\x1b" not in shown.get()
    assert terminal.shown("zwei\nZeilen\tüber 人 👩‍👩‍👧") == "zwei\nZeilen\tüber 人 👩‍👩‍👧"


def test_only_one_room_of_the_commands_knows_rich():
    package = Path(fusecap.cli.__file__).parents[1]
    for path in package.rglob("*.py"):
        if path.name in ("terminal.py", "page.py"):  # the viewer's page silences its server's notes
            continue
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            imported = (
                [alias.name for alias in node.names]
                if isinstance(node, ast.Import)
                else [node.module or ""]
                if isinstance(node, ast.ImportFrom)
                else []
            )
            assert not any(name.split(".")[0] == "rich" for name in imported), path
            if path.parent.name == "cli" and isinstance(node, ast.Constant):
                assert not str(node.value).startswith(MARKUP), (path, node.value)
