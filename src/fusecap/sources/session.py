"""`session.toml`: what was recorded, where its files lie, and how to solve it.

Every key is described in docs/formats.md. Loading checks keys, types, units and names, and that
the named files exist; it opens none of them (`fusecap.sources.session_data` does).
"""

from __future__ import annotations

import re
import tomllib
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Annotated, Any

from pydantic import (
    AfterValidator,
    BaseModel,
    ConfigDict,
    Field,
    PrivateAttr,
    ValidationError,
    ValidationInfo,
    field_validator,
    model_validator,
)
from pydantic_core import PydanticCustomError

from fusecap.body.landmarks import LANDMARK_SETS
from fusecap.body.shape import MAX_HEIGHT_M, MIN_HEIGHT_M
from fusecap.body.skeleton import Skeleton, skeleton_named
from fusecap.errors import InputError, MotionError, SessionError, nearest
from fusecap.sources.imu_calibration_files import read_imu_calibration
from fusecap.sources.imu_files import formats as imu_formats
from fusecap.sources.live_address import parse_camera_address, parse_imu_address

FILE_NAME = "session.toml"
KEYPOINT_FORMATS = tuple(f"openpose-{name}" for name in LANDMARK_SETS)
MODEL_SUFFIXES = (".onnx", ".xml")
"""Of network files; anything else is a name."""


def _one_of(names: Iterable[str]) -> AfterValidator:
    known = tuple(names)

    def check(value: str) -> str:
        if value not in known:
            raise PydanticCustomError(
                "unknown_name",
                "found '{value}', expected one of {known}{hint}",
                {"value": value, "known": ", ".join(known), "hint": _did_you_mean(value, known)},
            )
        return value

    return AfterValidator(check)


def _did_you_mean(name: str, known: Iterable[str]) -> str:
    hint = nearest(name, known)
    return hint if "did you mean" in hint else ""


def _positive(value: float) -> float:
    if value <= 0:
        raise PydanticCustomError(
            "not_positive", "found {value}, expected a number above zero", {"value": f"{value:g}"}
        )
    return value


def _not_negative(value: float) -> float:
    if value < 0:
        raise PydanticCustomError(
            "negative", "found {value}, expected zero or more", {"value": f"{value:g}"}
        )
    return value


def _stature(height_m: float) -> float:
    if MIN_HEIGHT_M <= height_m <= MAX_HEIGHT_M:
        return height_m
    for divisor, unit in ((100, "centimetres"), (1000, "millimetres")):
        if MIN_HEIGHT_M <= height_m / divisor <= MAX_HEIGHT_M:
            raise PydanticCustomError(
                "height_unit",
                "height_m is {value}; heights are in metres: for {value} {unit} "
                "write height_m = {metres}",
                {"value": f"{height_m:g}", "unit": unit, "metres": f"{height_m / divisor:g}"},
            )
    raise PydanticCustomError(
        "height",
        "height_m is {value}; expected {low} to {high} (metres)",
        {"value": f"{height_m:g}", "low": MIN_HEIGHT_M, "high": MAX_HEIGHT_M},
    )


def _interval(values: tuple[float, float]) -> tuple[float, float]:
    if values[0] >= values[1]:
        raise PydanticCustomError(
            "interval",
            "found {found}, expected [start, end] with the start before the end",
            {"found": str(list(values))},
        )
    return values


def _quaternion(values: tuple[float, float, float, float]) -> tuple[float, float, float, float]:
    norm = sum(v * v for v in values) ** 0.5
    if abs(norm - 1) > 0.05:
        raise PydanticCustomError(
            "quaternion",
            "the norm is {norm}; expected a unit quaternion in the order w, x, y, z",
            {"norm": f"{norm:.3g}"},
        )
    return values


def _address(parse: Callable[[str], object]) -> AfterValidator:
    def check(value: str) -> str:
        try:
            parse(value)
        except InputError as error:
            raise PydanticCustomError("address", "{message}", {"message": str(error)}) from None
        return value

    return AfterValidator(check)


def _resolved(path: Path, info: ValidationInfo) -> Path:
    folder: Path = info.context["file"].parent if info.context else Path()
    return folder / path.expanduser()


