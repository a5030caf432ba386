"""Where commands stream to: `--to` and `--host`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

from fusecap.cli.common import err
from fusecap.errors import InputError

if TYPE_CHECKING:
    from fusecap.streams.target import Target

TO_HELP = (
    "Where to: vmc, livelink, rokoko, osc, each with ://HOST:PORT unless the usual port of this "
    "machine will do; ws (serves WebSocket clients); lsl. Repeatable."
)


def placed_targets(
    to: Sequence[str], host: str | None, *, other_servers: bool = False
) -> list[Target]:
    """What `to` says, with `--host` in place; serving other machines takes that option.

    `other_servers` says that the command serves something else there as well. Raises `InputError`.
    """
    from fusecap.streams.target import is_loopback, parse_target

    targets = [parse_target(text) for text in to]
    if host is not None and not other_servers and all(t.protocol != "ws" for t in targets):
        raise InputError("--host is the address on which ws serves clients; add --to ws")
    placed = [
        replace(target, host=host) if target.protocol == "ws" and host is not None else target
        for target in targets
    ]
    for target in placed:
        if target.protocol == "ws" and host is None and not is_loopback(target.host):
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
    from fusecap.streams.target import is_loopback

    if target.protocol == "ws" and not is_loopback(target.host):
        err.print(
            f"[yellow]note[/] {target} is open: whoever reaches this machine on port "
            f"{target.port} can follow the motion; there is no password and no encryption",
            soft_wrap=True,
        )
