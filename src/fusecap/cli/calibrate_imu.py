"""`fusecap calibrate imu`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from fusecap.cli.calibrations import (
    Write,
    check_stated,
    coloured,
    from_folder_of,
    output_of,
    print_use,
)
from fusecap.cli.common import Json, SessionPath, check_choice, print_json
from fusecap.cli.terminal import console, note, progress, remark, styled, table_of, wrote

if TYPE_CHECKING:
    from fusecap.calibrate.imus.identify import Identity
    from fusecap.calibrate.imus.motion import SubjectCalibration
    from fusecap.calibrate.imus.tpose import TPose
    from fusecap.sources.imu_calibration_files import CalibratedImu

EXAMPLE = "Example: fusecap calibrate imu recordings/duo --write"


def imu(
    session: SessionPath,
    source: Annotated[
        str, typer.Option("--from", help="motion that the cameras saw, or tpose.")
    ] = "motion",
    take: Annotated[
        Path | None,
        typer.Option(help="A take of the same motion; without, the cameras are solved."),
    ] = None,
    optical: Annotated[
        bool,
        typer.Option("--optical", help="The take observes all axes of all bones, as markers do."),
    ] = False,
    identify: Annotated[
        bool, typer.Option("--identify", help="Only tell which sensor is on which bone.")
    ] = False,
    out: Annotated[
        Path | None,
        typer.Option(
            help="The calibration to write, imu_calibration.toml; pictures go beside it.",
            show_default=False,
        ),
    ] = None,
    write: Write = False,
    as_json: Json = False,
) -> None:
    """How sensors sit on their bones; a session uses the result as imu_calibration.

    Residuals are measured on stretches of time that were left out.
    """
    from fusecap.calibrate.imus import session as calibration
    from fusecap.sources.session_file import load_session
    from fusecap.stored_take import load_take

    check_choice("--from", source, ("motion", "tpose"))
    if source == "tpose" and (take is not None or optical or identify):
        raise typer.BadParameter(
            "a T-pose needs no motion; leave out --take, --optical and --identify",
            param_hint="--from",
        )
    if optical and take is None:
        raise typer.BadParameter(
            "needs --take: cameras do not observe all axes", param_hint="--optical"
        )
    if identify and write:
        raise typer.BadParameter("--identify changes nothing", param_hint="--write")
    check_stated(out, write)
    loaded = load_session(session)
    file = output_of(loaded.path, out, write, "imu_calibration.toml")
    result = _Result(session=loaded.path, file=file, write=write, as_json=as_json)
    calibration.wearers(loaded)
    if source == "tpose":
        _report_tpose(calibration.calibrate_from_tpose(loaded), result)
        return
    with progress(quiet=as_json) as show:
        data = None if optical else calibration.camera_data(loaded, show)
        motion = load_take(take) if take else calibration.seen_by_cameras(loaded, data, show)
        reference = calibration.references(loaded, motion, optical=optical)
        found = (
            None
            if identify
            else calibration.calibrate_from_motion(loaded, reference, motion, data, show)
        )
    if found is None:
        _report_identities(calibration.identify_sensors(loaded, reference), as_json)
    else:
        _report(found, result)


@dataclass(frozen=True, kw_only=True)
class _Result:
    """Where the calibration goes, and who is told."""

    session: Path
    file: Path
    write: bool
    """Whether the session is made to use it."""
    as_json: bool

    def save(self, imus: list[CalibratedImu], origin: str) -> list[Path]:
        """The files written; none without sensors."""
        from fusecap.files import write_whole
        from fusecap.sources.imu_calibration_files import imu_calibration_toml
        from fusecap.sources.session_edit import edit_session

        if not imus:
            return []
        write_whole(self.file, imu_calibration_toml(imus, origin=origin))
        if self.write:
            edit_session(self.session, {"imu_calibration": self.file.name})
        return [self.file]

    def print(self, files: list[Path]) -> None:
        wrote(*files)
        if files:
            named = from_folder_of(self.session, self.file)
            by_hand = f'imu_calibration = "{named}" under [session]'
            print_use(self.session, self.write, by_hand)
        else:
            remark(("nothing was written", "red"), "no sensor could be calibrated")


def _report(found: tuple[SubjectCalibration, ...], result: _Result) -> None:
    from dataclasses import asdict

    from fusecap.calibrate.imus.session import calibrated_imus
    from fusecap.calibrate.pictures import plot_sensors
    from fusecap.files import safe_name

    imus = calibrated_imus(found)
    seconds = ", ".join(f"{each.duration_s:.1f} s of '{each.subject}'" for each in found)
    files = result.save(imus, f"motion: {seconds}")
    for each in found:
        if each.sensors:
            picture = result.file.with_name(f"{result.file.stem}_{safe_name(each.subject)}.png")
            plot_sensors(each, picture)
            files.append(picture)
    if result.as_json:
        subjects = [
            {key: value for key, value in asdict(each).items() if key != "series"} for each in found
        ]
        print_json({"subjects": subjects, "files": [str(file) for file in files]})
    else:
        for each in found:
            _print_subject(each)
        result.print(files)
    if not imus:
        raise typer.Exit(1)


def _print_subject(found: SubjectCalibration) -> None:

    lag = f", sensors {found.lag_s:+.2f} s late" if found.lag_s else ""
    console.print(
        styled(
            (found.subject, "bold"),
            f": {found.duration_s:.1f} s seen{lag}; angular speeds of cameras "
            f"and sensors correlate by {found.speed_correlation:.2f}",
        ),
        soft_wrap=True,
    )
    table = table_of(
        "bone",
        "R_ib w x y z",
        "heading",
        "sigma xyz",
        "held out",
        "verdict",
        box=None,
        padding=(0, 1, 0, 0),
    )
    for column in table.columns[1:-1]:
        column.justify = "right"
    for column in table.columns:
        column.no_wrap = True
    for sensor in found.sensors:
        table.add_row(
            sensor.bone,
            " ".join(f"{value:5.2f}" for value in sensor.bone_from_imu_wxyz),
            f"{sensor.heading_deg:.1f}",
            " ".join(f"{min(value, 180):2.0f}" for value in sensor.sigma_deg),
            f"{sensor.held_out_deg:.1f}",
            styled(coloured(sensor.verdict)),
        )
    console.print(table)
    console.print(
        "  degrees; sigma: uncertainty about the bone's x, y, z; held out: median angle between "
        "sensor and cameras on stretches that were left out",
        soft_wrap=True,
    )
    stated = [each.stated_deg for each in found.sensors if each.stated_deg is not None]
    if stated:
        now = [each.held_out_deg for each in found.sensors if each.stated_deg is not None]
        console.print(
            f"  mean of the medians {sum(now) / len(now):.1f} deg held out, "
            f"{sum(stated) / len(stated):.1f} deg as the session states them",
            soft_wrap=True,
        )
    for sensor in found.sensors:
        if abs(sensor.drift_deg_min) > max(3.0, 3.0 * sensor.drift_sigma_deg_min):
            note(
                f"{sensor.bone}: its heading drifts by "
                f"{sensor.drift_deg_min:.1f} deg a minute; calibrate again for later recordings"
            )
        if sensor.share < 0.9:
            note(
                f"{sensor.bone}: its samples cover {100 * sensor.share:.0f} % of "
                "what the cameras saw"
            )
    advice: dict[tuple[tuple[str, str], str], list[str]] = {}
    for sensor in found.sensors:
        if sensor.remedy:
            why = f"{sensor.fault}; {sensor.remedy}"
            advice.setdefault((coloured(sensor.verdict), why), []).append(sensor.bone)
    for (verdict, why), bones in advice.items():
        remark(verdict, f"{', '.join(bones)}: {why}")
    for sensor in found.skipped:
        remark(("not calibrated", "red"), f"{sensor.bone} ({sensor.file}): {sensor.reason}")


def _report_identities(found: dict[str, tuple[Identity, ...]], as_json: bool) -> None:
    from dataclasses import asdict

    from fusecap.calibrate.imus.identify import SURE

    if as_json:
        subjects = {name: [asdict(each) for each in some] for name, some in found.items()}
        print_json({"subjects": subjects, "sure_margin": SURE})
        return
    for name, identities in found.items():
        console.print(name, style="bold")
        table = table_of("stated", "moves like", "margin", "runner-up", "speed corr.", "is it?")
        for each in identities:
            if each.margin <= SURE:
                told = f"unsure: {each.found} and {each.runner_up} move alike here", "yellow"
            elif each.found != each.stated:
                told = f'write bone = "{each.found}"', "red"
            else:
                told = "as stated", "green"
            table.add_row(
                each.stated,
                each.found,
                f"{each.margin:.2f}",
                each.runner_up,
                f"{each.speed_correlation:.2f}",
                styled(told),
            )
        console.print(table, soft_wrap=True)
    console.print(
        f"  a margin above {SURE:g} is sure; below it, let the subject move one limb at a time, "
        "left and right differently",
        soft_wrap=True,
    )


def _report_tpose(found: list[tuple[CalibratedImu, TPose]], result: _Result) -> None:
    imus = [imu for imu, pose in found if not pose.complaints]
    files = result.save(imus, "T-pose")
    if result.as_json:
        rows = [
            {
                "subject": imu.subject,
                "bone": imu.bone,
                "bone_from_imu_wxyz": imu.bone_from_imu_wxyz,
                "heading_deg": imu.heading_deg,
                "moved_deg": pose.moved_deg,
                "gravity_deg": pose.gravity_deg,
                "complaints": pose.complaints,
            }
            for imu, pose in found
        ]
        print_json({"imus": rows, "files": [str(file) for file in files]})
    else:
        _print_tpose(found)
        result.print(files)
    if not imus:
        raise typer.Exit(1)


def _print_tpose(found: list[tuple[CalibratedImu, TPose]]) -> None:

    table = table_of("subject", "bone", "R_ib w, x, y, z", "moved deg", "gravity deg", "stood")
    for imu, pose in found:
        stood = ("; ".join(pose.complaints), "red") if pose.complaints else "still"
        table.add_row(
            imu.subject,
            imu.bone,
            " ".join(f"{value:6.3f}" for value in imu.bone_from_imu_wxyz),
            f"{pose.moved_deg:.1f}",
            f"{pose.gravity_deg:.1f}",
            styled(stood),
        )
    console.print(table, soft_wrap=True)
    if any(pose.complaints for _, pose in found):
        note(
            "these sensors were left out: choose a stretch of tpose_s in which the "
            "subject stands still; gravity off for all of them is a wrong imu_up"
        )
    console.print(
        "  R_ib is as exact as the subject's T-pose; check it on motion with --from motion",
        soft_wrap=True,
    )
