"""What tunes a solve; every default in one place."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, fields

from fusecap.errors import InputError, nearest

SMOOTH = {"motion": 1.0, "increment": 1100.0, "specific_force": 0.01}
"""Weights that make a motion of poses: one sigma is 0.03 rad of a sensor's turn, and 10 m/s² of its
specific force, as flesh and straps give."""
ROOT_NOISE_M_S2 = 30.0
JOINT_NOISE_RAD_S2 = 120.0
"""How fast velocities of the root and of joints change in ordinary motion: one sigma."""


@dataclass(frozen=True, kw_only=True)
class Weights:
    """λ of each term; 0 switches a term off.

    The values are the paper's [1, sec. 3.2.6] with two exceptions; `paper()` has them all. The
    acceleration term, which the paper finds not to help, is off: at its printed weight and 60 Hz
    the frozen previous poses outweigh the keypoints. The orientation term is heavier, because at 1
    the prior outweighs the sensors; how that was chosen is in docs/accuracy.md.
    """

    position: float = 1e-3
    """Per px² of a 1920-pixel-wide image, times the keypoint's confidence."""
    orientation: float = 20.0
    """Per sin²(φ/2); the paper's value is 1. A sensor that is 6 deg off then costs what a pose one
    standard deviation from the prior's mean does: λ φ²/4 = 0.06 at φ = 0.11 rad."""
    acceleration: float = 0.0
    """Per (m/s²)²; the paper's value is 1e-3."""
    projection: float = 0.7
    """Per rad² outside the PCA subspace."""
    deviation: float = 0.06
    """Per squared standard deviation within it."""
    floor: float = 10.0
    """Per m² below the floor."""
    motion: float = 0.0
    """Between instants: of a change of velocity, per squared process noise (`ROOT_NOISE_M_S2`,
    `JOINT_NOISE_RAD_S2`)."""
    increment: float = 0.0
    """Between instants: per rad² between a bone's turn and its sensor's."""
    specific_force: float = 0.0
    """Between instants: per (m/s²)² between what a sensor would feel and felt."""

    def __post_init__(self) -> None:
        for term in fields(self):
            value = getattr(self, term.name)
            if not (math.isfinite(value) and value >= 0):
                raise InputError(f"weight '{term.name}' is {value}; expected a number >= 0")

    @classmethod
    def named(cls, **weights: float) -> Weights:
        """Defaults with some terms set by name; an unknown name is an `InputError`."""
        known = [term.name for term in fields(cls)]
        for name in weights:
            if name not in known:
                raise InputError(f"no cost term '{name}'{nearest(name, known)}")
        return cls(**weights)

    @classmethod
    def paper(cls) -> Weights:
        """All terms as printed."""
        return cls(orientation=1.0, acceleration=1e-3)

    @property
    def between_instants(self) -> bool:
        """Whether any term couples instants: else each is solved alone."""
        return max(self.motion, self.increment, self.specific_force) > 0.0


@dataclass(frozen=True, kw_only=True)
class SolverOptions:
    """Weights, stopping rule and floor of the pose solver."""

    weights: Weights = field(default_factory=Weights)
    max_iterations: int = 30
    function_tolerance: float = 1e-4
    """Stop when a step lowers the cost, or promises to, by less than this share of it."""
    initial_damping: float = 1e-2
    floor_radius_m: float = 0.05
    """Distance kept between the floor and the ankle and toe joints [1, eq. 16]."""
    quality: bool = True
    """Compute the per-bone quality after each solve (about a quarter of a solve's time)."""

    def __post_init__(self) -> None:
        if self.max_iterations < 1:
            raise InputError(f"max_iterations is {self.max_iterations}; expected at least 1")
        if not 0 < self.function_tolerance < 1:
            raise InputError(f"function_tolerance is {self.function_tolerance}; expected 0-1")
