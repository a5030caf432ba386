"""Where commands stream to: `--to` and `--host`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

from fusecap.cli.terminal import note
from fusecap.errors import InputError
from fusecap.streams.protocols import NAMES

if TYPE_CHECKING:
    from fusecap.streams.target import Target

TO_HELP = (
    f"Where to: {', '.join(NAMES)}, each with ://HOST:PORT where the usual port of this machine "
    "will not do. docs/streams.md says who understands which. Repeatable."
)


def placed_targets(
    to: Sequence[str], host: str | None, *, other_servers: bool = False
) -> list[Target]:
    """What `to` says, with `--host` in place; serving other machines takes that option.

    `other_servers` says that the command serves something else there as well. Raises `InputError`.
    """
    from fusecap.streams.door import is_loopback, new_token
    from fusecap.streams.target import parse_target, serves

    targets = [parse_target(text) for text in to]
    if host is not None and not other_servers and not any(map(serves, targets)):
        raise InputError("--host is the address on which ws serves clients; add --to ws")
    placed = [
        replace(target, host=host, token=new_token(host))
        if host is not None and serves(target)
        else target
        for target in targets
    ]
    for target in placed:
        if host is None and serves(target) and not is_loopback(target.host):
            raise InputError(
                f"--to {target}: this would let other machines connect; "
                f"if that is meant, add --host {target.host}"
            )
    seen: set[str] = set()
    for target in placed:
        if str(target) in seen:
            raise InputError(f"--to {target} is given twice")
        seen.add(str(target))
    return placed


def warn_if_open(target: Target) -> None:
    """Say so where other machines can connect."""
    if target.token:
        note(
            f"{target} is open to other machines: whoever has the address with its token can "
            f"follow the motion; it is {target.address}, new each time, and nothing is encrypted"
        )
