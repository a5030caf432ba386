"""What tunes a solve; every default in one place."""

from __future__ import annotations

from dataclasses import dataclass, field, fields, replace

from fusecap.errors import InputError, nearest

BETWEEN = ("motion", "increment", "specific_force", "rest")
"""Terms that couple instants."""
MOST_WEIGHT = 1e9


@dataclass(frozen=True, kw_only=True)
class Weights:
    """λ of each term; 0 switches a term off.

    `paper()` has the paper's values [1, sec. 3.2.6]; how these were chosen is in
    docs/cost_terms.md, "What measurements are worth". The paper's acceleration term, which it finds
    not to help, is off: at its printed weight and 60 Hz the frozen previous poses outweigh the
    keypoints.
    """

    position: float = 2e-3
    """Per px² of a 1920-pixel-wide image, times the keypoint's confidence, of somebody small in it;
    see `growth`. The paper's value is 1e-3."""
    growth: float = 2e-5
    """Per (px/m)², not a term: a keypoint's variance is 1 + growth ρ² times that of somebody small,
    where the image shows a metre as ρ pixels. With it a keypoint counts as the paper's where
    somebody is as large as in its studio (ρ = 220)."""
    orientation: float = 10.0
    """Per sin²(φ/2); the paper's value is 1. A sensor that is 6 deg off then costs what a pose one
    standard deviation from the prior's mean does: λ φ²/4 = 0.03 at φ = 0.11 rad."""
    acceleration: float = 0.0
    """Per (m/s²)²; the paper's value is 1e-3."""
    projection: float = 2.8
    """Per rad² outside the PCA subspace."""
    deviation: float = 0.03
    """Per squared standard deviation within it."""
    floor: float = 10.0
    """Per m² below the floor."""
    motion: float = 0.04
    """Between instants: of a change of velocity, per squared `PosePrior.acceleration`; one sigma is
    five times that of ordinary motion."""
    increment: float = 1100.0
    """Between instants: per rad² between a bone's turn and its sensor's; one sigma is 0.03 rad."""
    specific_force: float = 0.006
    """Between instants: per (m/s²)² between what a sensor would feel and felt; one sigma is 13
    m/s², for flesh and straps give."""
    rest: float = 6.0
    """Between instants: per (m/s)² of a foot that stands (where `floor` is on) or of a root that
    nothing places; one sigma is 0.4 m/s at an instant, for a foot that rolls does move."""

    def __post_init__(self) -> None:
        for term in fields(self):
            value = getattr(self, term.name)
            if not 0 <= value <= MOST_WEIGHT:
                raise InputError(
                    f"weight '{term.name}' is {value}; expected a number >= 0, at most "
                    f"{MOST_WEIGHT:g}"
                )

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
        """All terms as printed, and none between instants."""
        return cls(
            position=1e-3, growth=0.0, orientation=1.0, acceleration=1e-3, projection=0.7,
            deviation=0.06,
        ).alone()  # fmt: skip

    def alone(self) -> Weights:
        """Without the terms between instants: each is solved alone."""
        return replace(self, **dict.fromkeys(BETWEEN, 0.0))

    @property
    def between_instants(self) -> bool:
        """Whether any term couples instants: else each is solved alone."""
        return any(getattr(self, name) > 0.0 for name in BETWEEN)


@dataclass(frozen=True, kw_only=True)
class SolverOptions:
    """Weights, stopping rule and floor of the pose solver."""

    weights: Weights = field(default_factory=Weights)
    max_iterations: int = 30
    function_tolerance: float = 1e-4
    """Stop when a step lowers the cost, or promises to, by less than this share of it."""
    initial_damping: float = 1e-2
    window: int = 8
    """Instants that a live pose is solved together with, itself among them; 1: each alone."""
    seeding: bool = False
    """Poses for a take to go on from: without error bars, and together only where few cameras see
    somebody."""
    ahead: int = 0
    """Instants that a pose may be ahead of pictures, by sensors and as the motion goes on."""
    floor_radius_m: float = 0.05
    """Distance kept between the floor and the ankle and toe joints [1, eq. 16]."""

    def __post_init__(self) -> None:
        if not 1 <= self.max_iterations <= 10_000:
            raise InputError(f"max_iterations is {self.max_iterations}; expected 1-10000")
        if not (self.window == 1 or 3 <= self.window <= 1000):
            raise InputError(f"window is {self.window}; expected 3-1000 instants, or 1")
        if not 0 < self.function_tolerance < 1:
            raise InputError(f"function_tolerance is {self.function_tolerance}; expected 0-1")
        if not 0 < self.initial_damping <= MOST_WEIGHT:
            raise InputError(f"initial_damping is {self.initial_damping}; expected more than 0")
        if not 0 <= self.floor_radius_m <= 1:
            raise InputError(f"floor_radius_m is {self.floor_radius_m}; expected 0-1 m")

    @property
    def together(self) -> bool:
        """Whether instants are solved together."""
        return self.window > 1 and self.weights.between_instants