Number = Annotated[float, Field(strict=True, allow_inf_nan=False)]
Positive = Annotated[Number, AfterValidator(_positive)]
NotNegative = Annotated[Number, AfterValidator(_not_negative)]
Name = Annotated[str, Field(min_length=1)]
Flag = Annotated[bool, Field(strict=True)]
File = Annotated[Path, AfterValidator(_resolved)]
Interval = Annotated[tuple[Number, Number], AfterValidator(_interval)]
Vector = tuple[Number, Number, Number]
Quaternion = Annotated[tuple[Number, Number, Number, Number], AfterValidator(_quaternion)]


class _Table(BaseModel):
    """A TOML table; an unknown key is an error that names the nearest known one."""

    model_config = ConfigDict(frozen=True, extra="forbid", arbitrary_types_allowed=True)

    @model_validator(mode="before")
    @classmethod
    def _only_known_keys(cls, data: Any) -> Any:
        if not isinstance(data, dict):
            return data
        known = [field.alias or name for name, field in cls.model_fields.items()]
        unknown = [key for key in data if key not in known]
        if unknown:
            raise PydanticCustomError(
                "unknown_key",
                "{message}",
                {"message": "; ".join(f"unknown key '{k}'{nearest(k, known)}" for k in unknown)},
            )
        return data


class SessionSettings(_Table):
    """`[session]`."""

    name: Name
    rate_hz: Positive = 60.0
    """Of the solve."""
    calibration: File | None = None
    calibration_unit: Annotated[str, _one_of(["m", "mm"])] = "m"
    """Of calibration files whose format leaves the unit open."""
    up: Annotated[str, _one_of(["y", "z", "-y"])] = "y"
    """The axis of the calibration's world that points up."""
    floor: Flag = True
    max_subjects: Annotated[int, Field(strict=True, ge=1)] | None = None
    skeleton: Annotated[str, _one_of(["paper21", "extended23"])] = "paper21"
    volume_m: tuple[Number, Number, Number, Number] | None = None
    """x_min, x_max, z_min, z_max in the y-up world."""
    landmark_offsets: File | None = None
    """Calibrated landmark offsets, as `fusecap calibrate offsets` writes them."""
    sync: File | None = None
    """Clocks of cameras and sensors, as `fusecap calibrate sync` writes them."""
    imu_calibration: File | None = None
    """How sensors sit on their bones, as `fusecap calibrate imu` writes it."""
    associate: Annotated[str, _one_of(["tracker", "paper"])] = "tracker"

    @model_validator(mode="after")
    def _volume_has_an_inside(self) -> SessionSettings:
        v = self.volume_m
        if v is not None and (v[0] >= v[1] or v[2] >= v[3]):
            raise PydanticCustomError(
                "volume",
                "volume_m is {found}; expected [x_min, x_max, z_min, z_max] with min < max",
                {"found": str(list(v))},
            )
        return self


class DetectorSettings(_Table):
    """`[detector]`: how keypoints are found in videos; None: the detector's default."""

    model: Name | None = None
    """A name of the model store, or a file (.onnx, .xml)."""
    person_model: Name | None = None
    runtime: Annotated[str, _one_of(["auto", "onnxruntime", "openvino"])] | None = None
    person_every: Annotated[int, Field(strict=True, ge=1)] | None = None
    packed: Flag | None = None

    @field_validator("model", "person_model")
    @classmethod
    def _from_the_folder(cls, value: str | None, info: ValidationInfo) -> str | None:
        if value is None or Path(value).suffix.lower() not in MODEL_SUFFIXES:
            return value
        return str(_resolved(Path(value), info))


