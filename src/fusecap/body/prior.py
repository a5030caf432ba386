"""The prior: which poses people take, as a mean, a basis and its deviations, and how they move.

With x the angle-axis vectors of every bone but the root, the solver adds two terms [1, eq. 14-15]:

    E_PP: ‖(x − μ) − M Mᵀ (x − μ)‖²      off the subspace of seen poses
    E_PD: ‖diag(σ)⁻¹ Mᵀ (x − μ)‖²        far from the mean within it

[1] Malleson, Collomosse, Hilton, IJCV 128 (2020).
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from contextlib import nullcontext
from dataclasses import dataclass
from functools import cached_property
from importlib import resources
from pathlib import Path

import numpy as np
from jaxtyping import Float

from fusecap.body.skeleton import Skeleton, skeleton_named
from fusecap.errors import InputError, MotionError
from fusecap.inputs import PRIOR, read_npz

_ARRAYS = ("mean", "basis", "sigma", "acceleration")
_ORTHONORMAL_TOLERANCE = 1e-5
_MOST = 1e6
"""Of any number."""


@dataclass(frozen=True, kw_only=True)
class PosePrior:
    """A prior for one skeleton; d = 3 (B - 1) in the order of `theta[6:]`, r components."""

    skeleton_name: str
    mean: Float[np.ndarray, " d"]
    """μ [rad]."""
    basis: Float[np.ndarray, "d r"]
    """M, orthonormal columns."""
    sigma: Float[np.ndarray, " r"]
    """Standard deviations along the columns of `basis` [rad]."""
    acceleration: Float[np.ndarray, " n"]
    """(1 + B,) root mean square accelerations in ordinary motion: of the root's place [m/s²], then
    of every joint [rad/s²]."""
    recipe: Mapping[str, object]
    """How it was trained, for JSON."""

    def __post_init__(self) -> None:
        size = 3 * (skeleton_named(self.skeleton_name).bone_count - 1)
        rank = len(self.sigma)
        shapes = (self.mean.shape, self.basis.shape, self.sigma.shape)
        if shapes != ((size,), (size, rank), (rank,)) or not 1 <= rank <= size:
            raise MotionError(
                f"pose prior of '{self.skeleton_name}': mean, basis and sigma have shapes {shapes};"
                f" expected ({size},), ({size}, r), (r,)"
            )
        if not all((np.abs(getattr(self, name)) <= _MOST).all() for name in _ARRAYS):
            raise MotionError(f"pose prior of '{self.skeleton_name}': a value is not a number")
        if self.acceleration.shape != (2 + size // 3,) or np.any(self.acceleration <= 0):
            raise MotionError(
                f"pose prior of '{self.skeleton_name}': acceleration has shape "
                f"{self.acceleration.shape}; expected {2 + size // 3} positive numbers"
            )
        if np.any(self.sigma <= 0):
            raise MotionError(f"pose prior of '{self.skeleton_name}': a deviation is not positive")
        error = np.abs(self.basis.T @ self.basis - np.eye(rank)).max()
        if error > _ORTHONORMAL_TOLERANCE:
            raise MotionError(
                f"pose prior of '{self.skeleton_name}': the basis is {error:.1e} from orthonormal"
            )

    @cached_property
    def projector(self) -> Float[np.ndarray, "d d"]:
        """I − M Mᵀ, what is off the subspace [1, eq. 14]."""
        return np.ascontiguousarray(np.eye(len(self.mean)) - self.basis @ self.basis.T)

    @cached_property
    def precision(self) -> Float[np.ndarray, "d d"]:
        """M diag(1/σ²) Mᵀ, the form of the squared deviation [1, eq. 15]."""
        return np.ascontiguousarray((self.basis / self.sigma**2) @ self.basis.T)


def load_prior(skeleton: Skeleton, path: Path | None = None) -> PosePrior:
    """The prior in `path`, or the one that ships for `skeleton`.

    Raises `InputError` for a file that is missing or not a prior, `MotionError` for one that does
    not fit the skeleton.
    """
    shipped = resources.files("fusecap.data") / f"prior_{skeleton.name}.npz"
    with nullcontext(path) if path is not None else resources.as_file(shipped) as source:
        if not source.exists():
            raise InputError(
                f"no pose prior at {source}; train one with: fusecap calibrate prior MOTION_FOLDER"
            )
        stored = read_npz(source, PRIOR, ("recipe", *_ARRAYS))
    try:
        recipe = json.loads(str(stored["recipe"]))
        arrays = {name: stored[name].astype(np.float64) for name in _ARRAYS}
    except (KeyError, ValueError, RecursionError) as error:
        raise InputError(f"{source} is not a pose prior: {error}") from None
    if not isinstance(recipe, dict) or recipe.get("skeleton") != skeleton.name:
        found = recipe.get("skeleton") if isinstance(recipe, dict) else None
        raise MotionError(f"{source} is a prior for skeleton '{found}', not '{skeleton.name}'")
    if arrays["basis"].ndim != 2 or arrays["mean"].ndim != 1 or arrays["sigma"].ndim != 1:
        raise MotionError(f"{source}: expected mean (d,), basis (d, r), sigma (r,)")
    # float32 on disk leaves the basis orthonormal to 1e-7; restore it to the last bit that counts
    arrays["basis"] = _orthonormalised(arrays["basis"])
    return PosePrior(skeleton_name=skeleton.name, recipe=recipe, **arrays)


def save_prior(prior: PosePrior, path: Path) -> None:
    """Write `prior` as float32 arrays and its recipe as JSON."""
    recipe = dict(prior.recipe) | {"skeleton": prior.skeleton_name}
    np.savez_compressed(
        path,
        mean=prior.mean.astype(np.float32),
        basis=prior.basis.astype(np.float32),
        sigma=prior.sigma.astype(np.float32),
        acceleration=prior.acceleration.astype(np.float32),
        recipe=np.array(json.dumps(recipe)),
    )


def _orthonormalised(basis: Float[np.ndarray, "d r"]) -> Float[np.ndarray, "d r"]:
    """One Newton step to the nearest orthonormal basis; a basis far from one stays far."""
    return basis @ (1.5 * np.eye(basis.shape[1]) - 0.5 * basis.T @ basis)
