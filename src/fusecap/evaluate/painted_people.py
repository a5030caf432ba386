"""Pictures of simulated people in drawn clothes, for what looks at pictures: clothes, not bodies.

Limbs are painted as bands between projected landmarks, far people first, before a room that stands
still; shade differs from side to side and goes with the person's turn, every camera has a white
balance and an exposure of its own, pixels are noisy. Simulated, and simpler than life: no folds, no
patterns, no cast shadows.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from fusecap.body.landmarks import LandmarkSet
from fusecap.geometry.camera import Camera, Rig

Colour = tuple[float, float, float]
"""BGR, 0-255."""

_SKIN: Colour = (120.0, 150.0, 205.0)
UNLIKE = 40.0
"""CIELAB: blue and violet, a middle grey and white."""
_NOISE = 6.0
_NOISE_SPARE = 1 << 16
"""One draw serves all pictures, from another place on."""
_SHADE = 0.2
"""Share of light that a turn away from the lamp costs or gives."""
_JOINTS = ("shoulder", "elbow", "wrist", "hip", "knee", "ankle")
_RING = ("left_shoulder", "right_shoulder", "right_hip", "left_hip")
_LIMBS = (
    ("shoulder", "elbow", "top", 0.10),
    ("elbow", "wrist", "skin", 0.08),
    ("hip", "knee", "bottom", 0.15),
    ("knee", "ankle", "bottom", 0.11),
)
"""Of both sides: from, to, what covers it, width [m]."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Clothes:
    """What somebody wears."""

    top: Colour
    bottom: Colour

    def coloured(self, name: str) -> Colour:
        """Of "top", "bottom" or "skin"."""
        return {"top": self.top, "bottom": self.bottom, "skin": _SKIN}[name]


def drawn_clothes(rng: np.random.Generator) -> Clothes:
    """Of any hue and lightness; half of the tops and most trousers have little colour."""

    def cloth(coloured: float) -> Colour:
        strong = rng.random() < coloured
        saturation = rng.uniform(130, 230) if strong else rng.uniform(0, 35)
        hsv = np.array([rng.uniform(0, 180), saturation, rng.uniform(35, 235)], np.uint8)
        blue, green, red = cv2.cvtColor(hsv[None, None], cv2.COLOR_HSV2BGR)[0, 0].tolist()
        return float(blue), float(green), float(red)

    return Clothes(top=cloth(0.5), bottom=cloth(0.35))


def drawn_wardrobe(rng: np.random.Generator, people: int) -> list[Clothes]:
    """Clothes that differ, of every two the tops or the trousers by `UNLIKE` in CIELAB."""
    worn: list[Clothes] = []
    while len(worn) < people:
        clothes = drawn_clothes(rng)
        if all(_unlike(clothes, other) >= UNLIKE for other in worn):
            worn.append(clothes)
    return worn


def _unlike(a: Clothes, b: Clothes) -> float:
    colours = np.array([[a.top, a.bottom], [b.top, b.bottom]], np.float32) / 255.0
    lab = cv2.cvtColor(colours, cv2.COLOR_BGR2LAB)
    return float(np.linalg.norm(lab[0] - lab[1], axis=1).max())


class Painter:
    """The pictures that cameras take of people; owns the draw of rooms and lights."""

    def __init__(
        self, rig: Rig, landmarks: LandmarkSet, clothes: Sequence[Clothes], *, seed: int
    ) -> None:
        names = landmarks.landmark_names
        self._rows = {
            name: names.index(name)
            for side in ("left", "right")
            for name in (f"{side}_{joint}" for joint in _JOINTS)
        }
        self._clothes = tuple(clothes)
        self._rng = np.random.default_rng(seed)
        self._balance = self._rng.uniform(0.93, 1.07, (len(rig), 3))
        self._exposure = self._rng.uniform(0.8, 1.25, len(rig))
        self._rooms = [self._room(camera) for camera in rig.cameras]
        largest = max((np.prod(camera.size_px) for camera in rig.cameras), default=0)
        self._noise = self._rng.normal(0.0, _NOISE, 3 * int(largest) + _NOISE_SPARE)
        self._noise = self._noise.astype(np.float32)

    def picture(
        self, index: int, camera: Camera, people: Float[np.ndarray, "n k 3"], light: float = 1.0
    ) -> UInt8[np.ndarray, "h w 3"]:
        """What camera `index` sees of landmarks [m], one row per person's clothes; NaN: not there.

        `light` is the room's, 1 as it mostly is.
        """
        image = self._rooms[index].copy()
        here = [n for n in range(len(people)) if np.isfinite(people[n]).all()]
        depth_m = people @ camera.rotation[2] + camera.translation[2]
        far = {n: float(depth_m[n].mean()) for n in here}
        for n in sorted(here, key=lambda n: -far[n]):
            if far[n] > 0.3:
                self._paint(image, camera, people[n], self._clothes[n], far[n])
        gain = light * self._exposure[index] * self._balance[index]
        image *= gain.astype(np.float32)
        start = int(self._rng.integers(self._noise.size - image.size + 1))
        image += self._noise[start : start + image.size].reshape(image.shape)
        return np.clip(image, 0, 255).astype(np.uint8)

    def _room(self, camera: Camera) -> np.ndarray:
        """Walls, floor and things, still."""
        width, height = camera.size_px
        coarse = self._rng.uniform(60, 190, (6, 9, 1)) + self._rng.uniform(-25, 25, (6, 9, 3))
        return cv2.resize(coarse.astype(np.float32), (width, height))

    def _paint(
        self, image: np.ndarray, camera: Camera, body: np.ndarray, clothes: Clothes, depth_m: float
    ) -> None:
        pixels = camera.project(body)
        px_per_m = float(camera.matrix[0, 0]) / depth_m
        at = {name: pixels[row] for name, row in self._rows.items()}
        across = body[self._rows["left_shoulder"]] - body[self._rows["right_shoulder"]]
        turned = float(np.cross(across, [0.0, 1.0, 0.0]) @ camera.rotation[0])
        shade = 1.0 + _SHADE * np.clip(turned / 0.4, -1.0, 1.0)

        def band(a: str, b: str, colour: Colour, width_m: float, shade: float) -> None:
            ends = np.round([at[a], at[b]]).astype(int)
            painted = tuple(shade * value for value in colour)
            thick = max(int(width_m * px_per_m), 1)
            cv2.line(image, ends[0].tolist(), ends[1].tolist(), painted, thick, cv2.LINE_AA)

        for side, light in (("left", 1.05 * shade), ("right", 0.95 * shade)):
            for a, b, part, width_m in _LIMBS[1:]:
                band(f"{side}_{a}", f"{side}_{b}", clothes.coloured(part), width_m, light)
        ring = np.array([at[name] for name in _RING])
        colour = tuple(shade * value for value in clothes.top)
        cv2.fillPoly(image, [np.round(ring).astype(np.int32)], colour)
        neck, hips = ring[:2].mean(axis=0), ring[2:].mean(axis=0)
        ends = np.round([neck, hips]).astype(int).tolist()
        cv2.line(image, ends[0], ends[1], colour, max(int(0.25 * px_per_m), 1), cv2.LINE_AA)
        for side in ("left", "right"):
            a, b, part, width_m = _LIMBS[0]
            band(f"{side}_{a}", f"{side}_{b}", clothes.coloured(part), width_m, shade)
        head = np.round(neck + 0.25 * (neck - hips)).astype(int).tolist()
        cv2.circle(image, head, max(int(0.11 * px_per_m), 1), _SKIN, -1, cv2.LINE_AA)
