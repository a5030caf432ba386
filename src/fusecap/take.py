"""A take: the solved motion of every subject over one session, in memory and as one `.npz`.

    S subjects, T frames, B bones; world right-handed, y up, metres; see docs/take.md

The poses are stored twice, as `theta` and as world positions and rotations, so that a reader needs
no forward kinematics. NaN stands only where `tracked` is false.
"""

from __future__ import annotations

import json
import zipfile
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial.transform import Rotation

from fusecap.believable import MAX_M
from fusecap.body.pose import forward_kinematics
from fusecap.body.shape import MAX_OFFSET_M, BodyShape
from fusecap.body.skeleton import Skeleton
from fusecap.errors import TakeError, nearest
from fusecap.files import Spool, written_whole
from fusecap.geometry.quaternions import from_wxyz, to_wxyz
from fusecap.types import quality_of

FORMAT_VERSION = 2
FORMAT_NAME = "fusecap take "
FORMAT = f"{FORMAT_NAME}{FORMAT_VERSION}"
BLOCK = 2048
"""Frames checked or written at a time, so that it takes no memory to speak of."""
STORED = {
    "theta": np.float32,
    "bone_position_in_world_m": np.float32,
    "bone_rotation_in_world_wxyz": np.float32,
    "bone_sigma_deg": np.float16,
    "position_sigma_m": np.float16,
}
"""The arrays of numbers per subject and frame, and as what a file holds them."""
MOTION = tuple(STORED)
MARKS = ("tracked", "measured")
"""The arrays of marks per subject and frame."""

UNITS = {
    "timestamps_ns": "ns, one clock",
    "rate_hz": "Hz",
    "heights_m": "m",
    "offsets_m": "m, joint in its parent's bone frame",
    "theta": "m, then rad: root translation in world, then one angle-axis vector per bone, "
    "local to its parent",
    "bone_position_in_world_m": "m, the joint at the bone's root",
    "bone_rotation_in_world_wxyz": "unit quaternion world_from_bone, w >= 0",
    "bone_sigma_deg": "deg, expected root mean square error of the bone's rotation in the world",
    "position_sigma_m": "m, expected root mean square error of the joint's place",
    "world": "right-handed, y up, floor at y = 0",
}


