"""Refines where cameras stand from the people they see.

A rough calibration loses good keypoints, because they do not fit it, and without them it cannot be
repaired. So two steps alternate:

    follow and solve everyone (`people_sightings`: gates as wide as the calibration is rough)
    -> move cameras, landmarks and limb lengths together (`people_adjust`)
    -> put the result back into the world of the rough calibration (`people_gauge`) -> again

until the cameras rest. Nothing is read from pictures but the keypoints, so what people do not show
is not refined: cells of an image where nobody was, lenses (unless asked), the floor.

**Held out.** Time is cut into blocks; every fourth is kept from the adjustment and only measured.
The measure is what a reader would compute: landmarks triangulated by plain least squares from all
views of a person, and the distance of each keypoint from its landmark's image. Both calibrations
are measured on the same keypoints. It cannot see an error that the blocks share, such as a
detector's bias or a world that is turned as a whole; another recording of the same cameras can see
some of it (`check_rigs`).

**How sure.** Two answers per camera: the normal equations', which believe that keypoints err
independently, and the scatter over resampled blocks, which does not. The second is the one to
believe.

**How large.** Scale is the rough calibration's, and where the session states statures or bone
lengths also theirs, each as far as it can be trusted (`STATURE_SHARE`, `BONES_SHARE`, `ROUGH_SHARE`
and how far the cameras still are from their old places); where they contradict, the bodies'.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Bool, Float

from fusecap.batch.solve import solve_instants
from fusecap.body.landmarks import LandmarkSet
from fusecap.body.pose import forward_kinematics, landmarks_in_world
from fusecap.calibrate.cameras.people_adjust import (
    Adjusted,
    Evidence,
    Free,
    State,
    adjust,
    lengths_of,
    residuals_px,
)
from fusecap.calibrate.cameras.people_gauge import align, gauge_free, motions
from fusecap.calibrate.cameras.people_sightings import Sightings, roughness, sight, stride_of
from fusecap.calibrate.offsets import reprojection_error_px
from fusecap.calibrate.verdict import Verdict
from fusecap.errors import InputError
from fusecap.geometry.camera import Rig
from fusecap.geometry.similarity import Similarity
from fusecap.geometry.triangulation import ROBUST_SCALE_PX, triangulate
from fusecap.progress import Progress
from fusecap.setup import setup_of
from fusecap.sources.session_data import SessionData
from fusecap.types import Detections, ImuReading

CHECK_EVERY = 4
"""Of this many blocks one is held out."""
BLOCK_S = 2.0
"""Length of a block: a step of walking or two, after which people stand elsewhere."""
MIN_BLOCKS = 8
"""A shorter session has shorter blocks."""
ADJUSTED = 160
"""Person-instants in an adjustment, spread evenly; more of the same poses add little."""
MAX_ROUNDS = 6
RESTED_PX = 0.2
"""Of a 1920-pixel-wide image: cameras rest when a round moves images by less, in the mean."""
RESAMPLED = 8
"""Draws of blocks that measure the repeatability."""
IMPROVES, IMPROVES_PX = 0.97, 0.1
"""The held-out median must fall to this share and by so much, or the old calibration stays."""
MIN_INSTANTS = 20
STATURE_SHARE, BONES_SHARE, ROUGH_SHARE = 0.04, 0.015, 0.01
"""How well limbs follow from a stature (people's proportions differ), from measured bones
(keypoints are not quite at joints), and how well a rough calibration knows its scale at best. A
detector's bias is everyone's, so more subjects know no better."""
CONTRADICTS = 2.0
"""Of these sigmas: where bodies and calibration differ by more, a length was stated wrongly when
the cameras were calibrated, and the bodies decide alone."""
COVERED_SHARE = 0.25
"""Of an image's 6 x 6 cells: fewer with keypoints leave its rest to extrapolation."""
WALKED_M = 1.0
"""Smaller extents on the floor leave distances poorly known."""
UNSURE_M, UNSURE_RAD = 0.02, np.radians(0.5)
SHARED_SHARE = 0.1
"""Of person-instants, those in which a camera should take part."""
LEFT_PX = 8.0
"""Held-out median of a 1920-pixel-wide image that better camera poses alone should undercut."""

_WIDER = (1.0, 2.0, 4.0)
_LIMBS = [
    *(("left_shoulder", "right_shoulder"), ("left_hip", "right_hip")),
    *(
        (f"{side}_{a}", f"{side}_{b}")
        for side in ("left", "right")
        for a, b in (
            *(("shoulder", "elbow"), ("elbow", "wrist"), ("hip", "knee"), ("knee", "ankle")),
            *(("ankle", "heel"), ("ankle", "big_toe")),
        )
    ),
]
_MEASURED_LIMBS = ("elbow", "wrist", "knee", "ankle")
"""Far ends of the limbs whose keypoints lie at joints well enough to scale a world."""


@dataclass(frozen=True, kw_only=True)
class Fit:
    """Residuals of one camera on held-out instants, in its own pixels."""

    median_px: float
    p90_px: float
    keypoints: int


@dataclass(frozen=True, kw_only=True)
class CameraChange:
    """What happened to one camera."""

    name: str
    before: Fit
    after: Fit
    skeleton_before_px: float
    """Median distance of held-out keypoints from the solved skeleton's landmarks."""
    skeleton_after_px: float
    moved_mm: float
    turned_deg: float
    focal_share: float
    """New focal length over the old."""
    sigma_mm: float
    """Uncertainty of the centre from the normal equations (3D)."""
    sigma_deg: float
    repeat_mm: float
    """Scatter of the centre over resampled blocks (3D)."""
    repeat_deg: float
    covered: float
    """Share of the image's 6 x 6 cells in which keypoints served the adjustment."""


@dataclass(frozen=True, kw_only=True)
class PeopleCalibration:
    """A refined rig and what is known about it."""

    rig: Rig
    improved: bool
    """Whether held-out keypoints say that it is better; if not, keep the old one."""
    cameras: tuple[CameraChange, ...]
    before: Fit
    """All cameras together."""
    after: Fit
    skeleton_before_px: float
    skeleton_after_px: float
    refined: tuple[str, ...]
    """What moved beside the poses: those of `focal`, `centre`, `distortion` that helped."""
    rounds: int
    fit_person_instants: int
    check_person_instants: int
    blocks: tuple[int, int]
    """Blocks of the adjustment, and held out."""
    block_s: float
    scale: float
    """New metres per old one."""
    scale_from: str
    walked_m: tuple[float, float]
    """Extents in x and z in which people's hips were, 5 % to 95 %."""
    feet_m: float
    """Height of the lowest tenth of foot keypoints above the floor of the new world."""
    notes: tuple[str, ...]
    """What keeps the result from being good, with its remedy."""
    residuals_px: Mapping[str, tuple[np.ndarray, np.ndarray]] = field(repr=False)
    """Per camera the held-out residuals (n, 2) before and after, for a picture."""

    @property
    def verdict(self) -> Verdict:
        """Poor where the old calibration is to be kept."""
        if not self.improved:
            return Verdict.POOR
        return Verdict.USABLE if self.notes else Verdict.GOOD


def refine_from_people(
    data: SessionData,
    *,
    refine: Sequence[str] = (),
    progress: Progress | None = None,
) -> PeopleCalibration:
    """Move the cameras of a session so that its people's keypoints agree.

    `refine` names intrinsics that may move too: `focal`, `centre`, `distortion`; they stay as they
    were unless held-out keypoints gain by it. Raises `InputError` where this cannot be done: one
    camera, cameras that share nobody, nobody found, too short.
    """
    _check(data)
    assert data.landmarks is not None
    stride = stride_of(data)
    detections = [(i, data.detections(i)) for i in range(0, len(data.times_s), stride)]
    split = _Split.of(data, [i for i, _ in detections])
    rough = data.rig
    session = _Session(data=data, detections=detections, split=split, progress=progress)
    found = session.alternate(rough, Free())
    used: tuple[str, ...] = ()
    if refine:
        free = Free(**dict.fromkeys(refine, True))
        more = session.alternate(found.adjusted.state.rig, free, trusted=rough)
        common = more.sightings.rows(split.held_out(more.sightings.instant))
        if _better(_fit(_residuals(more.rig, common)), _fit(_residuals(found.rig, common))):
            found, used = more, tuple(refine)
    return session.report(rough, found, used)


def check_rigs(data: SessionData, follow: Rig, rigs: Sequence[Rig]) -> dict[str, tuple[Fit, ...]]:
    """Residuals of a whole session under rigs that were calibrated elsewhere, rig by rig.

    People are followed under `follow`, so that all rigs meet the same keypoints. Per camera, then
    per person; "all" are all together. Pixels are the cameras' own.
    """
    _check(data)
    detections = [(i, data.detections(i)) for i in range(len(data.times_s))]
    seen = sight(data, follow, roughness(follow, data).gates(), detections)
    residuals = np.array([_residuals(rig, seen) for rig in rigs])

    def fits(parts: Float[np.ndarray, "r *n"]) -> tuple[Fit, ...]:
        return tuple(_fit(part) for part in parts)

    return {
        "all": fits(residuals),
        **{name: fits(residuals[:, :, c]) for c, name in enumerate(follow.names)},
        **{name: fits(residuals[:, seen.person == p]) for p, name in enumerate(seen.names)},
    }


@dataclass(frozen=True, kw_only=True)
class _Split:
    """Time in blocks; every `CHECK_EVERY`th is held out."""

    block_of: np.ndarray
    """Per instant of the session."""
    count: int
    block_s: float

    @classmethod
    def of(cls, data: SessionData, instants: Sequence[int]) -> _Split:
        span_s = float(data.times_s[instants[-1]] - data.times_s[instants[0]])
        count = max(MIN_BLOCKS, round(span_s / BLOCK_S))
        share = np.arange(len(data.times_s)) / len(data.times_s)
        return cls(
            block_of=np.floor(share * count).astype(int), count=count, block_s=span_s / count
        )

    def held_out(self, instant: np.ndarray) -> np.ndarray:
        """Which of the instants check."""
        return self.block_of[instant] % CHECK_EVERY == CHECK_EVERY - 2

    @property
    def fit_blocks(self) -> np.ndarray:
        blocks = np.arange(self.count)
        return blocks[blocks % CHECK_EVERY != CHECK_EVERY - 2]


@dataclass(frozen=True, kw_only=True)
class _Found:
    """The end of an alternation, in the rough calibration's world."""

    rig: Rig
    adjusted: Adjusted
    evidence: Evidence
    rows: Sightings
    """Person-instants of the adjustment."""
    sightings: Sightings
    """All."""
    free: Free
    rounds: int


@dataclass(frozen=True, kw_only=True)
class _Session:
    """What the steps share."""

    data: SessionData
    detections: Sequence[tuple[int, Detections]]
    split: _Split
    progress: Progress | None

    def alternate(self, rig: Rig, free: Free, trusted: Rig | None = None) -> _Found:
        """Follow, adjust, align, until the cameras rest; `trusted` is the rough calibration."""
        rough = trusted or rig
        found = None
        for number in range(1, MAX_ROUNDS + 1):
            seen = self._sight(rig, first=number == 1)
            rows = self._fit_rows(seen)
            evidence = _evidence(self._landmarks, rows)
            scale_px = ROBUST_SCALE_PX + roughness(rig, self.data).pixels
            points = _triangulated(rig, rows, scale_px)
            state = State(rig=rig, points=points, lengths_m=lengths_of(points, evidence))
            self._show("adjusting", number - 1, MAX_ROUNDS)
            adjusted = adjust(state, rough, evidence, free, sigma_px=max(scale_px / 2, 5.0))
            similarity = align(adjusted.state.rig, rough).similarity
            adjusted = _in_world(adjusted, similarity)
            new = adjusted.state.rig
            moved_px = _image_motion_px(rig, new, adjusted.state.points)
            rig = new
            found = _Found(
                rig=new,
                adjusted=adjusted,
                evidence=evidence,
                rows=rows,
                sightings=seen,
                free=free,
                rounds=number,
            )
            if moved_px < RESTED_PX:
                break
        assert found is not None
        self._show("adjusting", MAX_ROUNDS, MAX_ROUNDS)
        return replace(found, sightings=self._sight(rig, first=False))

    def report(self, rough: Rig, found: _Found, refined: tuple[str, ...]) -> PeopleCalibration:
        """Held-out residuals, uncertainties, verdict."""
        alignment = align(found.adjusted.state.rig, rough)
        own = 6 + found.free.intrinsics
        covariance = gauge_free(found.adjusted.information, found.rig, alignment, own)
        repeat_m, repeat_rad = self._repeatability(rough, found)
        centres = np.array([camera.position_in_world for camera in found.rig.cameras])
        radius_m = float(np.sqrt(((centres - centres.mean(axis=0)) ** 2).sum()))
        scale, source = self._scale(found, alignment.shift_m / radius_m)
        rig = Similarity(scale=scale).rig(found.rig)
        held_out = found.sightings.rows(self.split.held_out(found.sightings.instant))
        before, after = _residuals(rough, held_out), _residuals(rig, held_out)
        skeleton = self._skeleton(rough), self._skeleton(rig)
        moved_m, turned_rad = motions(rig, rough)
        points = scale * found.adjusted.state.points
        cameras = tuple(
            CameraChange(
                name=name,
                before=_fit(before[:, c]),
                after=_fit(after[:, c]),
                skeleton_before_px=skeleton[0][name],
                skeleton_after_px=skeleton[1][name],
                moved_mm=1e3 * float(moved_m[c]),
                turned_deg=float(np.degrees(turned_rad[c])),
                focal_share=float(rig.cameras[c].matrix[0, 0] / rough.cameras[c].matrix[0, 0]),
                sigma_mm=1e3 * scale * _root_trace(covariance, c * own + 3),
                sigma_deg=float(np.degrees(_root_trace(covariance, c * own))),
                repeat_mm=1e3 * scale * float(repeat_m[c]),
                repeat_deg=float(np.degrees(repeat_rad[c])),
                covered=_covered(rough, found.rows, c),
            )
            for c, name in enumerate(rig.names)
        )
        pooled_before, pooled_after = _fit(before), _fit(after)
        walked = _walked_m(points, self._landmarks)
        result = PeopleCalibration(
            rig=rig,
            improved=_better(pooled_after, pooled_before),
            cameras=cameras,
            before=pooled_before,
            after=pooled_after,
            skeleton_before_px=skeleton[0]["all"],
            skeleton_after_px=skeleton[1]["all"],
            refined=refined,
            rounds=found.rounds,
            fit_person_instants=len(found.rows),
            check_person_instants=len(held_out),
            blocks=(len(self.split.fit_blocks), self.split.count - len(self.split.fit_blocks)),
            block_s=self.split.block_s,
            scale=scale,
            scale_from=source,
            walked_m=walked,
            feet_m=_feet_m(points, self._landmarks),
            notes=(),
            residuals_px={
                name: (_vectors(rough, held_out, c), _vectors(rig, held_out, c))
                for c, name in enumerate(rig.names)
            },
        )
        return replace(result, notes=_notes(result, rough, found.rows.views))

    @property
    def _landmarks(self) -> LandmarkSet:
        assert self.data.landmarks is not None
        return self.data.landmarks

    def _show(self, what: str, done: int, total: int) -> None:
        if self.progress:
            self.progress(what, done, total)

    def _sight(self, rig: Rig, *, first: bool) -> Sightings:
        """People under `rig`; the first time with wider gates until enough are found."""
        rough = roughness(rig, self.data)
        seen = None
        for factor in _WIDER if first else _WIDER[:1]:
            seen = sight(self.data, rig, rough.gates(factor), self.detections, self.progress)
            fit = ~self.split.held_out(seen.instant)
            if fit.sum() >= MIN_INSTANTS and not _apart(seen.views[fit]):
                return seen
        assert seen is not None
        raise InputError(_nobody(self.data, seen, rough.pixels, ~self.split.held_out(seen.instant)))

    def _fit_rows(self, seen: Sightings) -> Sightings:
        rows = np.flatnonzero(~self.split.held_out(seen.instant))
        spread = np.linspace(0, len(rows) - 1, min(ADJUSTED, len(rows))).round().astype(int)
        return seen.rows(rows[spread])

    def _repeatability(self, rough: Rig, found: _Found) -> tuple[np.ndarray, np.ndarray]:
        """Scatter of every camera's centre [m] and direction [rad] over resampled fit blocks."""
        rng = np.random.default_rng(0)
        block = self.split.block_of[found.rows.instant]
        rigs = []
        for draw in range(RESAMPLED):
            drawn = rng.choice(self.split.fit_blocks, len(self.split.fit_blocks))
            count = np.bincount(drawn, minlength=self.split.count)[block]
            if (count > 0).sum() >= MIN_INSTANTS // 2:
                adjusted = adjust(
                    found.adjusted.state,
                    rough,
                    replace(found.evidence, weight=count.astype(np.float64)),
                    found.free,
                    sigma_px=found.adjusted.sigma_px,
                )
                aligned = align(adjusted.state.rig, rough).similarity.rig(adjusted.state.rig)
                rigs.append(motions(aligned, found.rig))
            self._show("resampling blocks", draw + 1, RESAMPLED)
        if not rigs:
            return np.full(len(rough), np.nan), np.full(len(rough), np.nan)
        shift, angle = np.array([r[0] for r in rigs]), np.array([r[1] for r in rigs])
        return np.sqrt((shift**2).mean(axis=0)), np.sqrt((angle**2).mean(axis=0))

    def _scale(self, found: _Found, rough_share: float) -> tuple[float, str]:
        """New metres per metre of the rough calibration, and where it comes from."""
        limbs = _limbs(self._landmarks)
        names = self._landmarks.landmark_names
        wanted = [row for row, (_, far) in enumerate(limbs) if names[far].endswith(_MEASURED_LIMBS)]
        votes, weights = [], []
        setup = setup_of(self.data.session, self.data.rig, self.data.landmarks)
        models = {model.name: model for model in setup.subjects}
        stated = {subject.name: subject for subject in self.data.session.subjects}
        for person, name in enumerate(found.rows.names):
            model = models.get(name)
            if model is None or model.shape is None or person >= found.evidence.people:
                continue
            shape = model.shape
            position, rotation = forward_kinematics(shape, np.zeros((1, shape.skeleton.pose_size)))
            bones = self._landmarks.bones(shape.skeleton)
            offsets_m = self._landmarks.of(name).offsets_m(shape)
            rest = landmarks_in_world(position, rotation, bones, offsets_m)[0]
            true = np.linalg.norm(rest[limbs[:, 0]] - rest[limbs[:, 1]], axis=1)[wanted]
            measured = found.adjusted.state.lengths_m[person, wanted]
            ratio = true[np.isfinite(measured)] / measured[np.isfinite(measured)]
            if len(ratio) >= 4:
                share = BONES_SHARE if stated[name].bone_lengths_m else STATURE_SHARE
                votes.append(float(np.log(np.median(ratio))))
                weights.append(1 / share**2)
        if not votes:
            return 1.0, "the rough calibration"
        rough_share = float(np.hypot(rough_share, ROUGH_SHARE))
        share = float(1 / np.sqrt(max(weights)))
        ratio = float(np.average(votes, weights=weights))
        who = f"the bodies of {len(votes)} subject{'s' if len(votes) > 1 else ''}"
        if abs(ratio) > CONTRADICTS * np.hypot(share, rough_share):
            return float(np.exp(ratio)), f"{who}, which contradict the rough calibration"
        kept = rough_share**2 / (rough_share**2 + share**2)
        return float(np.exp(kept * ratio)), (
            f"the rough calibration (known to {100 * rough_share:.1f} %) and {who} "
            f"(known to {100 * share:.1f} %)"
        )

    def _skeleton(self, rig: Rig) -> dict[str, float]:
        """Median held-out distance [px] from solved landmarks per camera; "all" is their median."""
        setup = setup_of(self.data.session, rig, self.data.landmarks)
        instants = _Listed(self.data, self.detections)
        take = solve_instants(setup, instants, progress=self.progress).take
        held_out = [
            moment
            for (instant, _), (_, moment) in zip(self.detections, self.detections, strict=True)
            if self.split.held_out(np.array([instant]))[0]
        ]
        result, pooled = {}, []
        for c, camera in enumerate(rig.cameras):
            alone = [replace(moment, people=(moment.people[c],)) for moment in held_out]
            one = Rig(cameras=(camera,))
            error = reprojection_error_px(one, self._landmarks, take, alone)
            result[camera.name] = error.median
            pooled.append(error.median)
        return result | {
            "all": float(np.nanmedian(pooled)) if np.isfinite(pooled).any() else np.nan
        }


class _Listed:
    """Instants that were read before."""

    def __init__(self, data: SessionData, detections: Sequence[tuple[int, Detections]]) -> None:
        self._data, self._detections = data, detections

    def __len__(self) -> int:
        return len(self._detections)

    def detections(self, instant: int) -> Detections:
        """Everyone in every camera."""
        return self._detections[instant][1]

    def readings(self, instant: int) -> Mapping[str, ImuReading]:
        """By subject name, what its sensors say."""
        row = self._detections[instant][0]
        return {imus.subject: imus.reading(row) for imus in self._data.imus}


def _check(data: SessionData) -> None:
    path = data.session.path
    if data.landmarks is None or len(data.rig) < 2:
        raise InputError(
            f"{path}: found {len(data.rig)} camera{'s' if len(data.rig) != 1 else ''} with "
            "keypoints; people can tell where cameras stand only from two views or more: list more "
            "[[camera]] tables, or calibrate with a board"
        )
    if len(data.times_s) < 2 * MIN_INSTANTS:
        raise InputError(
            f"{path}: {len(data.times_s)} instants; refining cameras from people needs "
            f"{2 * MIN_INSTANTS} or more, best a minute of walking"
        )


def _apart(views: np.ndarray) -> list[int]:
    """Cameras (n, c) not linked to the one that sees most by people seen together."""
    shared = views.T.astype(int) @ views.astype(int) >= MIN_INSTANTS // 2
    if not len(views):
        return list(range(views.shape[1]))
    linked = {int(np.argmax(views.sum(axis=0)))}
    while True:
        more = {int(b) for a in linked for b in np.flatnonzero(shared[a])} - linked
        if not more:
            return [c for c in range(views.shape[1]) if c not in linked]
        linked |= more


def _nobody(data: SessionData, seen: Sightings, pixels: float, fit: np.ndarray) -> str:
    path = data.session.path
    found = sum(len(people) for track in data.keypoints for people in track.people)
    if found == 0:
        return f"{path}: no camera has a keypoint; detect people first, and see: fusecap doctor"
    if fit.sum() < MIN_INSTANTS:
        return (
            f"{path}: people could be followed at {int(fit.sum())} instants, expected "
            f"{MIN_INSTANTS} or more; views disagree by {pixels:.0f} px of a 1920-pixel-wide "
            "image. Either cameras never see the same person, clocks disagree (fusecap doctor "
            "tells), or the calibration is too rough to start from: calibrate with a board first"
        )
    lost = ", ".join(f"'{data.rig.names[c]}'" for c in _apart(seen.views[fit]))
    return (
        f"{path}: camera {lost} sees nobody together with the others at {MIN_INSTANTS // 2} "
        "instants or more; let people walk where its view meets theirs, leave it out of the "
        "session, or calibrate it with a board"
    )


def _limbs(landmarks: LandmarkSet) -> np.ndarray:
    names = landmarks.landmark_names
    return np.array(
        [(names.index(a), names.index(b)) for a, b in _LIMBS if a in names and b in names]
    )


def _evidence(landmarks: LandmarkSet, rows: Sightings) -> Evidence:
    return Evidence(
        keypoints=rows.keypoints,
        person=rows.person,
        limbs=_limbs(landmarks),
        weight=np.ones(len(rows)),
    )


def _triangulated(rig: Rig, rows: Sightings, scale_px: float) -> Float[np.ndarray, "n k 3"]:
    return np.array([triangulate(rig, seen, scale_px)[0] for seen in rows.keypoints])


def _residuals(rig: Rig, rows: Sightings) -> Float[np.ndarray, "n c k"]:
    """Of landmarks triangulated by plain least squares from all views, in each camera's pixels."""
    if not len(rows):
        return np.full(rows.keypoints.shape[:3], np.nan)
    return residuals_px(rig, rows.keypoints, _triangulated(rig, rows, _NO_GATE_PX))


_NO_GATE_PX = 1e6
"""A robust scale so large that triangulation is plain least squares."""


def _vectors(rig: Rig, rows: Sightings, c: int) -> Float[np.ndarray, "n 2"]:
    """Held-out residual vectors of one camera [px]."""
    if not len(rows):
        return np.zeros((0, 2))
    points = _triangulated(rig, rows, _NO_GATE_PX)
    seen = rows.keypoints[:, c]
    used = seen[:, :, 2] > 0
    away = seen[used][:, :2] - rig.cameras[c].project(points[used])
    return away[np.isfinite(away[:, 0])]


def _fit(residual: np.ndarray) -> Fit:
    known = residual[np.isfinite(residual)]
    if not len(known):
        return Fit(median_px=np.nan, p90_px=np.nan, keypoints=0)
    return Fit(
        median_px=float(np.median(known)),
        p90_px=float(np.percentile(known, 90)),
        keypoints=len(known),
    )


def _better(after: Fit, before: Fit) -> bool:
    limit_px = min(IMPROVES * before.median_px, before.median_px - IMPROVES_PX)
    return after.median_px < limit_px


def _in_world(adjusted: Adjusted, similarity: Similarity) -> Adjusted:
    state = adjusted.state
    cameras = len(state.rig)
    unit = np.ones((cameras, len(adjusted.information) // cameras))
    unit[:, 3:6] = similarity.scale
    return replace(
        adjusted,
        state=State(
            rig=similarity.rig(state.rig),
            points=similarity.points(state.points),
            lengths_m=similarity.scale * state.lengths_m,
        ),
        information=adjusted.information / np.outer(unit, unit),
    )


def _image_motion_px(old: Rig, new: Rig, points: Float[np.ndarray, "n k 3"]) -> float:
    """Mean motion of the landmarks' images, in pixels of a 1920-pixel-wide image."""
    flat = points[np.isfinite(points[:, :, 0])]
    moved = [
        np.linalg.norm(a.project(flat) - b.project(flat), axis=1) * a.pixel_scale
        for a, b in zip(old.cameras, new.cameras, strict=True)
    ]
    return float(np.nanmean(moved))


def _root_trace(covariance: np.ndarray, first: int) -> float:
    return float(np.sqrt(np.trace(covariance[first : first + 3, first : first + 3])))


def _covered(rig: Rig, rows: Sightings, c: int) -> float:
    seen = rows.keypoints[:, c][rows.keypoints[:, c, :, 2] > 0]
    cells = np.floor(6 * seen[:, :2] / rig.cameras[c].size_px)
    inside = cells[((cells >= 0) & (cells < 6)).all(axis=1)]
    return len(np.unique(inside, axis=0)) / 36


def _walked_m(points: Float[np.ndarray, "n k 3"], landmarks: LandmarkSet) -> tuple[float, float]:
    hips = [i for side in ("left", "right") if (i := landmarks.index(f"{side}_hip")) is not None]
    middle = points[:, hips].mean(axis=1)
    middle = middle[np.isfinite(middle[:, 0])]
    if not len(middle):
        return 0.0, 0.0
    low, high = np.percentile(middle, [5, 95], axis=0)
    return float(high[0] - low[0]), float(high[2] - low[2])


def _feet_m(points: Float[np.ndarray, "n k 3"], landmarks: LandmarkSet) -> float:
    names = landmarks.landmark_names
    feet = [i for i, name in enumerate(names) if name.endswith(("heel", "toe"))]
    height = points[:, feet, 1]
    height = height[np.isfinite(height)]
    return float(np.percentile(height, 10)) if len(height) else float("nan")


def _notes(
    result: PeopleCalibration, rough: Rig, views: Bool[np.ndarray, "n c"]
) -> tuple[str, ...]:
    """What could not be measured counts as poor; `views` are the adjustment's."""
    notes = []
    if not result.improved:
        notes.append(
            f"held-out keypoints do not fit better ({result.before.median_px:.1f} px before, "
            f"{result.after.median_px:.1f} px after): keep the old calibration"
        )
    if max(result.walked_m) < WALKED_M:
        notes.append(
            f"people stay within {result.walked_m[0]:.1f} x {result.walked_m[1]:.1f} m: record "
            "someone who walks through the whole volume"
        )
    cameras = list(zip(result.cameras, rough.cameras, views.T, strict=True))

    def note(which: Sequence[str], remedy: str) -> None:
        if which:
            notes.append(f"{', '.join(which)}: {remedy}")

    note(
        [
            f"'{c.name}' ({100 * c.covered:.0f} %)"
            for c, _, _ in cameras
            if c.covered < COVERED_SHARE
        ],
        "people cover so little of the image, the rest is extrapolated: walk to its edges, near "
        "and far",
    )
    note(
        [
            f"'{c.name}' ({c.repeat_mm:.0f} mm, {c.repeat_deg:.2f} deg)"
            for c, _, _ in cameras
            if not (c.repeat_mm <= 1e3 * UNSURE_M and c.repeat_deg <= np.degrees(UNSURE_RAD))
        ],
        "not known better than that: record longer, with more people and poses",
    )
    note(
        [
            f"'{c.name}' ({seen.sum()} of {len(seen)} person-instants)"
            for c, _, seen in cameras
            if seen.sum() < SHARED_SHARE * len(seen)
        ],
        "little is shared with other cameras: let people walk where views meet",
    )
    note(
        [f"'{c.name}'" for c in result.cameras if not c.after.keypoints],
        "no held-out keypoint checks it: record longer, with people where views meet",
    )
    note(
        [
            f"'{c.name}' ({c.before.median_px:.1f} -> {c.after.median_px:.1f} px)"
            for c in result.cameras
            if result.improved and _better(c.before, c.after)
        ],
        "fits worse than before although all together fit better: check its lens and its clock",
    )
    note(
        [
            f"'{c.name}' ({c.after.median_px:.1f} px)"
            for c, lens, _ in cameras
            if c.after.median_px * lens.pixel_scale > LEFT_PX
        ],
        "more remains than a detector's scatter; camera poses alone do not explain it: check the "
        "lens (fusecap calibrate intrinsics) and the clock (fusecap doctor)",
    )
    if abs(result.feet_m) > 0.05:
        notes.append(
            f"feet stand {1e3 * result.feet_m:+.0f} mm from the floor of this world: mark the "
            "floor if that is not what they stood on (fusecap calibrate world)"
        )
    return tuple(notes)
