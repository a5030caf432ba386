"""The commands that Markdown pages print."""

from __future__ import annotations

import re
import shlex
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PAGES = (ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md")))

_FENCED = re.compile(r"^```(\w*)\n(.*?)^```", re.MULTILINE | re.DOTALL)
_INDENTED = re.compile(r"^ {4}(\S.*(?:\n {4,}\S.*)*)", re.MULTILINE)
_SPAN = re.compile(r"(?<!`)`(fusecap [^`]+)`(?!`)")
_BEFORE = re.compile(r"^(?:\$ )?(?:\w+=\S+ )*(?:uv run (?:--(?:extra|group) \w+ |--frozen )*)?")
_FORMATS = re.compile(r"fusecap (?:recording|stream|take) \d|fusecap end")
"""What files and messages call themselves."""
_PLACEHOLDER = re.compile(r"[\[\]…|<>]|\.\.\.")


@dataclass(frozen=True)
class Block:
    """A fenced block of a page."""

    language: str
    text: str


def blocks(page: Path) -> list[Block]:
    """In their order."""
    found = _FENCED.finditer(page.read_text(encoding="utf-8"))
    return [Block(match[1], match[2]) for match in found]


def commands_in(text: str) -> Iterator[tuple[str, str]]:
    """Each `fusecap ...` of a listing, and what is said of it behind two spaces."""
    for line in text.replace("\\\n", " ").splitlines():
        for part in line.split(" && "):
            command, _, said = _BEFORE.sub("", part.strip()).partition("  ")
            # Continued lines are indented.
            while command.startswith("fusecap ") and re.match(r"\s*-", said):
                more, _, said = said.strip().partition("  ")
                command = f"{command} {more}"
            if command.startswith("fusecap "):
                yield command, said.strip(" #")


def commands(page: Path) -> list[str]:
    """All in listings and sentences of a page, but for those that leave something open."""
    text = page.read_text(encoding="utf-8")
    listings = [match[2] for match in _FENCED.finditer(text) if match[1] in ("", "sh")]
    rest = _FENCED.sub("", text)
    listings += [match[1] for match in _INDENTED.finditer(rest)]
    found = [command for listing in listings for command, _ in commands_in(listing)]
    spans = (" ".join(match[1].split()) for match in _SPAN.finditer(rest))
    found += [command for span in spans for command, _ in commands_in(span)]
    said = dict.fromkeys(command for command in found if not _FORMATS.match(command))
    return [command for command in said if not _PLACEHOLDER.search(command)]


def words(command: str) -> list[str]:
    """As a shell would split it, without `fusecap` and what is behind a comment sign."""
    return shlex.split(command, comments=True)[1:]