class CameraSettings(_Table):
    """`[[camera]]`."""

    name: Name
    keypoints: File | None = None
    video: File | None = None
    format: Annotated[str, _one_of(KEYPOINT_FORMATS)] = "openpose-body25"
    rate_hz: Positive | None = None
    """None: the session's."""
    offset_s: Number = 0.0
    """Added to the camera's times (frame number / rate; live: the device's stamps)."""
    live: Annotated[Name, _address(parse_camera_address)] | None = None
    """Where `fusecap live` gets its pictures or keypoints (`fusecap.sources.live_address`)."""

    @model_validator(mode="after")
    def _has_a_source(self) -> CameraSettings:
        if self.keypoints is None and self.video is None and self.live is None:
            raise PydanticCustomError(
                "no_source",
                "neither keypoints, video nor live is given; name a folder of keypoint files, a "
                "video, or where a live camera is found",
            )
        return self

    @property
    def landmark_set_name(self) -> str:
        """The landmark set its keypoints follow."""
        return self.format.removeprefix("openpose-")


class ImuSettings(_Table):
    """`[[subject.imu]]`."""

    bone: Name
    file: File | None = None
    live: Annotated[Name, _address(parse_imu_address)] | None = None
    """Where `fusecap live` gets its samples (`fusecap.sources.live_address`)."""
    format: Annotated[str, _one_of(imu_formats.NAMES)] = "csv"
    sensor: Name | None = None
    """Which sensor of a file that holds several."""
    rate_hz: Positive | None = None
    """For files without times or a rate."""
    offset_s: Number = 0.0
    """Added to the file's times."""
    bone_from_imu_wxyz: Quaternion | None = None
    position_m: Vector = (0.0, 0.0, 0.0)
    """The sensor in the bone's frame."""
    heading_deg: Number = 0.0
    """Rotation about world up that turns the sensor's reference world into ours."""
    imu_up: Annotated[str, _one_of(["y", "z"])] = "z"
    """The up axis of the sensor's reference world."""

    @model_validator(mode="after")
    def _has_a_source(self) -> ImuSettings:
        if self.file is None and self.live is None:
            raise PydanticCustomError(
                "no_source",
                "neither file nor live is given; name a file of samples, or where a live sensor "
                "is found",
            )
        return self

    @property
    def source_name(self) -> str:
        """Of its file, else where it is found live."""
        return self.file.name if self.file is not None else self.live or ""


class SubjectSettings(_Table):
    """`[[subject]]`."""

    name: Name
    height_m: Annotated[Number, AfterValidator(_stature)] | None = None
    start_m: tuple[Number, Number] | None = None
    """x, z in the y-up world."""
    bone_lengths_m: dict[str, Positive] = Field(default_factory=dict)
    tpose_s: Interval | None = None
    """When the subject stands in the rest pose."""
    tpose_facing_deg: Number = 0.0
    """Where it faces then: 0 is +z, 90 is +x."""
    imus: tuple[ImuSettings, ...] = Field(default=(), alias="imu")


class WeightSettings(_Table):
    """`[estimator] weights`; None: the estimator's default."""

    position: NotNegative | None = None
    orientation: NotNegative | None = None
    acceleration: NotNegative | None = None
    projection: NotNegative | None = None
    deviation: NotNegative | None = None
    floor: NotNegative | None = None


class EstimatorSettings(_Table):
    """`[estimator]`; None: the estimator's default."""

    weights: WeightSettings = WeightSettings()
    max_iterations: Annotated[int, Field(strict=True, ge=1)] | None = None
    function_tolerance: Positive | None = None
    floor_radius_m: NotNegative | None = None


class LiveSettings(_Table):
    """`[live]`: of `fusecap live`."""

    delay_s: NotNegative | None = None
    """Between exposure and solve; None: 0.2 with a detector in the loop, 0.05 without."""
    eager: Flag | None = None
    """Solve as soon as every source has what an instant needs, at the latest after the delay;
    None: where keypoints come from outside."""
    hold_s: NotNegative = 10.0
    """How long a person whom nothing measures is still sent, in the last pose and with fading
    quality."""


