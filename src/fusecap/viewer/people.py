"""The people of a page.

All sticks of all people are instances of one cylinder, all balls of one sphere, so a frame costs
the browser two meshes however many people there are.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import viser
from jaxtyping import Float, Int, UInt8

from fusecap.body.skeleton import Skeleton
from fusecap.viewer.figure import Figure, Parts, Pose
from fusecap.viewer.palette import Rgb

_SIDES = 18
"""Of cylinders and spheres."""


class People:
    """Figures with their names above them; one owner at a time."""

    def __init__(
        self, scene: viser.SceneApi, skeleton: Skeleton, colours: Mapping[str, Rgb]
    ) -> None:
        """Everyone who may be shown, by name; a name may hold anything."""
        self._figure = Figure(skeleton)
        self._colours = dict(colours)
        count = len(colours)
        self._sticks = _instances(
            scene, "/people/sticks", _cylinder(), count * self._figure.stick_count
        )
        self._balls = _instances(scene, "/people/balls", _sphere(), count * self._figure.ball_count)
        self._names = {
            name: scene.add_label(
                f"/people/name_{row}",
                name,
                visible=False,
                anchor="bottom-center",
                font_screen_scale=1.25,
            )
            for row, name in enumerate(colours)
        }

    def show(self, people: Mapping[str, Pose | None]) -> None:
        """These people, and none of the others."""
        figure = self._figure
        sticks, balls = [], []
        for name, colour in self._colours.items():
            pose = people.get(name)
            self._names[name].visible = pose is not None
            if pose is None:
                sticks.append(Parts.hidden(figure.stick_count))
                balls.append(Parts.hidden(figure.ball_count))
            else:
                self._names[name].position = figure.name_place_m(pose)
                sticks.append(figure.sticks(pose, colour))
                balls.append(figure.balls(pose, colour))
        _place(self._sticks, sticks)
        _place(self._balls, balls)

    def remove(self) -> None:
        """Takes them off the page."""
        for handle in (self._sticks, self._balls, *self._names.values()):
            handle.remove()


def _instances(
    scene: viser.SceneApi,
    name: str,
    mesh: tuple[Float[np.ndarray, "v 3"], Int[np.ndarray, "f 3"]],
    count: int,
) -> viser.BatchedMeshHandle:
    vertices, faces = mesh
    parts = Parts.hidden(count)
    return scene.add_batched_meshes_simple(
        name,
        vertices,
        faces,
        parts.wxyz,
        parts.position_m,
        batched_scales=parts.scale_m,
        batched_colors=parts.rgb,
        lod="off",
    )


def _place(handle: viser.BatchedMeshHandle, everyone: list[Parts]) -> None:
    if everyone:
        handle.batched_positions = np.concatenate([parts.position_m for parts in everyone])
        handle.batched_wxyzs = np.concatenate([parts.wxyz for parts in everyone])
        handle.batched_scales = np.concatenate([parts.scale_m for parts in everyone])
        handle.batched_colors = _linear(np.concatenate([parts.rgb for parts in everyone]))


def _linear(rgb: UInt8[np.ndarray, "n 3"]) -> UInt8[np.ndarray, "n 3"]:
    """Colours of instances reach viser's renderer as linear light, not as a screen's values."""
    return np.round(255 * (rgb / 255) ** 2.2).astype(np.uint8)


def _cylinder() -> tuple[Float[np.ndarray, "v 3"], Int[np.ndarray, "f 3"]]:
    """Of radius 1 from y = 0 to 1, open at both ends, which balls close."""
    angle = np.linspace(0, 2 * np.pi, _SIDES, endpoint=False)
    ring = np.stack([np.sin(angle), np.zeros(_SIDES), np.cos(angle)], axis=1)
    return np.concatenate([ring, ring + [0.0, 1.0, 0.0]]), _band(0, _SIDES)


def _sphere() -> tuple[Float[np.ndarray, "v 3"], Int[np.ndarray, "f 3"]]:
    """Of radius 1, in rings from the south pole to the north pole."""
    rings = _SIDES // 2 + 1
    height = np.linspace(-np.pi / 2, np.pi / 2, rings)
    angle = np.linspace(0, 2 * np.pi, _SIDES, endpoint=False)
    up, around = np.meshgrid(height, angle, indexing="ij")
    points = [np.cos(up) * np.sin(around), np.sin(up), np.cos(up) * np.cos(around)]
    bands = [_band(ring * _SIDES, (ring + 1) * _SIDES) for ring in range(rings - 1)]
    return np.stack(points, axis=-1).reshape(-1, 3), np.concatenate(bands)


def _band(low: int, high: int) -> Int[np.ndarray, "f 3"]:
    """Triangles between two rings of vertices, seen from outside."""
    here = np.arange(_SIDES)
    after = (here + 1) % _SIDES
    return np.concatenate(
        [
            np.stack([low + here, low + after, high + after], axis=1),
            np.stack([low + here, high + after, high + here], axis=1),
        ]
    )
