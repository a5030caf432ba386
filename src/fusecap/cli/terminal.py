"""What the terminal shows: the only commands' room that knows rich.

No text is read as markup, so names, paths and `[session]` are shown as they are; what has a colour
says so with `styled`. Characters that would move the cursor, colour the screen, turn the direction
of writing, or that no terminal can show, are shown by their numbers.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

from rich.console import Console

if TYPE_CHECKING:
    import rich.progress
    from rich.live import Live
    from rich.table import Table
    from rich.text import Text

    from fusecap.progress import Progress

_UNSHOWN = re.compile("[\x00-\x08\x0b-\x1f\x7f-\x9f\u202a-\u202e\u2066-\u2069\ud800-\udfff]")


def shown(text: str) -> str:
    """The text, with the numbers of characters that a terminal would obey or choke on."""
    return _UNSHOWN.sub(lambda found: found[0].encode("unicode_escape").decode("ascii"), text)


class _TextConsole(Console):
    def render_str(self, text: str, **options: Any) -> Text:
        return super().render_str(shown(text), **options)


err = _TextConsole(stderr=True, highlight=False, emoji=False, markup=False)
console = _TextConsole(highlight=False, emoji=False, markup=False)


def styled(*parts: str | tuple[str, str]) -> Text:
    """Strings one after the other, those with a style as (string, style)."""
    from rich.text import Text

    return Text.assemble(
        *((shown(part) if isinstance(part, str) else (shown(part[0]), part[1])) for part in parts)
    )


def note(text: str) -> None:
    """Something that the user should know, on stderr."""
    remark(("note", "yellow"), text)


def remark(word: tuple[str, str], text: str, *, where: Console = err) -> None:
    """A word in its style, and what it is about."""
    where.print(styled(word, " ", text), soft_wrap=True)


def wrote(*files: object) -> None:
    """Names files, each on its line."""
    for file in files:
        console.print(f"wrote {file}", soft_wrap=True)


def table_of(*columns: str, **options: Any) -> Table:
    """A table for `console.print`, with the options of rich's."""
    from rich.table import Table

    return Table(*columns, **options)


def one_line() -> Live:
    """What stands on stderr until it is updated; gone at the end."""
    from rich.live import Live

    return Live(console=err, auto_refresh=False, transient=True)


@contextmanager
def progress(*, quiet: bool, rate: bool = False) -> Iterator[Progress]:
    """A bar with ETA on stderr, one per kind of work; silent with --json.

    With `rate` it also shows how many are done per second.
    """
    from rich.progress import ProgressColumn, Task, TimeRemainingColumn

    class Rate(ProgressColumn):
        def render(self, task: Task) -> Text:
            return styled(f"{task.speed:.1f}/s" if task.speed else "")

    columns = (*((Rate(),) if rate else ()), _words("ETA"), TimeRemainingColumn())
    with _bars("{task.description:<28.28}", *columns, quiet=quiet) as bars:
        tasks: dict[str, Any] = {}

        def show(what: str, done: int, total: int) -> None:
            if what not in tasks:
                tasks[what] = bars.add_task(shown(what), total=total)
            bars.update(tasks[what], completed=done, total=total)

        yield show


def cells_bar(*, quiet: bool) -> rich.progress.Progress:
    """A bar of cells whose tasks have a field `eta`."""
    return _bars("{task.description}", _words("ETA {task.fields[eta]}"), quiet=quiet)


def _bars(what: str, *more: rich.progress.ProgressColumn, quiet: bool) -> rich.progress.Progress:
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TimeElapsedColumn

    columns = (_words(what), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(), *more)
    return Progress(*columns, console=err, disable=quiet, transient=True)


def _words(text: str) -> rich.progress.ProgressColumn:
    from rich.progress import TextColumn

    return TextColumn(text, markup=False)