class Session(_Table):
    """A whole session file; relative paths in it have become paths from the caller's folder."""

    settings: SessionSettings = Field(alias="session")
    cameras: tuple[CameraSettings, ...] = Field(default=(), alias="camera")
    subjects: tuple[SubjectSettings, ...] = Field(default=(), alias="subject")
    estimator: EstimatorSettings = EstimatorSettings()
    detector: DetectorSettings = DetectorSettings()
    live: LiveSettings = LiveSettings()
    _path: Path = PrivateAttr(default=Path(FILE_NAME))

    def model_post_init(self, context: Any) -> None:
        """Remembers the file."""
        if context:
            self._path = context["file"]

    @property
    def path(self) -> Path:
        """The session file."""
        return self._path

    @property
    def folder(self) -> Path:
        """Where relative paths start."""
        return self.path.parent

    @property
    def skeleton(self) -> Skeleton:
        """The skeleton that the session asks for."""
        return skeleton_named(self.settings.skeleton)

    def detection_folder(self, camera: CameraSettings) -> Path:
        """Where keypoints that are detected in a camera's video go."""
        return self.folder / "keypoints" / re.sub(r"[^\w.-]", "_", camera.name)

    def camera_rate_hz(self, camera: CameraSettings) -> float:
        """A camera's frame rate."""
        return camera.rate_hz or self.settings.rate_hz

    @model_validator(mode="after")
    def _is_consistent(self) -> Session:
        problems = [
            *_doubled("camera", [camera.name for camera in self.cameras]),
            *_doubled("subject", [subject.name for subject in self.subjects]),
        ]
        if not self.cameras and not any(subject.imus for subject in self.subjects):
            problems.append("there is neither a [[camera]] nor a [[subject.imu]]: nothing to solve")
        for subject in self.subjects:
            problems += _unknown_bones(self.skeleton, subject)
        if problems:
            raise PydanticCustomError("inconsistent", "{message}", {"message": "\n".join(problems)})
        return self


def _doubled(what: str, names: list[str]) -> list[str]:
    return [
        f"two [[{what}]] tables are called '{name}'; names must differ"
        for name in sorted({name for name in names if names.count(name) > 1})
    ]


def _unknown_bones(skeleton: Skeleton, subject: SubjectSettings) -> list[str]:
    problems = []
    for name in (*subject.bone_lengths_m, *(imu.bone for imu in subject.imus)):
        try:
            skeleton.bone(name)
        except MotionError as error:
            problems.append(f"[[subject]] '{subject.name}': {error}")
    return problems


def load_session(path: Path | str) -> Session:
    """Reads a session file, or the `session.toml` of a folder; raises `SessionError`.

    The error lists everything that is wrong, one line each, missing files included.
    """
    session = parse_session(path)
    missing = missing_files(session)
    if missing:
        raise SessionError("\n".join(f"{session.path}: {line}" for line in missing))
    return with_imu_calibration(session)


def with_imu_calibration(session: Session) -> Session:
    """The session with the sensors' constants of its `imu_calibration`; raises `SessionError`."""
    path = session.settings.imu_calibration
    if path is None:
        return session
    found = {(imu.subject, imu.bone): imu for imu in read_imu_calibration(path)}
    known = {(subject.name, imu.bone) for subject in session.subjects for imu in subject.imus}
    for subject, bone in found.keys() - known:
        raise SessionError(
            f"{path}: holds imu '{bone}' of '{subject}', which {session.path} does not have; "
            "calibrate this session with: fusecap calibrate imu"
        )
    subjects = []
    for subject in session.subjects:
        imus = []
        for imu in subject.imus:
            own = found.get((subject.name, imu.bone))
            update = (
                {}
                if own is None
                else {
                    "bone_from_imu_wxyz": own.bone_from_imu_wxyz,
                    "heading_deg": own.heading_deg,
                }
            )
            imus.append(imu.model_copy(update=update))
        subjects.append(subject.model_copy(update={"imus": tuple(imus)}))
    return session.model_copy(update={"subjects": tuple(subjects)})


def parse_session(path: Path | str) -> Session:
    """`load_session` without looking whether the files it names exist."""
    file = session_file(path)
    try:
        data = tomllib.loads(file.read_text(encoding="utf-8"))
    except tomllib.TOMLDecodeError as error:
        raise SessionError(f"{file}: not valid TOML: {error}") from None
    except (OSError, UnicodeDecodeError) as error:
        raise SessionError(f"{file}: cannot be read as UTF-8 text: {error}") from None
    try:
        return Session.model_validate(data, context={"file": file})
    except ValidationError as error:
        raise SessionError(_readable(error, file, data)) from None


