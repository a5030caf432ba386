"""Where on the body each detector's keypoints lie.

A landmark is a point fixed on a bone; a keypoint is its image. Offsets are fractions of stature in
the bone's frame (x left, y up, z forward in the rest pose), so one table serves everyone. Limb
keypoints sit on the joint centres; those of the head, trunk and feet follow the adult head and foot
breadths and heights of Winter, "Biomechanics and Motor Control of Human Movement", fig. 4.1, and
NASA-STD-3000 vol. 1, sec. 3 (tragion, eye and nose against the top of the neck). They are starting
values without any detector's bias; eq. 17-18 of the paper calibrate them to a detector, and a set
that was `calibrated` carries the result to whoever asks it for offsets.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from jaxtyping import Float, Int

from fusecap.body.shape import BodyShape
from fusecap.body.skeleton import Skeleton
from fusecap.errors import InputError, nearest

_TRUNK_AND_HEAD = {
    "mid_hip": ("hips", (0.0, -0.020, 0.0)),
    "chest": ("spine1", (0.0, 0.010, 0.0)),
    "neck": ("spine3", (0.0, 0.040, 0.0)),
    "upper_neck": ("neck", (0.0, 0.030, 0.0)),
    "head_top": ("head", (0.0, 0.110, -0.010)),
    "nose": ("head", (0.0, 0.022, 0.060)),
}
_SIDED = {
    "eye": ("head", (0.018, 0.042, 0.047)),
    "ear": ("head", (0.043, 0.033, 0.0)),
    "shoulder": ("{side}_upper_arm", (0.0, 0.0, 0.0)),
    "elbow": ("{side}_forearm", (0.0, 0.0, 0.0)),
    "wrist": ("{side}_hand", (0.0, 0.0, 0.0)),
    "hip": ("{side}_thigh", (0.0, 0.0, 0.0)),
    "knee": ("{side}_shank", (0.0, 0.0, 0.0)),
    "ankle": ("{side}_foot", (0.0, 0.0, 0.0)),
    "big_toe": ("{side}_toes", (-0.014, 0.0, 0.035)),
    "small_toe": ("{side}_toes", (0.026, 0.0, 0.010)),
    "heel": ("{side}_foot", (0.0, -0.028, -0.032)),
}


def _all_landmarks() -> dict[str, tuple[str, tuple[float, float, float]]]:
    table = dict(_TRUNK_AND_HEAD)
    for side, sign in (("left", 1.0), ("right", -1.0)):
        for name, (bone, (x, y, z)) in _SIDED.items():
            table[f"{side}_{name}"] = (bone.format(side=side), (sign * x, y, z))
    return table


LANDMARKS = _all_landmarks()
"""Landmark name to (bone, offset in the bone's frame as a fraction of stature)."""


Offset = tuple[float, float, float]
"""In the bone's frame (x left, y up, z forward in the rest pose), as fractions of stature."""


@dataclass(frozen=True, kw_only=True)
class LandmarkOffsets:
    """Calibrated places of landmarks on their bones [1, eq. 18]; the others keep their defaults."""

    everyone: Mapping[str, Offset] = field(default_factory=dict)
    subjects: Mapping[str, Mapping[str, Offset]] = field(default_factory=dict)
    """By subject name; comes before `everyone`."""

    def __post_init__(self) -> None:
        for offsets in (self.everyone, *self.subjects.values()):
            for name in offsets:
                if name not in LANDMARKS:
                    raise InputError(f"no landmark '{name}'{nearest(name, LANDMARKS)}")

    def of(self, subject: str) -> LandmarkOffsets:
        """Those of one subject, as the offsets of everyone."""
        return LandmarkOffsets(everyone={**self.everyone, **self.subjects.get(subject, {})})


@dataclass(frozen=True, kw_only=True)
class LandmarkSet:
    """The landmarks of one detector, in the order of its keypoints, and where they lie."""

    name: str
    landmark_names: tuple[str, ...]
    keypoints: int | None = None
    """How many the detector gives, where these are only some; None: as many as landmarks."""
    columns: tuple[int, ...] | None = None
    """Which of its keypoints the landmarks are; None: the first."""
    offsets: LandmarkOffsets | None = field(default=None, hash=False)
    """Calibrated; None: the defaults of `LANDMARKS`."""

    @property
    def keypoint_count(self) -> int:
        """Keypoints per person in a file."""
        return self.keypoints or len(self.landmark_names)

    def of_keypoints(self, people: Float[np.ndarray, "n m 3"]) -> Float[np.ndarray, "n k 3"]:
        """Those of all a detector's keypoints that are landmarks."""
        if self.columns is None:
            return people[:, : len(self.landmark_names)]
        return people[:, list(self.columns)]

    def with_all(self, people: Float[np.ndarray, "n k 3"]) -> Float[np.ndarray, "n m 3"]:
        """As many keypoints as in a file, those that are no landmarks missing."""
        columns = self.columns or range(len(self.landmark_names))
        everything = np.full((len(people), self.keypoint_count, 3), (np.nan, np.nan, 0.0))
        everything[:, list(columns)] = people
        return everything

    def index(self, name: str) -> int | None:
        """Position of a landmark, or None where this detector does not have it."""
        return self.landmark_names.index(name) if name in self.landmark_names else None

    @cached_property
    def mirror(self) -> Int[np.ndarray, " k"]:
        """For each landmark the index of the same one on the other side of the body."""
        swap = {"left": "right", "right": "left"}
        mirrored = []
        for name in self.landmark_names:
            side, _, rest = name.partition("_")
            mirrored.append(f"{swap[side]}_{rest}" if side in swap else name)
        return np.array([self.landmark_names.index(name) for name in mirrored], dtype=np.int64)

    def bones(self, skeleton: Skeleton) -> Int[np.ndarray, " k"]:
        """The bone that carries each landmark."""
        return np.array(
            [skeleton.bone(LANDMARKS[name][0]) for name in self.landmark_names], dtype=np.int64
        )

    @cached_property
    def fractions(self) -> Float[np.ndarray, "k 3"]:
        """Offsets t_pb of eq. 5 in the bones' frames, calibrated or default, by stature."""
        calibrated = self.offsets.everyone if self.offsets else {}
        return np.array([calibrated.get(name, LANDMARKS[name][1]) for name in self.landmark_names])

    def offsets_m(self, shape: BodyShape) -> Float[np.ndarray, "k 3"]:
        """Offsets t_pb of eq. 5, in the bones' frames [m], for a body of this stature."""
        return self.fractions * shape.height_m

    def calibrated(self, offsets: LandmarkOffsets | None) -> LandmarkSet:
        """The same landmarks at calibrated places; None: at the default ones."""
        return replace(self, offsets=offsets)

    def of(self, subject: str) -> LandmarkSet:
        """The landmarks as they lie on one subject."""
        if self.offsets is None or subject not in self.offsets.subjects:
            return self
        return self.calibrated(self.offsets.of(subject))


_COCO = (
    "nose left_eye right_eye left_ear right_ear left_shoulder right_shoulder left_elbow "
    "right_elbow left_wrist right_wrist left_hip right_hip left_knee right_knee left_ankle "
    "right_ankle"
)
_RIGHT_THEN_LEFT_ARM = "right_shoulder right_elbow right_wrist left_shoulder left_elbow left_wrist"
_ORDERS = {
    "body25": f"nose neck {_RIGHT_THEN_LEFT_ARM} mid_hip right_hip right_knee right_ankle "
    "left_hip left_knee left_ankle right_eye left_eye right_ear left_ear left_big_toe "
    "left_small_toe left_heel right_big_toe right_small_toe right_heel",
    "body25b": f"{_COCO} upper_neck head_top left_big_toe left_small_toe left_heel "
    "right_big_toe right_small_toe right_heel",
    "halpe26": f"{_COCO} head_top neck mid_hip left_big_toe right_big_toe left_small_toe "
    "right_small_toe left_heel right_heel",
    "coco17": _COCO,
    "coco18": f"nose neck {_RIGHT_THEN_LEFT_ARM} right_hip right_knee right_ankle left_hip "
    "left_knee left_ankle right_eye left_eye right_ear left_ear",
    "mpi15": f"head_top neck {_RIGHT_THEN_LEFT_ARM} right_hip right_knee right_ankle left_hip "
    "left_knee left_ankle chest",
}

_HANDS_AND_FACE = {
    "wholebody133": (
        "coco17",
        "left_big_toe left_small_toe left_heel right_big_toe right_small_toe right_heel",
        133,
    ),
    "halpe136": ("halpe26", "", 136),
    "body135": ("body25b", "", 135),
}
"""Whose first keypoints are those of another set, then some, and then ones no bone carries."""
_BLAZEPOSE33 = {
    "nose": 0,
    "left_eye": 2,
    "right_eye": 5,
    "left_ear": 7,
    "right_ear": 8,
    **{
        f"{side}_{name}": number + (side == "right")
        for name, number in (
            *(("shoulder", 11), ("elbow", 13), ("wrist", 15), ("hip", 23), ("knee", 25)),
            *(("ankle", 27), ("heel", 29), ("big_toe", 31)),
        )
        for side in ("left", "right")
    },
}


def _landmark_sets() -> Iterator[LandmarkSet]:
    for name, order in _ORDERS.items():
        yield LandmarkSet(name=name, landmark_names=tuple(order.split()))
    for name, (first, then, count) in _HANDS_AND_FACE.items():
        names = (*_ORDERS[first].split(), *then.split())
        yield LandmarkSet(name=name, landmark_names=names, keypoints=count)
    yield LandmarkSet(
        name="blazepose33",
        landmark_names=tuple(_BLAZEPOSE33),
        keypoints=33,
        columns=tuple(_BLAZEPOSE33.values()),
    )


LANDMARK_SETS = {landmarks.name: landmarks for landmarks in _landmark_sets()}


def landmark_set_named(name: str) -> LandmarkSet:
    """The landmark set called `name`; raises `InputError` naming the known ones."""
    if name not in LANDMARK_SETS:
        raise InputError(f"no landmark set '{name}'{nearest(name, LANDMARK_SETS)}")
    return LANDMARK_SETS[name]
