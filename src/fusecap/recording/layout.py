"""What stands in a recording: its names, and per schema how a message is written and read.

One JSON message per sample, command, tick and pose, described by a JSON schema.

Numbers are written in the shortest form that reads back to the same bits; missing ones are null.
Positions and rotations of poses follow from theta and are rounded to 1 um and 1e-7.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from fusecap.appearance import APPEARANCE_SIZE
from fusecap.body.shape import BodyShape
from fusecap.body.skeleton import skeleton_named
from fusecap.geometry.quaternions import to_wxyz
from fusecap.types import CameraSample, Command, CommandKind, Estimate, ImuSample, Tick

SUFFIX = ".mcap"
FORMAT = "fusecap recording 1"
HEADER, END = "fusecap", "fusecap end"
"""Names of the metadata records before and after the data."""
KEYPOINTS, IMU = "fusecap.Keypoints", "fusecap.Imu"
COMMAND, TICK = "fusecap.Command", "fusecap.Tick"
EVENTS = frozenset({KEYPOINTS, IMU, COMMAND, TICK})
POSE, BODY = "fusecap.Pose", "fusecap.Body"


@dataclass(frozen=True, slots=True, kw_only=True)
class RecordedBody:
    """A person's body from now on."""

    name: str
    shape: BodyShape


@dataclass(frozen=True, slots=True, kw_only=True)
class Known:
    """What samples must fit to."""

    cameras: int
    landmarks: int
    sensors: frozenset[tuple[str, str]]
    skeleton: str

    @classmethod
    def of(cls, setup: Mapping[str, Any]) -> Known:
        session = setup["session"]
        return cls(
            cameras=len(setup["rig"]),
            landmarks=len(setup["landmarks"]["landmark_names"]),
            sensors=frozenset(
                (subject["name"], imu["bone"])
                for subject in session.get("subject", ())
                for imu in subject.get("imu", ())
            ),
            skeleton=session["session"].get("skeleton", "paper21"),
        )


def keypoints_message(sample: CameraSample) -> str:
    return (
        f'{{"camera":{sample.camera},"timestamp_ns":{sample.timestamp_ns},'
        f'"people":{_numbers(sample.people)}{_appearance(sample)}}}'
    )


def _appearance(sample: CameraSample) -> str:
    looks = sample.appearance
    return "" if looks is None or not looks.any() else f',"appearance":{looks.tolist()}'


def imu_message(sample: ImuSample) -> str:
    return (
        f'{{"subject":{json.dumps(sample.subject)},"bone":{json.dumps(sample.bone)},'
        f'"timestamp_ns":{sample.timestamp_ns},'
        f'"orientation_wxyz":{_numbers(sample.orientation_wxyz)},'
        f'"accel_m_s2":{_numbers(sample.accel_m_s2)}}}'
    )


def command_message(command: Command) -> str:
    return json.dumps({"kind": command.kind.value, "subject": command.subject})


def tick_message(tick: Tick) -> str:
    return f'{{"timestamp_ns":{tick.timestamp_ns},"ahead":{json.dumps(tick.ahead)}}}'


def pose_message(estimate: Estimate) -> str:
    wxyz = to_wxyz(Rotation.from_matrix(estimate.bone_rotation_in_world))
    return (
        f'{{"name":{json.dumps(estimate.name)},"track_id":{estimate.track_id},'
        f'"timestamp_ns":{estimate.timestamp_ns},"status":"{estimate.status.name.lower()}",'
        f'"iterations":{estimate.iterations},"cost":{_numbers(np.float64(estimate.cost))},'
        f'"solve_s":{_numbers(np.float64(estimate.solve_s))},'
        f'"views":{json.dumps(estimate.views.tolist())},'
        f'"measured":{json.dumps(estimate.measured)},'
        f'"theta":{_numbers(estimate.theta)},'
        f'"bone_sigma_deg":{_numbers(estimate.bone_sigma_deg)},'
        f'"position_sigma_m":{_numbers(estimate.position_sigma_m)},'
        f'"position_m":{_numbers(np.round(estimate.bone_position_in_world_m, 6))},'
        f'"rotation_wxyz":{_numbers(np.round(wxyz, 7))}}}'
    )


def body_message(name: str, shape: BodyShape) -> str:
    skeleton = shape.skeleton
    return (
        f'{{"name":{json.dumps(name)},"height_m":{_numbers(np.float64(shape.height_m))},'
        f'"bone_names":{json.dumps(skeleton.bone_names)},'
        f'"parents":{json.dumps(skeleton.parents)},"offsets_m":{_numbers(shape.offsets_m)}}}'
    )


def _numbers(values: np.ndarray | np.float64) -> str:
    # Python writes numbers as JSON does, but for two that JSON lacks; 1e999 is in its grammar, and
    # every reader takes it for infinity.
    return str(values.tolist()).replace("nan", "null").replace("inf", "1e999")


def _object(
    title: str, description: str, optional: tuple[str, ...] = (), **properties: Any
) -> dict[str, Any]:
    return {
        "title": title,
        "description": description,
        "type": "object",
        "properties": properties,
        "required": [name for name in properties if name not in optional],
    }


def _list(items: dict[str, Any], description: str) -> dict[str, Any]:
    return {"type": "array", "items": items, "description": description}


_NUMBER = {"type": ["number", "null"]}
_ROW = {"type": "array", "items": _NUMBER}
_TEXT = {"type": "string"}
_TIME = {"type": "integer", "description": "Of the sample, ns on the session's clock."}