def session_file(path: Path | str) -> Path:
    """The session file that `path` (a file or its folder) means; raises `SessionError`."""
    path = Path(path)
    file = path / FILE_NAME if path.is_dir() else path
    if not file.is_file():
        raise SessionError(
            f"{file}: no such file; expected a session file or a folder with a {FILE_NAME}"
        )
    return file


def missing_files(session: Session) -> list[str]:
    """One line per file or folder that the session names and that is not there."""
    lines = []

    def check(where: str, path: Path | None, *, folder: bool | None) -> None:
        if path is None:
            return
        kind = {True: "folder", False: "file", None: "file or folder"}[folder]
        if not path.exists():
            lines.append(f"{where}: no {kind} {path}; check the path (relative to {FILE_NAME})")
        elif folder is not None and path.is_dir() != folder:
            lines.append(f"{where}: {path} is not a {kind}")

    check("[session] calibration", session.settings.calibration, folder=None)
    check("[session] landmark_offsets", session.settings.landmark_offsets, folder=False)
    check("[session] imu_calibration", session.settings.imu_calibration, folder=False)
    check("[session] sync", session.settings.sync, folder=False)
    for camera in session.cameras:
        check(f"[[camera]] '{camera.name}' keypoints", camera.keypoints, folder=True)
        check(f"[[camera]] '{camera.name}' video", camera.video, folder=False)
    for subject in session.subjects:
        for imu in subject.imus:
            check(f"[[subject]] '{subject.name}' imu '{imu.bone}' file", imu.file, folder=False)
    return lines


_EXPECTED = {
    "missing": "missing; this key is required",
    "float_type": "found {found}, expected a number",
    "int_type": "found {found}, expected a whole number",
    "bool_type": "found {found}, expected true or false",
    "string_type": "found {found}, expected text in quotes",
    "path_type": "found {found}, expected a path in quotes",
    "string_too_short": "found an empty text",
    "finite_number": "found {found}, expected a finite number",
    "tuple_type": "found {found}, expected a list",
    "greater_than_equal": "found {found}, expected at least {ge}",
    "model_type": "found {found}, expected a table",
    "dict_type": "found {found}, expected a table",
}


def _readable(error: ValidationError, file: Path, data: Mapping[str, Any]) -> str:
    lines = []
    for item in error.errors():
        where = _where(item["loc"], data)
        text = _EXPECTED.get(item["type"], item["msg"])
        found = item.get("input")
        if item["type"] == "tuple_type" and isinstance(found, dict):
            text = f"found a single table; write [[{'.'.join(map(str, item['loc']))}]]"
        if item["type"] == "model_type" and isinstance(found, list):
            text = f"found a list of tables; write [{'.'.join(map(str, item['loc']))}]"
        context = {"found": repr(found), **item.get("ctx", {})}
        if text is _EXPECTED.get(item["type"]):
            text = text.format_map(context)
        lines += [f"{file}: {where}{': ' if where else ''}{line}" for line in text.splitlines()]
    return "\n".join(lines)


def _where(loc: tuple[int | str, ...], data: Any) -> str:
    """`("camera", 1, "rate_hz")` as "[[camera]] 'left' rate_hz"."""
    words, tables = [], ""
    for part in loc:
        below = None
        if isinstance(data, Mapping) and isinstance(part, str):
            below = data.get(part)
        elif isinstance(data, list) and isinstance(part, int) and part < len(data):
            below = data[part]
        if isinstance(part, int):
            label = below.get("name", below.get("bone")) if isinstance(below, Mapping) else None
            words.append(f"'{label}'" if isinstance(label, str) else f"no. {part + 1}")
        elif isinstance(below, list) and any(isinstance(entry, Mapping) for entry in below):
            tables = f"{tables}.{part}" if tables else part
            words.append(f"[[{tables}]]")
        elif len(words) == 0:
            words.append(f"[{part}]")
        else:
            words.append(part)
        data = below
    return " ".join(words)