@dataclass(frozen=True, kw_only=True)
class Take:
    """The motion of S subjects over T frames; raises `TakeError` where the parts disagree."""

    timestamps_ns: Int[np.ndarray, " t"]
    rate_hz: float
    subject_names: tuple[str, ...]
    skeleton_name: str
    bone_names: tuple[str, ...]
    parents: tuple[int, ...]
    heights_m: Float[np.ndarray, " s"]
    offsets_m: Float[np.ndarray, "s b 3"]
    theta: Float[np.ndarray, "s t p"]
    bone_position_in_world_m: Float[np.ndarray, "s t b 3"]
    bone_rotation_in_world_wxyz: Float[np.ndarray, "s t b 4"]
    tracked: Bool[np.ndarray, "s t"]
    """Somebody has a pose."""
    measured: Bool[np.ndarray, "s t"]
    """A camera or a sensor told of this frame; a pose without is predicted by the motion around.
    False where there is no pose."""
    bone_sigma_deg: Float[np.ndarray, "s t b"]
    """Expected root mean square error of each bone's rotation in the world."""
    position_sigma_m: Float[np.ndarray, "s t b"]
    """Expected root mean square error of each joint's place in the cameras' world."""
    provenance: Mapping[str, Any] = field(default_factory=dict)
    """What made it: see `provenance`."""

    def __post_init__(self) -> None:
        s, t, b = len(self.subject_names), len(self.timestamps_ns), len(self.bone_names)
        for name, shape in array_shapes(s, t, b).items():
            found = np.shape(getattr(self, name))
            if found != shape:
                raise TakeError(
                    f"{name} is {found}, expected {shape} for {s} subjects, {t} frames, {b} bones"
                )
        if len(set(self.subject_names)) != s:
            raise TakeError(f"two subjects of the take share a name: {self.subject_names}")
        if not 0 < self.rate_hz <= 1e6:
            raise TakeError(f"rate_hz is {self.rate_hz}, expected a positive number")
        if t > 1 and np.diff(self.timestamps_ns).min() <= 0:
            raise TakeError("timestamps_ns do not increase")
        if not (np.abs(self.offsets_m) <= MAX_OFFSET_M).all():
            raise TakeError(f"offsets_m hold a value that is no number up to {MAX_OFFSET_M:g} m")
        if not ((self.heights_m > 0) & (self.heights_m <= MAX_OFFSET_M)).all():
            raise TakeError(f"heights_m are {self.heights_m}, expected metres above zero")
        object.__setattr__(self, "measured", self.measured & self.tracked)
        for first in range(0, t, BLOCK):
            self._check_frames(first, first + BLOCK)

    def _check_frames(self, first: int, end: int) -> None:
        tracked = self.tracked[:, first:end]
        for name in MOTION:
            values = getattr(self, name)[:, first:end]
            sound = (np.abs(values) <= MAX_M).all(axis=tuple(range(2, values.ndim)))
            if (tracked & ~sound).any():
                subject, frame = np.argwhere(tracked & ~sound)[0]
                raise TakeError(
                    f"{name} of '{self.subject_names[subject]}' is not a number up to {MAX_M:g} at "
                    f"{self.timestamps_ns[first + frame]} ns, which is marked tracked"
                )
        quaternion = self.bone_rotation_in_world_wxyz[:, first:end][tracked]
        if not (
            np.allclose(np.linalg.norm(quaternion, axis=-1), 1, atol=1e-6)
            and (quaternion[..., 0] >= 0).all()
        ):
            raise TakeError("bone_rotation_in_world_wxyz holds a quaternion not unit with w >= 0")

    @property
    def skeleton(self) -> Skeleton:
        """The tree of bones."""
        return Skeleton(name=self.skeleton_name, bone_names=self.bone_names, parents=self.parents)

    @property
    def bone_quality(self) -> Float[np.ndarray, "s t b"]:
        """0-1, see `fusecap.types.quality_of`."""
        return quality_of(self.bone_sigma_deg)

    @property
    def time_s(self) -> Float[np.ndarray, " t"]:
        """Seconds since the first frame."""
        return (self.timestamps_ns - self.timestamps_ns[:1]) * 1e-9

    def subject(self, name: str) -> int:
        """Index of the subject called `name`; raises `TakeError` naming the nearest one."""
        if name not in self.subject_names:
            raise TakeError(f"the take has no subject '{name}'{nearest(name, self.subject_names)}")
        return self.subject_names.index(name)

    def of_subjects(self, rows: Sequence[int]) -> Take:
        """The same take with these subjects alone, in this order."""
        kept = list(rows)
        return replace(
            self,
            subject_names=tuple(self.subject_names[row] for row in kept),
            **{
                name: getattr(self, name)[kept]
                for name in ("heights_m", "offsets_m", *MARKS, *MOTION)
            },
        )

    def of_frames(self, first: int, end: int) -> Take:
        """The same take from frame `first` up to, and without, frame `end`."""
        return self._at(slice(first, end))

    def at_frames(self, frames: Sequence[int] | Int[np.ndarray, " n"]) -> Take:
        """The same take in these frames alone, which rise."""
        return self._at(np.asarray(frames, dtype=np.int64))

    def _at(self, frames: slice | Int[np.ndarray, " n"]) -> Take:
        return replace(
            self,
            timestamps_ns=self.timestamps_ns[frames],
            **{name: getattr(self, name)[:, frames] for name in (*MARKS, *MOTION)},
        )

    def with_theta(
        self,
        theta: Float[np.ndarray, "s t p"],
        *,
        tracked: Bool[np.ndarray, "s t"] | None = None,
        bone_sigma_deg: Float[np.ndarray, "s t b"] | None = None,
        position_sigma_m: Float[np.ndarray, "s t b"] | None = None,
    ) -> Take:
        """The same people in other poses; what is not given stays, and no new frame is measured."""
        tracked = self.tracked if tracked is None else tracked
        return take_from_theta(
            theta,
            [self.shape(row) for row in range(len(self.subject_names))],
            timestamps_ns=self.timestamps_ns,
            rate_hz=self.rate_hz,
            subject_names=self.subject_names,
            skeleton=self.skeleton,
            tracked=tracked,
            measured=self.measured & tracked,
            bone_sigma_deg=self.bone_sigma_deg if bone_sigma_deg is None else bone_sigma_deg,
            position_sigma_m=(
                self.position_sigma_m if position_sigma_m is None else position_sigma_m
            ),
            provenance=self.provenance,
        )

    def shape(self, subject: int) -> BodyShape:
        """The body of one subject."""
        return BodyShape(
            skeleton=self.skeleton,
            offsets_m=self.offsets_m[subject],
            height_m=float(self.heights_m[subject]),
        )

    def bone_rotation_in_world(self, subject: int) -> Float[np.ndarray, "t b 3 3"]:
        """Rotation matrices of one subject; NaN where untracked."""
        matrices = np.full((*self.bone_sigma_deg[subject].shape, 3, 3), np.nan)
        tracked = self.tracked[subject]
        quaternion = self.bone_rotation_in_world_wxyz[subject, tracked]
        matrices[tracked] = _matrix_from_wxyz(quaternion)
        return matrices


