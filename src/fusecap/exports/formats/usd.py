"""USD: everybody as a UsdSkel character with a plain body, y up, one time code per frame.

    /Take/<person>         SkelRoot
    /Take/<person>/<person>_rig     Skeleton: joints, bind and rest transforms
    /Take/<person>/<person>_motion  SkelAnimation
    /Take/<person>/<person>_body    Mesh

Names are made USD's identifiers, so Mixamo's colon becomes an underscore. Where a person is not
tracked the body keeps its last pose.
"""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

from fusecap.exports.body_mesh import body_mesh
from fusecap.exports.gltf_people import COLOURS
from fusecap.exports.library import missing, written_by_name
from fusecap.exports.rest_rig import RestRig
from fusecap.exports.rig_motion import RigMotion, rig_motions
from fusecap.exports.take_format import (
    METRE_AND_CM,
    UNITS_PER_M,
    AnyTake,
    ExportOptions,
    TakeFormat,
)


def write_usd(take: AnyTake, path: Path, options: ExportOptions) -> None:
    """Writes everybody, whole or not at all; raises `InputError` without usd-core."""
    written_by_name(path, lambda part: _write_stage(take, part, options))


def _write_stage(take: AnyTake, path: Path, options: ExportOptions) -> None:
    pxr = _pxr()
    stage = pxr.Usd.Stage.CreateNew(str(path))
    scale = UNITS_PER_M[options.unit]
    pxr.UsdGeom.SetStageUpAxis(stage, pxr.UsdGeom.Tokens.y)
    pxr.UsdGeom.SetStageMetersPerUnit(stage, 1.0 / scale)
    stage.SetTimeCodesPerSecond(take.rate_hz)
    stage.SetFramesPerSecond(take.rate_hz)
    stage.SetStartTimeCode(0)
    stage.SetEndTimeCode(len(take.timestamps_ns) - 1)
    root = pxr.UsdGeom.Xform.Define(stage, "/Take")
    stage.SetDefaultPrim(root.GetPrim())
    for row, motion in enumerate(rig_motions(take, options.rig)):
        _add_person(stage, motion, scale, COLOURS[row % len(COLOURS)])
        stage.Save()  # what is saved takes no memory


def _pxr() -> Any:
    """The modules of usd-core, which has no types."""
    try:
        from pxr import Gf, Tf, Usd, UsdGeom, UsdSkel, Vt
    except ImportError as error:
        raise missing(error, extra="usd") from error
    return SimpleNamespace(Gf=Gf, Tf=Tf, Usd=Usd, UsdGeom=UsdGeom, UsdSkel=UsdSkel, Vt=Vt)


def _add_person(stage: Any, motion: RigMotion, scale: float, colour: tuple[float, ...]) -> None:
    pxr = _pxr()
    name = pxr.Tf.MakeValidIdentifier(motion.name)
    place, number = f"/Take/{name}", 2
    while stage.GetPrimAtPath(place):
        place, number = f"/Take/{name}_{number}", number + 1
    shown = pxr.UsdSkel.Root.Define(stage, place).CreateVisibilityAttr()
    words = (pxr.UsdGeom.Tokens.invisible, pxr.UsdGeom.Tokens.inherited)
    for frame in motion.turns_of_tracked().tolist():
        shown.Set(words[int(motion.tracked[frame])], frame)
    rest = motion.rest
    skeleton = pxr.UsdSkel.Skeleton.Define(stage, f"{place}/{name}_rig")
    joints = pxr.Vt.TokenArray(_joint_paths(rest))
    skeleton.CreateJointsAttr(joints)
    skeleton.CreateBindTransformsAttr(_matrices(rest.rotation, scale * rest.position_m))
    skeleton.CreateRestTransformsAttr(
        _matrices(rest.rotation_in_parent, scale * rest.position_in_parent_m)
    )
    animation = pxr.UsdSkel.Animation.Define(stage, f"{place}/{name}_motion")
    animation.CreateJointsAttr(joints)
    animation.CreateScalesAttr(pxr.Vt.Vec3hArray(len(joints), (1, 1, 1)))
    rotations, translations = animation.CreateRotationsAttr(), animation.CreateTranslationsAttr()
    for frame, xyzw in enumerate(motion.rotation_xyzw):
        rotations.Set(pxr.Vt.QuatfArray.FromNumpy(xyzw), frame)
        places = np.float32(scale) * motion.position_m[frame]
        translations.Set(pxr.Vt.Vec3fArray.FromNumpy(places), frame)
    binding = pxr.UsdSkel.BindingAPI.Apply(skeleton.GetPrim())
    binding.CreateAnimationSourceRel().SetTargets([animation.GetPath()])
    _add_body(stage, f"{place}/{name}_body", rest, skeleton.GetPath(), scale, colour)


