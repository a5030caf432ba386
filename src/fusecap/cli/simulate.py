"""`fusecap simulate`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from fusecap.cli.common import Json, check_choice, print_json
from fusecap.cli.terminal import console, progress, styled, wrote
from fusecap.errors import InputError

if TYPE_CHECKING:
    from fusecap.evaluate.scene_motion import MotionClip
    from fusecap.evaluate.simulator import CameraTiming, Person
    from fusecap.geometry.camera import Rig

EXAMPLE = (
    "Example: fusecap simulate walk.bvh 02_08.amc --out duo --cameras 6 --imus 6 "
    "--camera-offsets 0,0.004,0.011,0,0.002,0.007 --seed 3"
)
_BYSTANDERS_M = 3.0
_SPACING_M = 1.5
_MARGIN_M = 0.7


def simulate(
    motion: Annotated[
        list[Path],
        typer.Argument(
            help="Motion of the subjects: .bvh, .amc (its .asf beside it), exponential maps "
            "(.txt) or a take (.npz).",
            show_default=False,
        ),
    ],
    out: Annotated[Path, typer.Option(help="Folder of the session to write.", show_default=False)],
    bystander: Annotated[
        list[Path] | None, typer.Option(help="Motion of someone who is not to be tracked.")
    ] = None,
    cameras: Annotated[int, typer.Option(min=0, max=64, help="How many.")] = 4,
    layout: Annotated[str, typer.Option(help="ring, or arc: 120 degrees of it.")] = "ring",
    radius: Annotated[float, typer.Option(min=1.0, help="Of the ring or arc, in metres.")] = 5.0,
    rig: Annotated[
        Path | None, typer.Option(help="Calibration of cameras of your own (y up, metres).")
    ] = None,
    imus: Annotated[str, typer.Option(help="13, 6, 0, or bones with commas between.")] = "13",
    rate: Annotated[float, typer.Option(min=1.0, max=1000.0, help="Of truth and IMUs [Hz].")] = 60,
    camera_rate: Annotated[
        str | None, typer.Option(help="Of the cameras [Hz]: one, or one each; default --rate.")
    ] = None,
    camera_offsets: Annotated[
        str | None, typer.Option(help="When each camera's first frame is exposed, in seconds.")
    ] = None,
    seconds: Annotated[float | None, typer.Option(min=0.1, help="Only the first.")] = None,
    height: Annotated[
        str | None, typer.Option(help="Of the subjects in metres: one, or one each; default 1.75.")
    ] = None,
    seed: Annotated[int, typer.Option(min=0, help="The same seed gives the same bits.")] = 0,
    as_json: Json = False,
) -> None:
    """Write a session with known truth: motion before simulated cameras, in simulated IMUs."""
    from fusecap.body.landmarks import landmark_set_named
    from fusecap.evaluate import simulator
    from fusecap.evaluate.simulated_session import write_session

    check_choice("--layout", layout, ("ring", "arc"))
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise InputError(f"{out} is there already and not empty; name another folder")
    views = _rig(rig, cameras, layout, radius)
    timing = _timing(len(views), rate, camera_rate, camera_offsets)
    people, volume_m = _people(motion, bystander or [], imus, height, rate, seconds)
    with progress(quiet=as_json) as show:
        simulation = simulator.simulate(
            people,
            views,
            landmark_set_named("body25"),
            rate_hz=rate,
            seed=seed,
            name=out.resolve().name,
            volume_m=volume_m,
            timing=timing,
            progress=show,
        )
        session = write_session(simulation, out, progress=show)
    subjects = [person.name for person in simulation.subjects]
    frames = len(simulation.truth.timestamps_ns)
    if as_json:
        print_json(
            {
                "simulated": True,
                "session": str(session),
                "truth": str(out / "truth.npz"),
                "subjects": subjects,
                "bystanders": [person.name for person in people if person.bystander],
                "cameras": list(views.names),
                "imus": {name: list(worn.bones) for name, worn in simulation.imus.items()},
                "frames": frames,
                "rate_hz": rate,
                "seed": seed,
            }
        )
        return
    console.print(
        styled(
            ("Simulated", "bold"),
            f": {len(subjects)} subjects ({', '.join(subjects)}), "
            f"{len(people) - len(subjects)} bystanders, {len(views)} cameras, {frames} instants",
        )
    )
    wrote(session)
    console.print(f"next: fusecap solve {out}", soft_wrap=True)


def _rig(path: Path | None, cameras: int, layout: str, radius_m: float) -> Rig:
    from fusecap.evaluate.simulator import camera_ring
    from fusecap.sources.calibration_files import load_rig

    if path is not None:
        return load_rig(path)
    span_deg = 120.0 if layout == "arc" else 360.0
    return camera_ring(cameras, radius_m=radius_m, span_deg=span_deg)


def _timing(
    cameras: int, rate_hz: float, rates: str | None, offsets: str | None
) -> list[CameraTiming]:
    from fusecap.evaluate.simulator import CameraTiming

    rates_hz = _each("--camera-rate", rates, cameras, rate_hz)
    offsets_s = _each("--camera-offsets", offsets, cameras, 0.0)
    return [CameraTiming(rate_hz=r, offset_s=o) for r, o in zip(rates_hz, offsets_s, strict=True)]


def _each(option: str, text: str | None, count: int, default: float) -> list[float]:
    """One number for all, or one for each."""
    if text is None:
        return [default] * count
    try:
        values = [float(part) for part in text.split(",")]
    except ValueError:
        raise typer.BadParameter(f"'{text}': expected numbers", param_hint=option) from None
    if len(values) not in (1, count):
        raise typer.BadParameter(
            f"'{text}' are {len(values)} numbers; expected one, or {count}", param_hint=option
        )
    return values * count if len(values) == 1 else values


def _bones(text: str) -> tuple[str, ...]:
    from fusecap.body.skeleton import PAPER21
    from fusecap.evaluate.imu_noise import IMUS_6, IMUS_13

    known = {"0": (), "6": IMUS_6, "13": IMUS_13}
    if text in known:
        return known[text]
    bones = tuple(part.strip() for part in text.split(","))
    for bone in bones:
        check_choice("--imus", bone, PAPER21.bone_names)
    if len(set(bones)) != len(bones):
        raise typer.BadParameter(f"'{text}' names a bone twice", param_hint="--imus")
    return bones


def _people(
    motion: list[Path],
    bystanders: list[Path],
    imus: str,
    height: str | None,
    rate_hz: float,
    seconds: float | None,
) -> tuple[list[Person], tuple[float, float, float, float] | None]:
    """Everyone in one room, and the volume that bystanders stay out of."""
    import numpy as np

    from fusecap.evaluate.scene_motion import load_motion, spread_out
    from fusecap.evaluate.simulator import Person, placed

    bones = _bones(imus)
    clips = [clip for path in motion for clip in load_motion(path)]
    others = [clip for path in bystanders for clip in load_motion(path)]
    if height is not None:
        heights = _each("--height", height, len(clips), 0.0)
        clips = [clip.of_height(h) for clip, h in zip(clips, heights, strict=True)]
    duration_s = min(clip.duration_s for clip in (*clips, *others))
    if seconds is not None:
        if seconds > duration_s:
            raise InputError(f"--seconds {seconds:g}: the shortest motion has {duration_s:.2f} s")
        duration_s = seconds
    places = [
        *spread_out(clips, spacing_m=_SPACING_M, circle_m=0.0),
        *spread_out(others, spacing_m=_SPACING_M, circle_m=_BYSTANDERS_M),
    ]
    names = _names([*clips, *others])
    people = []
    for index, (clip, place) in enumerate(zip((*clips, *others), places, strict=True)):
        theta = clip.at_rate(rate_hz, duration_s)
        subject = index < len(clips)
        people.append(
            Person(
                name=names[index],
                shape=clip.shape,
                theta=theta if place is None else placed(theta, centre_m=place),
                imu_bones=bones if subject else (),
                bystander=not subject,
            )
        )
    if not others:
        return people, None
    paths = np.concatenate([person.theta[:, [0, 2]] for person in people[: len(clips)]])
    low = np.round(paths.min(axis=0) - _MARGIN_M, 2)
    high = np.round(paths.max(axis=0) + _MARGIN_M, 2)
    return people, (float(low[0]), float(high[0]), float(low[1]), float(high[1]))


def _names(clips: list[MotionClip]) -> list[str]:
    names: list[str] = []
    for clip in clips:
        name, number = clip.name, 2
        while name in names:
            name, number = f"{clip.name}_{number}", number + 1
        names.append(name)
    return names
