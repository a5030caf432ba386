"""A first `session.toml` from what a folder holds; what it cannot know is left as a comment."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import suppress
from types import MappingProxyType

from fusecap.body.skeleton import Skeleton, skeleton_named
from fusecap.errors import InputError
from fusecap.sources.folder_survey import FolderSurvey, FoundSensor
from fusecap.sources.toml_text import quoted
from fusecap.sources.video import probe

SKELETON = "paper21"


def draft(found: FolderSurvey, networks: Mapping[str, str] = MappingProxyType({})) -> str:
    """The text of the file; raises `InputError` for a folder without a recording.

    `networks`: keys of `[detector]`, for videos without keypoints.
    """
    if found.nothing:
        raise InputError(
            f"{found.folder}: no video, no keypoint folder and no sensor file; put the recording "
            "into this folder"
        )
    lines = ["[session]", f"name = {quoted(found.folder.resolve().name)}"]
    if found.calibration is not None:
        lines.append(f"calibration = {quoted(found.calibration.as_posix())}{_why(found)}")
        lines += _unit(found)
        if found.calibration.name.endswith((".qca.txt", ".qca")):
            lines.append('up = "z"   # as Qualisys has it')
    elif found.videos or found.keypoints:
        lines += [
            "# fusecap calibrate intrinsics and fusecap calibrate extrinsics write it:",
            '# calibration = "calibration.toml"',
        ]
    lines += _rate(found)
    if networks and {path.stem for path in found.videos} - {*found.keypoints}:
        lines += ["", "[detector]   # what is on this machine: fusecap models list"]
        lines += [f"{key} = {quoted(name)}" for key, name in networks.items()]
    return "\n".join([*lines, *_cameras(found), *_subject(found)]) + "\n"


def _unit(found: FolderSurvey) -> Iterator[str]:
    units = found.calibration_units
    if len(units) > 1:
        apart = ", ".join(f"{apart_m:.2f} m in {unit}" for unit, apart_m in units.items())
        yield f"# which? its cameras stand apart by {apart}:"
    mark = "# " if len(units) > 1 else ""
    for unit in units:
        if unit != "m":
            yield (
                f"{mark}calibration_unit = {quoted(unit)}   # in metres its cameras would not "
                "stand in a room"
            )


def _why(found: FolderSurvey) -> str:
    others = ", ".join(path.as_posix() for path in found.other_calibrations)
    return f"   # places the cameras; not chosen: {others}" if others else ""


def _cameras(found: FolderSurvey) -> Iterator[str]:
    videos = {path.stem: path for path in found.videos}
    for name in sorted({*videos, *found.keypoints}):
        yield from ("", "[[camera]]", f"name = {quoted(name)}")
        if name in videos:
            yield f"video = {quoted(videos[name].as_posix())}"
        if name in found.keypoints:
            yield f"keypoints = {quoted(found.keypoints[name].as_posix())}"
            if found.keypoint_format:
                yield f"format = {quoted(found.keypoint_format)}"
        if found.cameras and name not in found.cameras:
            yield f"# the calibration has no camera of this name, only: {', '.join(found.cameras)}"
    for path in found.made:
        yield from ("", f"# left out, as it looks like a drawing of another video: {path}")


def _rate(found: FolderSurvey) -> Iterator[str]:
    """Of the first video that can be read; keypoints alone do not tell theirs."""
    for path in found.videos:
        with suppress(InputError):
            rate_hz = probe(found.folder / path).rate_hz
            yield f"rate_hz = {round(rate_hz, 3):g}   # as {path.name} says"
            return
    if found.keypoints and not found.videos:
        yield "# rate_hz = 60   # of the cameras: files of keypoints do not state it, and times"
        yield "#                  and speeds are wrong by as much as it is"


def _subject(found: FolderSurvey) -> Iterator[str]:
    if not found.sensors:
        return
    skeleton = skeleton_named(SKELETON)
    yield from ("", "[[subject]]", 'name = "subject"', "# height_m = 1.75")
    yield "# tpose_s = [2.0, 4.0]   # when the subject stands in the T-pose"
    taken: set[str] = set()
    for sensor in found.sensors:
        known = _usable(sensor, skeleton, taken)
        mark = "" if known else "# "
        yield from ("", f"{mark}[[subject.imu]]")
        yield f"{mark}bone = {quoted(sensor.bone or 'which?')}"
        yield f"{mark}file = {quoted(sensor.file.as_posix())}"
        yield f"{mark}format = {quoted(sensor.format)}"
        if sensor.sensor is not None:
            yield f"{mark}sensor = {quoted(sensor.sensor)}"
        if sensor.up == "y":
            yield f'{mark}imu_up = "y"   # its accelerations point there'
        if sensor.up == "-z":
            yield f'{mark}# imu_up = "-z"   # where its world is north, east, down'
        if known:
            taken.add(str(sensor.bone))


def _usable(sensor: FoundSensor, skeleton: Skeleton, taken: set[str]) -> bool:
    return sensor.bone in skeleton.bone_names and sensor.bone not in taken
