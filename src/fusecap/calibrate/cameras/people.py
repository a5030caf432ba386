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
from dataclasses import replace

import numpy as np
from jaxtyping import Float

from fusecap.batch.solve import solve_instants
from fusecap.body.landmarks import LandmarkSet
from fusecap.body.pose import forward_kinematics, landmarks_in_world
from fusecap.calibrate.cameras.people_adjust import Free, adjust, residuals_px
from fusecap.calibrate.cameras.people_gauge import align, gauge_free, motions
from fusecap.calibrate.cameras.people_report import (
    CameraChange,
    HeldOutFit,
    PeopleCalibration,
    better,
    fit_of,
    notes_on,
)
from fusecap.calibrate.cameras.people_rounds import (
    MIN_INSTANTS,
    Alternation,
    Rounds,
    Split,
    limbs_of,
    triangulated,
)
from fusecap.calibrate.cameras.people_sightings import Sightings, roughness, sight, stride_of
from fusecap.calibrate.offset_samples import reprojection_error_px
from fusecap.errors import InputError
from fusecap.geometry.camera import Rig
from fusecap.geometry.similarity import Similarity
from fusecap.progress import Progress
from fusecap.setup import setup_of
from fusecap.sources.session_data import SessionData
from fusecap.types import Detections, ImuReading

RESAMPLED = 8
"""Draws of blocks that measure the repeatability."""
STATURE_SHARE, BONES_SHARE, ROUGH_SHARE = 0.04, 0.015, 0.01
"""How well limbs follow from a stature (people's proportions differ), from measured bones
(keypoints are not quite at joints), and how well a rough calibration knows its scale at best. A
detector's bias is everyone's, so more subjects know no better."""
CONTRADICTS = 2.0
"""Of these sigmas: where bodies and calibration differ by more, a length was stated wrongly when
the cameras were calibrated, and the bodies decide alone."""

_MEASURED_LIMBS = ("elbow", "wrist", "knee", "ankle")
"""Far ends of the limbs whose keypoints lie at joints well enough to scale a world."""


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
    split = Split.of(data, [i for i, _ in detections])
    rough = data.rig
    rounds = Rounds(data=data, detections=detections, split=split, progress=progress)
    found = rounds.alternate(rough, Free())
    used: tuple[str, ...] = ()
    if refine:
        free = Free(**dict.fromkeys(refine, True))
        more = rounds.alternate(found.adjusted.state.rig, free, trusted=rough)
        common = more.sightings.rows(split.held_out(more.sightings.instant))
        if better(fit_of(_residuals(more.rig, common)), fit_of(_residuals(found.rig, common))):
            found, used = more, tuple(refine)
    return _report(rounds, rough, found, used)


def check_rigs(
    data: SessionData, follow: Rig, rigs: Sequence[Rig]
) -> dict[str, tuple[HeldOutFit, ...]]:
    """Residuals of a whole session under rigs that were calibrated elsewhere, rig by rig.

    People are followed under `follow`, so that all rigs meet the same keypoints. Per camera, then
    per person; "all" are all together. Pixels are the cameras' own.
    """
    _check(data)
    detections = [(i, data.detections(i)) for i in range(len(data.times_s))]
    seen = sight(data, follow, roughness(follow, data).gates(), detections)
    residuals = np.array([_residuals(rig, seen) for rig in rigs])

    def fits(parts: Float[np.ndarray, "r *n"]) -> tuple[HeldOutFit, ...]:
        return tuple(fit_of(part) for part in parts)

    return {
        "all": fits(residuals),
        **{name: fits(residuals[:, :, c]) for c, name in enumerate(follow.names)},
        **{name: fits(residuals[:, seen.person == p]) for p, name in enumerate(seen.names)},
    }


