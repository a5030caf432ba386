"""People who wear sensors on limbs that cameras see: which of those seen they are."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from fusecap.associate.sensor_vote import MIN_LIMBS, limbs_of
from fusecap.checks.views import ComparedViews
from fusecap.errors import FusecapError
from fusecap.sources.imu_files.track import ImuTrack
from fusecap.sources.session import Session, SubjectSettings
from fusecap.sources.session_sensors import mount
from fusecap.sources.synchronizer import MountedImu, resample_imus

LEAST_INSTANTS = 10


@dataclass(frozen=True, kw_only=True)
class Wearer:
    """One person's sensors, against people as cameras see them."""

    name: str
    imus: tuple[MountedImu, ...]
    times_s: Float[np.ndarray, " t"]
    limbs: Int[np.ndarray, "l 3"]
    rest: Float[np.ndarray, "l 3"]
    seen: Float[np.ndarray, "t p l 3"]
    """Where everybody's limbs point; NaN where not seen."""

    def shifted(self, shifts_s: Float[np.ndarray, " s"]) -> Float[np.ndarray, "s t l 3"]:
        """`turned` at the instants, later by each of the shifts."""
        times_s = (self.times_s - shifts_s[:, None]).ravel()
        return self.turned(times_s).reshape(len(shifts_s), len(self.times_s), -1, 3)

    def turned(self, times_s: Float[np.ndarray, " n"]) -> Float[np.ndarray, "n l 3"]:
        """Where limbs point by their sensors."""
        rotations, _ = resample_imus(self.imus, times_s)
        return np.einsum("tlij,lj->tli", rotations[:, self.limbs[:, 0]], self.rest)

    def own(self, turned: Float[np.ndarray, "t l 3"]) -> Float[np.ndarray, "t l 3"]:
        """Limbs of whoever fits best at each instant; NaN where nobody can be told."""
        who = self._who(turned)
        every = np.arange(len(who))
        return np.where((who >= 0)[:, None, None], self.seen[every, who], np.nan)

    def people(self, views: ComparedViews) -> Float[np.ndarray, "n k 3"]:
        """The person who wears them, wherever seen."""
        who = self._who(self.turned(self.times_s)).tolist()
        own = [people[w] for people, w in zip(views.people, who, strict=True) if w >= 0]
        return np.array(own).reshape(len(own), *views.people[0].shape[1:])

    def _who(self, turned: Float[np.ndarray, "t l 3"]) -> Int[np.ndarray, " t"]:
        """Of everybody at each instant, or -1."""
        cosine = np.einsum("tpli,tli->tpl", self.seen, turned)
        known = np.isfinite(cosine)
        count = known.sum(axis=2)
        off = np.where(known, 1.0 - cosine, 0.0).sum(axis=2) / np.maximum(count, 1)
        off[count < MIN_LIMBS] = np.inf
        best = off.argmin(axis=1)
        return np.where(np.isfinite(off.min(axis=1)), best, -1)

    def per_sensor(
        self, own: Float[np.ndarray, "t l 3"], turned: Float[np.ndarray, "t l 3"]
    ) -> Float[np.ndarray, " i"]:
        """Median angles [rad]; NaN for sensors that too few instants tell of."""
        cosine = np.einsum("tli,tli->tl", own, turned)
        return np.array(
            [median_angle(cosine[:, self.limbs[:, 0] == i]) for i in range(len(self.imus))]
        )


def median_angle(cosine: np.ndarray) -> float:
    known = cosine[np.isfinite(cosine)]
    if len(known) < LEAST_INSTANTS:
        return float("nan")
    return float(np.arccos(np.clip(np.median(known), -1.0, 1.0)))


def wearers(
    session: Session, views: ComparedViews, imus: Mapping[str, Sequence[ImuTrack | None]]
) -> list[Wearer]:
    """Who wears sensors on three limbs or more."""
    return [
        wearer
        for subject in session.subjects
        if (wearer := _wearer(subject, imus.get(subject.name, ()), views)) is not None
    ]


def _wearer(
    subject: SubjectSettings, tracks: Sequence[ImuTrack | None], views: ComparedViews
) -> Wearer | None:
    mounted: list[MountedImu] = []
    for imu, track in zip(subject.imus, tracks, strict=True):
        if track is not None:
            try:
                mounted += mount(subject.model_copy(update={"imus": (imu,)}), [track])
            except FusecapError:  # told where sensors are checked
                continue
    limbs, rest = limbs_of(views.tracks[0].landmarks, [imu.bone for imu in mounted])
    if len(limbs) < MIN_LIMBS:
        return None
    most = max(map(len, views.people))
    seen = np.full((len(views.times_s), most, len(limbs), 3), np.nan)
    for row, people in enumerate(views.people):
        along = people[:, limbs[:, 2]] - people[:, limbs[:, 1]]
        length = np.linalg.norm(along, axis=2, keepdims=True)
        seen[row, : len(people)] = along / np.maximum(length, 1e-9)
    if most == 0:
        return None
    return Wearer(
        name=subject.name,
        imus=tuple(mounted),
        times_s=views.times_s,
        limbs=limbs,
        rest=rest,
        seen=seen,
    )