def _add_body(
    stage: Any, place: str, rest: RestRig, skeleton: Any, scale: float, colour: tuple[float, ...]
) -> None:
    pxr = _pxr()
    body = body_mesh(rest)
    points = (scale * body.vertices_m).astype(np.float32)
    mesh = pxr.UsdGeom.Mesh.Define(stage, place)
    mesh.CreatePointsAttr(pxr.Vt.Vec3fArray.FromNumpy(points))
    mesh.CreateNormalsAttr(pxr.Vt.Vec3fArray.FromNumpy(body.normals.astype(np.float32)))
    mesh.SetNormalsInterpolation(pxr.UsdGeom.Tokens.vertex)
    mesh.CreateFaceVertexCountsAttr(pxr.Vt.IntArray(len(body.faces), 3))
    mesh.CreateFaceVertexIndicesAttr(pxr.Vt.IntArray.FromNumpy(body.faces.astype(np.int32).ravel()))
    mesh.CreateExtentAttr([points.min(axis=0).tolist(), points.max(axis=0).tolist()])
    mesh.CreateSubdivisionSchemeAttr(pxr.UsdGeom.Tokens.none)
    mesh.CreateDisplayColorAttr([pxr.Gf.Vec3f(*colour)])
    binding = pxr.UsdSkel.BindingAPI.Apply(mesh.GetPrim())
    binding.CreateSkeletonRel().SetTargets([skeleton])
    binding.CreateGeomBindTransformAttr(pxr.Gf.Matrix4d(1.0))
    per_vertex = body.joints.shape[1]
    joints = pxr.Vt.IntArray.FromNumpy(body.joints.astype(np.int32).ravel())
    weights = pxr.Vt.FloatArray.FromNumpy(body.weights.astype(np.float32).ravel())
    binding.CreateJointIndicesPrimvar(constant=False, elementSize=per_vertex).Set(joints)
    binding.CreateJointWeightsPrimvar(constant=False, elementSize=per_vertex).Set(weights)


def _joint_paths(rest: RestRig) -> list[str]:
    pxr = _pxr()
    paths: list[str] = []
    for name, parent in zip(rest.names, rest.parents, strict=True):
        own = pxr.Tf.MakeValidIdentifier(name)
        paths.append(f"{paths[parent]}/{own}" if parent >= 0 else own)
    return paths


def _matrices(rotation: np.ndarray, position: np.ndarray) -> Any:
    """USD's matrices act on rows, so they are the transposes of ours."""
    pxr = _pxr()
    matrices = np.tile(np.eye(4), (len(position), 1, 1))
    matrices[:, :3, :3] = np.swapaxes(rotation, 1, 2)
    matrices[:, 3, :3] = position
    return pxr.Vt.Matrix4dArray.FromNumpy(matrices)


FORMAT = TakeFormat(
    suffix=".usdc",
    write=write_usd,
    per_person=False,
    units=METRE_AND_CM,
    has_rig=True,
    check_needs=_pxr,
)
