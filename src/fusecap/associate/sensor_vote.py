"""Whose sensors are whose: limbs as cameras measure them against limbs as sensors turn them.

A sensor on a known bone says where that bone points, two triangulated landmarks say it as well:

    d = mean over limbs of 1 - u · R r        u measured, r at rest, R the bone's measured turn

Of the right person d is what noise, mounting and soft tissue leave, of another it is what two
bodies differ by; half a second of it tells people apart unless they do the same, facing the same
way. The mean of the last half second decides, and only by a margin.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Float, Int

from fusecap.associate.track import Track
from fusecap.body.landmarks import LandmarkSet
from fusecap.body.pose import forward_kinematics, landmarks_in_world
from fusecap.body.shape import BodyShape
from fusecap.body.skeleton import PAPER21
from fusecap.types import ImuReading

SPAN_S = 0.5
"""Of the mean."""
SOON_S, SURE_S = 0.25, 0.5
"""Heard for so long somebody may be named, and for so long be named anew."""
LATELY_S = 2.0
"""Who was heard since is not asked for anything else: a packet may be lost."""
FITS = 0.25
"""Sensors and limbs of one person are nearer: limbs are off by 41 degrees here."""
MARGIN = 0.12
"""By which one pairing must be better than another, per person: 28 degrees."""
MIN_LIMBS = 3

_LIMBS: dict[str, tuple[tuple[str, str], ...]] = {
    "hips": (("right_hip", "left_hip"),),
    "spine3": (("right_shoulder", "left_shoulder"), ("mid_hip", "neck")),
    "head": (("right_ear", "left_ear"),),
    **{
        f"{side}_{bone}": ((f"{side}_{upper}", f"{side}_{lower}"),)
        for side in ("left", "right")
        for bone, upper, lower in (
            ("upper_arm", "shoulder", "elbow"),
            ("forearm", "elbow", "wrist"),
            ("thigh", "hip", "knee"),
            ("shank", "knee", "ankle"),
            ("foot", "heel", "big_toe"),
        )
    },
}
"""Of a bone, landmarks that it carries or that lie at its ends."""


class SensorVote:
    """What sensors say about every track; of people who wear three limbs' sensors or more."""

    def __init__(self, landmark_set: LandmarkSet, worn: Mapping[str, Sequence[str]]) -> None:
        """`worn` has, per subject, the bones of its sensors in the order of its readings."""
        self._rows: dict[str, np.ndarray] = {}
        """Per wearer and limb the sensor, and the landmarks at the limb's ends (l, 3)."""
        self._rest: dict[str, np.ndarray] = {}
        """Unit directions (l, 3) in the bone's frame."""
        for name, bones in worn.items():
            rows, rest = limbs_of(landmark_set, bones)
            if len(rows) >= MIN_LIMBS:
                self._rows[name], self._rest[name] = rows, rest
        self.heard: frozenset[str] = frozenset()
        """Who says something at this instant."""
        self.lately: frozenset[str] = frozenset()
        """Who did within the last seconds."""
        self._quiet_s: dict[str, float] = {}
        self._mean: dict[Track, dict[str, tuple[float, float]]] = {}
        """Per track and wearer: the mean, and for how many seconds it was heard."""
        self._silent_s: dict[Track, float] = {}
        """Since each track was measured last."""

    @property
    def of_anybody(self) -> bool:
        """Whether somebody wears enough sensors."""
        return bool(self._rows)

    def hear(
        self,
        tracks: Sequence[Track],
        landmarks: Float[np.ndarray, "t k 3"],
        readings: Mapping[str, ImuReading],
        elapsed_s: float,
    ) -> None:
        """One instant more; `landmarks` are NaN where not measured now.

        Whoever was not measured for a moment may be somebody else since, and is heard anew.
        """
        away_s = self._silent_s
        known = [track for track in tracks if away_s.get(track, 0.0) < SOON_S]
        self._mean = {
            track: self._mean.get(track, {}) if track in known else {} for track in tracks
        }
        measured = np.isfinite(landmarks[:, :, 0]).sum(axis=1)
        self._silent_s = {
            track: 0.0 if count else away_s.get(track, 0.0) + elapsed_s
            for track, count in zip(tracks, measured, strict=True)
        }
        heard = set()
        for name in self._rows:
            if name not in readings:
                continue
            away = self.away(landmarks, name, readings[name])
            if away is None:
                continue
            heard.add(name)
            for t in np.flatnonzero(np.isfinite(away)).tolist():
                mean, heard_s = self._mean[tracks[t]].get(name, (0.0, 0.0))
                heard_s += elapsed_s
                share = min(elapsed_s / min(heard_s, SPAN_S), 1.0) if heard_s > 0.0 else 1.0
                self._mean[tracks[t]][name] = (mean + share * (float(away[t]) - mean), heard_s)
        self.heard = frozenset(heard)
        quiet_s = {name: self._quiet_s.get(name, LATELY_S) + elapsed_s for name in self._rows}
        self._quiet_s = quiet_s | dict.fromkeys(heard, 0.0)
        self.lately = frozenset(name for name, quiet in self._quiet_s.items() if quiet < LATELY_S)

    def away(
        self, landmarks: Float[np.ndarray, "t k 3"], name: str, reading: ImuReading
    ) -> Float[np.ndarray, " t"] | None:
        """Of each skeleton at one instant how badly it fits, NaN where too little is measured.

        None for somebody who has no vote now.
        """
        if name not in self._rows:
            return None
        rows = self._rows[name]
        turned = reading.bone_rotation_in_world[rows[:, 0]]
        expected = np.einsum("lij,lj->li", turned, self._rest[name])
        if np.isfinite(expected[:, 0]).sum() < MIN_LIMBS:
            return None
        limb = landmarks[:, rows[:, 2]] - landmarks[:, rows[:, 1]]
        length = np.linalg.norm(limb, axis=2)
        off = 1.0 - np.einsum("tli,li->tl", limb, expected) / np.maximum(length, 1e-9)
        known = np.isfinite(off)
        count = known.sum(axis=1)
        mean = np.where(known, off, 0.0).sum(axis=1) / np.maximum(count, 1)
        return np.where(count >= MIN_LIMBS, mean, np.nan)

    def misfit(self, track: Track, name: str, least_s: float) -> float:
        """Mean d of a track and a wearer; NaN where heard for less."""
        mean, heard_s = self._mean.get(track, {}).get(name, (0.0, -1.0))
        return mean if heard_s >= least_s else np.nan