def made_by() -> str:
    """Fusecap and its version."""
    return f"fusecap {metadata.version('fusecap')}"


def provenance(
    *,
    options: Mapping[str, Any],
    session_sha256: str | None = None,
    recording: str | None = None,
    simulated: bool = False,
) -> dict[str, Any]:
    """What a take says about its making: version, session, options, units, simulated or not.

    `recording` is the name of the file that it was solved from, if it was one.
    """
    return {
        "made_by": made_by(),
        "session_sha256": session_sha256,
        "recording": recording,
        "options": dict(options),
        "simulated": simulated,
        "units": UNITS,
    }


def array_shapes(subjects: int, frames: int, bones: int) -> dict[str, tuple[int, ...]]:
    """What each array of a take measures."""
    s, t, b = subjects, frames, bones
    return {
        "timestamps_ns": (t,),
        "parents": (b,),
        "heights_m": (s,),
        "offsets_m": (s, b, 3),
        "theta": (s, t, 3 + 3 * b),
        "bone_position_in_world_m": (s, t, b, 3),
        "bone_rotation_in_world_wxyz": (s, t, b, 4),
        **dict.fromkeys(MARKS, (s, t)),
        "bone_sigma_deg": (s, t, b),
        "position_sigma_m": (s, t, b),
    }


def take_from_theta(
    theta: Float[np.ndarray, "s t p"],
    shapes: Sequence[BodyShape],
    *,
    timestamps_ns: Int[np.ndarray, " t"],
    rate_hz: float,
    subject_names: tuple[str, ...],
    skeleton: Skeleton,
    tracked: Bool[np.ndarray, "s t"] | None = None,
    measured: Bool[np.ndarray, "s t"] | None = None,
    bone_sigma_deg: Float[np.ndarray, "s t b"] | None = None,
    position_sigma_m: Float[np.ndarray, "s t b"] | None = None,
    provenance: Mapping[str, Any] | None = None,
) -> Take:
    """A take of known poses; tracked everywhere, measured where tracked and exact unless told."""
    s, t, b = len(subject_names), len(timestamps_ns), skeleton.bone_count
    if tracked is None:
        tracked = np.ones((s, t), dtype=bool)
    if bone_sigma_deg is None:
        bone_sigma_deg = np.zeros((s, t, b))
    if position_sigma_m is None:
        position_sigma_m = np.zeros((s, t, b))
    position = np.full((s, t, b, 3), np.nan)
    quaternion = np.full((s, t, b, 4), np.nan)
    for subject, shape in enumerate(shapes):
        known = np.flatnonzero(tracked[subject])
        for first in range(0, len(known), BLOCK):
            frames = known[first : first + BLOCK]
            position[subject, frames], rotation = forward_kinematics(shape, theta[subject, frames])
            quaternion[subject, frames] = _wxyz_from_matrix(rotation)
    return Take(
        timestamps_ns=timestamps_ns,
        rate_hz=rate_hz,
        subject_names=subject_names,
        skeleton_name=skeleton.name,
        bone_names=skeleton.bone_names,
        parents=skeleton.parents,
        heights_m=np.array([shape.height_m for shape in shapes], dtype=np.float64),
        offsets_m=np.array([shape.offsets_m for shape in shapes]).reshape(s, b, 3),
        theta=theta,
        bone_position_in_world_m=position,
        bone_rotation_in_world_wxyz=quaternion,
        tracked=tracked,
        measured=tracked.copy() if measured is None else measured,
        bone_sigma_deg=bone_sigma_deg,
        position_sigma_m=position_sigma_m,
        provenance=dict(provenance or {}),
    )