SCHEMAS = {
    schema["title"]: schema
    for schema in (
        _object(
            KEYPOINTS,
            "Everyone the detector found in one picture of one camera.",
            optional=("appearance",),
            camera={"type": "integer", "description": "In the order of the rig."},
            timestamp_ns=_TIME,
            people=_list(_list(_ROW, "x [px], y [px], confidence 0-1"), "Per person, per keypoint"),
            appearance=_list(
                _list({"type": "integer"}, "40 numbers of 0-255, all 0 where not seen"),
                "Per person how the clothes look; absent without pictures",
            ),
        ),
        _object(
            IMU,
            "What one sensor measured at one moment.",
            subject=_TEXT,
            bone=_TEXT,
            timestamp_ns=_TIME,
            orientation_wxyz=_list(_NUMBER, "imu_world_from_imu, unit quaternion"),
            accel_m_s2=_list(_NUMBER, "Specific force in the imu frame"),
        ),
        _object(
            COMMAND,
            "A user's wish, in its place among the samples.",
            kind=_TEXT,
            subject=_TEXT,
        ),
        _object(TICK, "Solve this instant now.", timestamp_ns=_TIME, ahead={"type": "boolean"}),
        _object(
            POSE,
            "One person as solved and sent; world right-handed, y up, floor y = 0.",
            name=_TEXT,
            track_id={"type": "integer"},
            timestamp_ns=_TIME,
            status=_TEXT,
            iterations={"type": "integer"},
            cost=_NUMBER,
            solve_s=_NUMBER,
            views=_list({"type": "boolean"}, "Which cameras contributed"),
            measured={"type": "boolean"},
            theta=_list(_NUMBER, "Root translation [m], then an angle-axis vector [rad] per bone"),
            bone_sigma_deg=_list(_NUMBER, "Expected error of each bone's rotation"),
            position_sigma_m=_list(_NUMBER, "Expected error of each joint's place"),
            position_m=_list(_ROW, "Per bone, the joint at its root"),
            rotation_wxyz=_list(_ROW, "Per bone, world_from_bone"),
        ),
        _object(
            BODY,
            "A person's body from now on.",
            name=_TEXT,
            height_m=_NUMBER,
            bone_names=_list(_TEXT, "Bones in order"),
            parents=_list({"type": "integer"}, "-1 for the root"),
            offsets_m=_list(_ROW, "Each joint in its parent's bone frame"),
        ),
    )
}


def _keypoints(values: Mapping[str, Any], known: Known) -> CameraSample:
    camera = _number(values["camera"])
    if not 0 <= camera < known.cameras:
        raise ValueError(f"no camera {camera}")
    people = np.array(values["people"], dtype=np.float64)
    if people.size == 0:
        people = people.reshape(0, known.landmarks, 3)
    if people.shape[1:] != (known.landmarks, 3):
        raise ValueError(f"keypoints {people.shape}")
    looks = None
    if "appearance" in values:
        looks = np.array(values["appearance"], dtype=np.uint8)
        if looks.shape != (len(people), APPEARANCE_SIZE):
            raise ValueError(f"appearance {looks.shape}")
    return CameraSample(
        camera=camera, timestamp_ns=_time_ns(values), people=people, appearance=looks
    )


def _imu(values: Mapping[str, Any], known: Known) -> ImuSample:
    subject, bone = values["subject"], values["bone"]
    if (subject, bone) not in known.sensors:
        raise ValueError(f"no sensor {subject}/{bone}")
    return ImuSample(
        subject=subject,
        bone=bone,
        timestamp_ns=_time_ns(values),
        orientation_wxyz=_floats(values["orientation_wxyz"], 4),
        accel_m_s2=_floats(values["accel_m_s2"], 3),
    )


def _command(values: Mapping[str, Any], known: Known) -> Command:
    return Command(kind=CommandKind(values["kind"]), subject=str(values["subject"]))


def _tick(values: Mapping[str, Any], known: Known) -> Tick:
    return Tick(timestamp_ns=_time_ns(values), ahead=values.get("ahead") is True)


def _pose(values: Mapping[str, Any], known: Known) -> dict[str, Any]:
    skeleton = skeleton_named(known.skeleton)
    return {
        "name": str(values["name"]),
        "timestamp_ns": _time_ns(values),
        "theta": _floats(values["theta"], skeleton.pose_size),
        "bone_sigma_deg": _floats(values["bone_sigma_deg"], skeleton.bone_count),
        "position_sigma_m": _floats(values["position_sigma_m"], skeleton.bone_count),
        "diverged": values["status"] == "diverged",
        "measured": values.get("measured", True) is True,  # Once there was no such mark.
    }


def _body(values: Mapping[str, Any], known: Known) -> RecordedBody:
    shape = BodyShape(
        skeleton=skeleton_named(known.skeleton),
        offsets_m=np.array(values["offsets_m"], dtype=np.float64),
        height_m=float(values["height_m"]),
    )
    return RecordedBody(name=str(values["name"]), shape=shape)


DECODERS: dict[str, Callable[[Mapping[str, Any], Known], Any]] = {
    KEYPOINTS: _keypoints,
    IMU: _imu,
    COMMAND: _command,
    TICK: _tick,
    POSE: _pose,
    BODY: _body,
}
"""Of a schema: from its values and what they must fit to; raises where they do not."""


def _time_ns(values: Mapping[str, Any]) -> int:
    return _number(values["timestamp_ns"])


def _number(value: Any) -> int:
    number = int(value)
    if abs(number) >= 1 << 62:
        raise ValueError(f"{number} is no time")
    return number


def _floats(values: Any, count: int) -> np.ndarray:
    array = np.array(values, dtype=np.float64)
    if array.shape != (count,):
        raise ValueError(f"{array.shape} numbers, expected {count}")
    return array