def limbs_of(
    landmark_set: LandmarkSet, bones: Sequence[str]
) -> tuple[Int[np.ndarray, "l 3"], Float[np.ndarray, "l 3"]]:
    """Limbs that tell how sensors on these bones turn: sensor, two landmarks; where they point.

    Directions are unit vectors in the bone's frame, from the first landmark to the second.
    """
    names = landmark_set.landmark_names
    rows = [
        (sensor, names.index(a), names.index(b))
        for sensor, bone in enumerate(bones)
        for a, b in _LIMBS.get(bone, ())
        if a in names and b in names
    ]
    table = np.array(rows, dtype=np.int64).reshape(-1, 3)
    rest = _at_rest(landmark_set)
    along = rest[table[:, 2]] - rest[table[:, 1]]
    return table, along / np.linalg.norm(along, axis=1, keepdims=True)


def _at_rest(landmark_set: LandmarkSet) -> Float[np.ndarray, "k 3"]:
    shape = BodyShape.from_height(PAPER21, 1.0)
    position, rotation = forward_kinematics(shape, np.zeros((1, PAPER21.pose_size)))
    bones, offsets = landmark_set.bones(PAPER21), landmark_set.offsets_m(shape)
    return landmarks_in_world(position, rotation, bones, offsets)[0]
