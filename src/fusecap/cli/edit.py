"""`fusecap edit`."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Annotated

import typer

from fusecap.cli.common import Json, length_m, named_once, print_json, set_aside_earlier
from fusecap.cli.terminal import console, note, wrote
from fusecap.errors import InputError

EXAMPLE = (
    "Example: fusecap edit duo/duo.npz --only anna --trim 2:14.5 --fill-gaps 0.2 "
    "--butterworth 6 --floor-shift=-1cm"
)


def edit(
    take: Annotated[
        Path, typer.Argument(help="A solved take (.npz), or the recording (.mcap) of a live run.")
    ],
    out: Annotated[
        Path | None, typer.Option(help="The take to write; default <take>-edited.npz.")
    ] = None,
    only: Annotated[
        list[str] | None, typer.Option(help="A subject that stays; several times for several.")
    ] = None,
    rename: Annotated[list[str] | None, typer.Option(help="OLD=NEW name of a subject.")] = None,
    trim: Annotated[
        str | None, typer.Option(help="START:END in seconds from the take's first frame.")
    ] = None,
    gaps_above: Annotated[
        float | None,
        typer.Option(help="Take out frames whose bones have a mean error bar of more degrees."),
    ] = None,
    fill_gaps: Annotated[float | None, typer.Option(help="Bridge gaps of no more seconds.")] = None,
    butterworth: Annotated[
        float | None, typer.Option(help="Cut-off of a zero-lag fourth-order Butterworth [Hz].")
    ] = None,
    floor_shift: Annotated[
        str | None, typer.Option(help="Raise everybody by a length, such as 2cm; =-2cm lowers.")
    ] = None,
    foot_lock: Annotated[
        float | None, typer.Option(help="0-1: how far standing feet go to where they stand.")
    ] = None,
    as_json: Json = False,
) -> None:
    """Clean up a take; each edit is written into its provenance.

    Edits are done in the order of these options. A solve is smooth already: all instants of a
    person are solved together; the filter is for those who must report one.
    """
    from fusecap.batch.replay import opened_take
    from fusecap.edits.edit import EditOptions, edit_take
    from fusecap.exports.made_files import made_stem
    from fusecap.take import save_take

    target = out or take.with_name(f"{made_stem(take)}-edited.npz")
    if target.suffix != ".npz":
        raise InputError(f"--out {target}: a take is one .npz file")
    if target.resolve() == take.resolve():
        raise InputError(f"--out {target} is the take that is edited: name another file")
    start_s, end_s = _span(trim)
    if out is None and target.exists():
        raise InputError(f"{target} exists: an earlier edit; delete it, or name another with --out")
    options = EditOptions(
        only=tuple(only or ()),
        rename=named_once("--rename", rename, "OLD=NEW"),
        start_s=start_s,
        end_s=end_s,
        gaps_above_deg=gaps_above,
        fill_gaps_s=fill_gaps,
        butterworth_hz=butterworth,
        foot_lock=foot_lock,
        floor_shift_m=_signed_m(floor_shift),
    )
    with opened_take(take, note) as opened:
        earlier = len(opened.provenance.get("edits", ()))
        # Nobody else holds the whole take: what an edit replaces is let go of.
        edited = edit_take(opened.of_frames(0, len(opened.timestamps_ns)), options)
    save_take(edited, target)
    set_aside_earlier(target, [])
    edits = list(edited.provenance["edits"])[earlier:]
    if as_json:
        print_json({"files": [str(target)], "edits": edits})
        return
    for entry in edits:
        told = {key: value for key, value in entry.items() if key not in ("edit", "made_by")}
        console.print(f"  {entry['edit']}: " + ", ".join(f"{k} {v}" for k, v in told.items()))
    wrote(target)


def _span(text: str | None) -> tuple[float | None, float | None]:
    if text is None:
        return None, None
    match = re.fullmatch(r"\s*(\d*\.?\d*)\s*:\s*(\d*\.?\d*)\s*", text)
    try:
        if match is None or not (match[1] or match[2]):
            raise ValueError
        start, end = (float(part) if part else None for part in match.groups())
        return start, end
    except ValueError:
        raise typer.BadParameter(
            f"'{text}': expected START:END in seconds, such as 2:14.5, 2: or :14.5",
            param_hint="--trim",
        ) from None


def _signed_m(text: str | None) -> float | None:
    if text is None:
        return None
    bare = text.strip()
    sign = -1.0 if bare.startswith("-") else 1.0
    return sign * length_m("--floor-shift", bare.lstrip("+-"))
