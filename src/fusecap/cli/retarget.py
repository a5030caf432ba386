"""`fusecap retarget`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from fusecap.cli.common import Json, named_once, print_json
from fusecap.cli.terminal import console, note, table_of, wrote
from fusecap.files import safe_name

EXAMPLE = "Example: fusecap retarget duo/duo.npz avatar.vrm --subject anna --out anna.glb"


def retarget(
    take: Annotated[
        Path, typer.Argument(help="A solved take (.npz), or the recording (.mcap) of a live run.")
    ],
    character: Annotated[
        Path, typer.Argument(help="A rigged character: .glb, .vrm, or .fbx (needs Blender).")
    ],
    out: Annotated[
        Path | None,
        typer.Option(help="The file to write, .glb, .vrm or .fbx; default beside the take."),
    ] = None,
    subject: Annotated[
        str | None, typer.Option(help="Whose motion; needed where the take has several people.")
    ] = None,
    map: Annotated[
        list[str] | None,
        typer.Option(help="BONE=NAME: the character's name of one of our bones, if not guessed."),
    ] = None,
    as_json: Json = False,
) -> None:
    """Put a person's motion onto a character of your own: its proportions, feet that stand.

    Bones are matched by VRM's map or by their names, and shown.
    """
    from fusecap.batch.replay import opened_take
    from fusecap.exports.characters.retarget import retarget as onto
    from fusecap.exports.made_files import list_made, made_stem
    from fusecap.exports.take_files import held_pose

    whose = "" if subject is None else f"_{safe_name(subject)}"
    stem = f"{made_stem(take)}{whose}_{safe_name(character.stem)}"
    ending = ".fbx" if character.suffix.lower() == ".fbx" else ".glb"
    notes: list[str] = []
    with opened_take(take, notes.append) as opened:
        done = onto(
            opened,
            character,
            out or take.with_name(stem + ending),
            subject=subject,
            bones=named_once("--map", map, "BONE=NAME"),
        )
        notes += held_pose(opened, done.subject, [done.path.suffix])
    list_made(take, [done.path])
    if as_json:
        told = {"files": [str(done.path)], "bones": done.bones, "scale": done.scale}
        print_json({**told, "notes": notes})
        return
    table = table_of("ours", "the character's")
    for bone, name in done.bones.items():
        table.add_row(bone, name)
    console.print(table)
    console.print(f"  ways through the room are scaled by {done.scale:.3f}, as legs are")
    for text in notes:
        note(text)
    wrote(done.path)