def _report(
    rounds: Rounds, rough: Rig, found: Alternation, refined: tuple[str, ...]
) -> PeopleCalibration:
    """Held-out residuals, uncertainties, verdict."""
    alignment = align(found.adjusted.state.rig, rough)
    own = 6 + found.free.intrinsics
    covariance = gauge_free(found.adjusted.information, found.rig, alignment, own)
    repeat_m, repeat_rad = _repeatability(rounds, rough, found)
    centres = np.array([camera.position_in_world for camera in found.rig.cameras])
    radius_m = float(np.sqrt(((centres - centres.mean(axis=0)) ** 2).sum()))
    scale, source = _scale(rounds, found, alignment.shift_m / radius_m)
    rig = Similarity(scale=scale).rig(found.rig)
    held_out = found.sightings.rows(rounds.split.held_out(found.sightings.instant))
    before, after = _residuals(rough, held_out), _residuals(rig, held_out)
    skeleton = _skeleton(rounds, rough), _skeleton(rounds, rig)
    moved_m, turned_rad = motions(rig, rough)
    points = scale * found.adjusted.state.points
    cameras = tuple(
        CameraChange(
            name=name,
            before=fit_of(before[:, c]),
            after=fit_of(after[:, c]),
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
    pooled_before, pooled_after = fit_of(before), fit_of(after)
    walked = _walked_m(points, rounds.landmarks)
    result = PeopleCalibration(
        rig=rig,
        improved=better(pooled_after, pooled_before),
        cameras=cameras,
        before=pooled_before,
        after=pooled_after,
        skeleton_before_px=skeleton[0]["all"],
        skeleton_after_px=skeleton[1]["all"],
        refined=refined,
        rounds=found.rounds,
        fit_person_instants=len(found.rows),
        check_person_instants=len(held_out),
        blocks=(len(rounds.split.fit_blocks), rounds.split.count - len(rounds.split.fit_blocks)),
        block_s=rounds.split.block_s,
        scale=scale,
        scale_from=source,
        walked_m=walked,
        feet_m=_feet_m(points, rounds.landmarks),
        notes=(),
        residuals_px={
            name: (_vectors(rough, held_out, c), _vectors(rig, held_out, c))
            for c, name in enumerate(rig.names)
        },
    )
    return replace(result, notes=notes_on(result, rough, found.rows.views))


def _repeatability(rounds: Rounds, rough: Rig, found: Alternation) -> tuple[np.ndarray, np.ndarray]:
    """Scatter of every camera's centre [m] and direction [rad] over resampled fit blocks."""
    rng = np.random.default_rng(0)
    block = rounds.split.block_of[found.rows.instant]
    rigs = []
    for draw in range(RESAMPLED):
        drawn = rng.choice(rounds.split.fit_blocks, len(rounds.split.fit_blocks))
        count = np.bincount(drawn, minlength=rounds.split.count)[block]
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
        rounds.show("resampling blocks", draw + 1, RESAMPLED)
    if not rigs:
        return np.full(len(rough), np.nan), np.full(len(rough), np.nan)
    shift, angle = np.array([r[0] for r in rigs]), np.array([r[1] for r in rigs])
    return np.sqrt((shift**2).mean(axis=0)), np.sqrt((angle**2).mean(axis=0))


def _scale(rounds: Rounds, found: Alternation, rough_share: float) -> tuple[float, str]:
    """New metres per metre of the rough calibration, and where it comes from."""
    limbs = limbs_of(rounds.landmarks)
    names = rounds.landmarks.landmark_names
    wanted = [row for row, (_, far) in enumerate(limbs) if names[far].endswith(_MEASURED_LIMBS)]
    votes, weights = [], []
    setup = setup_of(rounds.data.session, rounds.data.rig, rounds.data.landmarks)
    models = {model.name: model for model in setup.subjects}
    stated = {subject.name: subject for subject in rounds.data.session.subjects}
    for person, name in enumerate(found.rows.names):
        model = models.get(name)
        if model is None or model.shape is None or person >= found.evidence.people:
            continue
        shape = model.shape
        position, rotation = forward_kinematics(shape, np.zeros((1, shape.skeleton.pose_size)))
        bones = rounds.landmarks.bones(shape.skeleton)
        offsets_m = rounds.landmarks.of(name).offsets_m(shape)
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


def _skeleton(rounds: Rounds, rig: Rig) -> dict[str, float]:
    """Median held-out distance [px] from solved landmarks per camera; "all" is their median."""
    setup = setup_of(rounds.data.session, rig, rounds.data.landmarks)
    instants = _Listed(rounds.data, rounds.detections)
    take = solve_instants(setup, instants, progress=rounds.progress).whole_take
    held_out = [
        moment
        for (instant, _), (_, moment) in zip(rounds.detections, rounds.detections, strict=True)
        if rounds.split.held_out(np.array([instant]))[0]
    ]
    result, pooled = {}, []
    for c, camera in enumerate(rig.cameras):
        alone = [replace(moment, people=(moment.people[c],)) for moment in held_out]
        one = Rig(cameras=(camera,))
        error = reprojection_error_px(one, rounds.landmarks, take, alone)
        result[camera.name] = error.median
        pooled.append(error.median)
    return result | {"all": float(np.nanmedian(pooled)) if np.isfinite(pooled).any() else np.nan}


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


def _residuals(rig: Rig, rows: Sightings) -> Float[np.ndarray, "n c k"]:
    """Of landmarks triangulated by plain least squares from all views, in each camera's pixels."""
    if not len(rows):
        return np.full(rows.keypoints.shape[:3], np.nan)
    return residuals_px(rig, rows.keypoints, triangulated(rig, rows, _NO_GATE_PX))


_NO_GATE_PX = 1e6
"""A robust scale so large that triangulation is plain least squares."""


def _vectors(rig: Rig, rows: Sightings, c: int) -> Float[np.ndarray, "n 2"]:
    """Held-out residual vectors of one camera [px]."""
    if not len(rows):
        return np.zeros((0, 2))
    points = triangulated(rig, rows, _NO_GATE_PX)
    seen = rows.keypoints[:, c]
    used = seen[:, :, 2] > 0
    away = seen[used][:, :2] - rig.cameras[c].project(points[used])
    return away[np.isfinite(away[:, 0])]


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
