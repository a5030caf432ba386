"""`fusecap stream`."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from fusecap.cli.common import Json, print_json
from fusecap.cli.targets import TO_HELP, placed_targets, warn_if_open
from fusecap.cli.terminal import console, err, note, one_line, table_of

if TYPE_CHECKING:
    from fusecap.streams.play_take import PlaybackState, TakePlayer
    from fusecap.streams.stream import Stream

EXAMPLE = "Example: fusecap stream demo/demo.npz --to vmc://127.0.0.1:39539 --to ws --loop"

_ON_TIME = 0.98
"""Share of the take's rate below which a playback did not keep up."""


def stream(
    take: Annotated[Path, typer.Argument(help="A solved take (.npz).", show_default=False)],
    to: Annotated[
        list[str],
        typer.Option(help=TO_HELP, show_default=False),
    ],
    loop: Annotated[
        bool, typer.Option("--loop", help="Start again at the end, until Ctrl-C.")
    ] = False,
    speed: Annotated[float, typer.Option(help="1 is the pace of the recording.")] = 1.0,
    subject: Annotated[
        list[str] | None, typer.Option(help="Only this person. Repeatable.", show_default=False)
    ] = None,
    host: Annotated[
        str | None,
        typer.Option(
            help="Address on which ws serves clients; 0.0.0.0 opens it to other machines. "
            "Without, only this machine can connect.",
            show_default=False,
        ),
    ] = None,
    as_json: Json = False,
) -> None:
    """Play a take into game engines and other programs, live.

    Receivers, ports and axes are in docs/streams.md. Ctrl-C ends it.
    """
    from fusecap.stored_take import load_take
    from fusecap.streams.play_take import TakePlayer, play
    from fusecap.streams.stream import open_stream

    targets = placed_targets(to, host)
    loaded = load_take(take)
    player = TakePlayer(loaded, subjects=subject or (), speed=speed, loop=loop)
    with ExitStack() as closing:
        streams: list[Stream] = []
        for target in targets:
            streams.append(open_stream(target, player.cast, player.rate_hz))
            closing.callback(streams[-1].close)
        simulated = bool(loaded.provenance.get("simulated"))
        if not as_json:
            _announce(player, streams, simulated=simulated)
        for target in targets:
            warn_if_open(target)
        with _status(streams, quiet=as_json) as each_second:
            state = play(player, streams, each_second=each_second)
        remarks = [stream.remark() for stream in streams]
    notes = _notes(player, state)
    if as_json:
        print_json({"simulated": simulated, **_report(state, player, streams, remarks, notes)})
    else:
        _print_end(state, streams, remarks, notes)
    if state.interrupted and not loop:
        raise typer.Exit(130)


def _announce(player: TakePlayer, streams: Sequence[Stream], *, simulated: bool) -> None:
    count = player.frame_count
    length = "in a loop" if count is None else f"{count} frames, {count / player.rate_hz:.1f} s"
    what = "simulated motion" if simulated else "motion"
    console.print(
        f"{what} of {', '.join(player.cast)} at {player.rate_hz:g} frames/s, {length}; "
        "Ctrl-C ends it",
        soft_wrap=True,
    )
    for stream in streams:
        for name, address in stream.where().items() or (("everyone", str(stream.target)),):
            console.print(f"  {name} -> {address}", soft_wrap=True)


@contextmanager
def _status(
    streams: Sequence[Stream], *, quiet: bool
) -> Iterator[Callable[[PlaybackState], None] | None]:
    """A line per second on stderr: overwritten on a terminal, one below the other elsewhere."""
    if quiet:
        yield None
        return
    if not err.is_terminal:
        yield lambda state: err.print(_line(state, streams), soft_wrap=True)
        return
    with one_line() as live:
        yield lambda state: live.update(_line(state, streams), refresh=True)


def _line(state: PlaybackState, streams: Sequence[Stream]) -> str:
    parts = [f"{state.elapsed_s:6.1f} s  {state.rate_hz:.1f} frames/s"]
    for stream in streams:
        counts = stream.counts
        lost = counts.dropped + counts.failed
        part = f"{stream.target.protocol} {counts.sent} sent, {lost} dropped"
        parts.append(part + (f", {counts.refused} refused" if counts.refused else ""))
    return "  |  ".join(parts)


def _notes(player: TakePlayer, state: PlaybackState) -> list[str]:
    """What a user should know about the pace."""
    if state.frames + state.skipped == 0 or state.skipped <= (1 - _ON_TIME) * state.frames:
        return []
    return [
        f"{state.skipped} of {state.frames + state.skipped} frames came too late and were left "
        f"out ({state.rate_hz:.1f} of {player.rate_hz:g} frames/s); stream to fewer receivers or "
        "at a lower --speed"
    ]


def _report(
    state: PlaybackState,
    player: TakePlayer,
    streams: Sequence[Stream],
    remarks: Sequence[str],
    notes: Sequence[str],
) -> dict[str, Any]:
    return {
        **asdict(state),
        "rate_hz": state.rate_hz,
        "take_rate_hz": player.rate_hz,
        "subjects": list(player.cast),
        "streams": [
            {"to": str(stream.target), **asdict(stream.counts), "remark": remark}
            | ({"where": stream.where()} if stream.where() else {})
            for stream, remark in zip(streams, remarks, strict=True)
        ],
        "notes": list(notes),
    }


def _print_end(
    state: PlaybackState,
    streams: Sequence[Stream],
    remarks: Sequence[str],
    notes: Sequence[str],
) -> None:

    console.print(
        f"{state.frames} frames in {state.elapsed_s:.1f} s, {state.rate_hz:.2f} frames/s, "
        f"{state.skipped} left out; sent {state.late_ms_median:.1f} ms after their time "
        f"(median), {state.late_ms_p99:.1f} ms (p99)",
        soft_wrap=True,
    )
    table = table_of("to", "packets sent", "MB", "dropped", "refused", "failed")
    for column in table.columns[1:]:
        column.justify = "right"
    for stream in streams:
        counts = stream.counts
        table.add_row(
            str(stream.target),
            str(counts.sent),
            f"{1e-6 * counts.bytes:.2f}",
            str(counts.dropped),
            str(counts.refused),
            str(counts.failed),
        )
    console.print(table)
    for stream, remark in zip(streams, remarks, strict=True):
        if remark:
            note(f"{stream.target}: {remark}")
    for text in notes:
        note(text)
