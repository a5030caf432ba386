"""`session.toml`: what was recorded, where its files lie, and how to solve it.

Every key is described in docs/formats.md; here are the tables with the types, units and names that
they allow. `fusecap.sources.session_file` reads the file, `fusecap.sources.session_data` opens what
it names.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Annotated, Any

from pydantic import (
    AfterValidator,
    BaseModel,
    ConfigDict,
    Field,
    PrivateAttr,
    ValidationInfo,
    field_validator,
    model_validator,
)
from pydantic_core import PydanticCustomError

from fusecap.body.landmarks import LANDMARK_SETS
from fusecap.body.shape import MAX_HEIGHT_M, MIN_HEIGHT_M
from fusecap.body.skeleton import Skeleton, skeleton_named
from fusecap.errors import InputError, MotionError, nearest
from fusecap.files import distinct_names
from fusecap.sources.imu_files import formats as imu_formats
from fusecap.sources.live_address import parse_camera_address, parse_imu_address

FILE_NAME = "session.toml"
KEYPOINT_FORMATS = tuple(f"openpose-{name}" for name in LANDMARK_SETS)
MODEL_SUFFIXES = (".onnx", ".xml", ".tflite")
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
    calibration_unit: Annotated[str, _one_of(["m", "cm", "mm"])] = "m"
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
    static_file: File | None = None
    """A trial of its own for `tpose_s` or `npose_s`, which count on this file's clock then."""
    position_m: Vector = (0.0, 0.0, 0.0)
    """The sensor in the bone's frame."""
    heading_deg: Number = 0.0
    """Rotation about world up that turns the sensor's reference world into ours."""
    imu_up: Annotated[str, _one_of(["y", "z", "-z"])] = "z"
    """The up axis of the sensor's reference world; "-z" is north, east, down."""

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
    npose_s: Interval | None = None
    """When it stands so, but with hanging arms, palms to the thighs."""
    tpose_facing_deg: Number = 0.0
    """Where it faces then: 0 is +z, 90 is +x."""
    imus: tuple[ImuSettings, ...] = Field(default=(), alias="imu")

    @model_validator(mode="after")
    def _stands_in_one_pose(self) -> SubjectSettings:
        if self.tpose_s is not None and self.npose_s is not None:
            raise PydanticCustomError(
                "two_poses", "both tpose_s and npose_s are given; sensors are calibrated in one"
            )
        return self

    @property
    def still_s(self) -> Interval | None:
        """When it stands in a known pose, whichever."""
        return self.tpose_s or self.npose_s


class WeightSettings(_Table):
    """`[estimator] weights`; None: the estimator's default."""

    position: NotNegative | None = None
    growth: NotNegative | None = None
    orientation: NotNegative | None = None
    acceleration: NotNegative | None = None
    projection: NotNegative | None = None
    deviation: NotNegative | None = None
    floor: NotNegative | None = None
    motion: NotNegative | None = None
    increment: NotNegative | None = None
    specific_force: NotNegative | None = None
    rest: NotNegative | None = None


class EstimatorSettings(_Table):
    """`[estimator]`; None: the estimator's default."""

    weights: WeightSettings = WeightSettings()
    window: Annotated[int, Field(strict=True, ge=1, le=1000)] | None = None
    """Instants solved together; 1: each alone."""
    max_iterations: Annotated[int, Field(strict=True, ge=1)] | None = None
    function_tolerance: Positive | None = None
    floor_radius_m: NotNegative | None = None


MOST_CAMERAS = 256
MOST_SUBJECTS = 64
"""Of a session: pairs of them are compared."""
POSES = ("solved", "ahead", "settled")
"""That a live run can send."""


class LiveSettings(_Table):
    """`[live]`: of `fusecap live`."""

    delay_s: NotNegative | None = None
    """Between exposure and solve; None: 0.2 with a detector in the loop, 0.05 without."""
    eager: Flag | None = None
    """Solve as soon as every source has what an instant needs, at the latest after the delay;
    None: where keypoints come from outside."""
    poses: Annotated[str, _one_of(POSES)] = "solved"
    """Which are sent: solved with the pictures that `delay_s` waits for, ahead of these by sensors
    and motion, or `settle_s` after they were solved."""
    settle_s: Annotated[Positive, Field(le=0.3)] = 0.1
    """What comes so much later still corrects settled poses."""
    hold_s: NotNegative = 10.0
    """How long a person whom nothing measures is still sent, in the last pose and with growing
    error bars."""


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
        names = [each.name for each in self.cameras]
        folder = distinct_names(names)[names.index(camera.name)]
        return self.folder / "keypoints" / folder

    def place_in_table(self, camera: CameraSettings) -> tuple[int, int]:
        """Which of the cameras it is that name the same keypoints, and how many do."""
        names = [each.name for each in self.cameras if each.keypoints == camera.keypoints]
        return names.index(camera.name), len(names)

    def camera_rate_hz(self, camera: CameraSettings) -> float:
        """A camera's frame rate."""
        return camera.rate_hz or self.settings.rate_hz

    @model_validator(mode="after")
    def _is_consistent(self) -> Session:
        problems = [
            *_too_many("camera", len(self.cameras), MOST_CAMERAS),
            *_too_many("subject", len(self.subjects), MOST_SUBJECTS),
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


def _too_many(what: str, count: int, most: int) -> list[str]:
    return [f"{count} [[{what}]] tables; at most {most} are read"] if count > most else []


def _doubled(what: str, names: list[str]) -> list[str]:
    return [
        f"two [[{what}]] tables are called '{name}'; names must differ"
        for name, count in sorted(Counter(names).items())
        if count > 1
    ]


def _unknown_bones(skeleton: Skeleton, subject: SubjectSettings) -> list[str]:
    problems = []
    for name in (*subject.bone_lengths_m, *(imu.bone for imu in subject.imus)):
        try:
            skeleton.bone(name)
        except MotionError as error:
            problems.append(f"[[subject]] '{subject.name}': {error}")
    return problems