def save_take(take: Take, path: Path | str) -> None:
    """Write `take` whole or not at all; raises `TakeError` with the reason.

    Poses as float32, which is right to a micrometre 10 m from the origin and to 1e-5 deg; error
    bars as float16, right to 0.1 %.
    """
    frames = len(take.timestamps_ns)
    blocks = (take.of_frames(at, at + BLOCK) for at in range(0, frames, BLOCK))
    save_blocks(take.of_frames(0, 0), blocks, path)


def save_blocks(nothing: Take, blocks: Iterable[Take], path: Path | str) -> None:
    """`save_take` of one that is made block by block, and never in memory at once.

    `nothing` is the take without its frames. Raises `TakeError`.
    """
    columns = {name: [Spool() for _ in nothing.subject_names] for name in STORED}
    timestamps_ns = [nothing.timestamps_ns]
    marks = {name: [getattr(nothing, name)] for name in MARKS}
    for block in blocks:
        timestamps_ns.append(block.timestamps_ns)
        for name, blocks_of in marks.items():
            blocks_of.append(getattr(block, name))
        for name, spools in columns.items():
            for spool, values in zip(spools, getattr(block, name), strict=True):
                spool.append(values.astype(STORED[name]).tobytes())
    times_ns = np.concatenate(timestamps_ns)
    arrays = {
        "format": np.array(FORMAT),
        "timestamps_ns": times_ns,
        "rate_hz": np.array(nothing.rate_hz),
        "subject_names": np.array(nothing.subject_names, dtype=np.str_),
        "skeleton": np.array(nothing.skeleton_name),
        "bone_names": np.array(nothing.bone_names, dtype=np.str_),
        "parents": np.array(nothing.parents, dtype=np.int64),
        "heights_m": nothing.heights_m,
        "offsets_m": nothing.offsets_m,
        **{name: np.concatenate(parts, axis=1) for name, parts in marks.items()},
        "provenance": np.array(json.dumps(nothing.provenance, sort_keys=True, default=str)),
    }
    shapes = array_shapes(len(nothing.subject_names), len(times_ns), len(nothing.bone_names))
    with written_whole(Path(path)) as file, zipfile.ZipFile(file, "w") as archive:
        for name, array in arrays.items():
            with archive.open(f"{name}.npy", "w", force_zip64=True) as entry:
                np.lib.format.write_array(entry, array, allow_pickle=False)
        for name, spools in columns.items():
            header = {
                "descr": np.dtype(STORED[name]).str,
                "fortran_order": False,
                "shape": shapes[name],
            }
            with archive.open(f"{name}.npy", "w", force_zip64=True) as entry:
                np.lib.format.write_array_header_1_0(entry, header)
                for spool in spools:
                    for part in spool.parts():
                        entry.write(part)


def _wxyz_from_matrix(rotation: Float[np.ndarray, "t b 3 3"]) -> Float[np.ndarray, "t b 4"]:
    return to_wxyz(Rotation.from_matrix(rotation.reshape(-1, 3, 3))).reshape(*rotation.shape[:2], 4)


def _matrix_from_wxyz(quaternion: Float[np.ndarray, "t b 4"]) -> Float[np.ndarray, "t b 3 3"]:
    if quaternion.size == 0:
        return np.empty((*quaternion.shape[:2], 3, 3))
    return from_wxyz(quaternion.reshape(-1, 4)).as_matrix().reshape(*quaternion.shape[:2], 3, 3)
