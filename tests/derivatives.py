"""The one finite-difference harness: every residual's and cost's derivative meets it."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np


def differences(
    function: Callable[[np.ndarray], np.ndarray | float], size: int, step: float = 1e-6
) -> np.ndarray:
    """(..., size): central differences at zero of `function(delta)`, delta (size,)."""
    columns = []
    for entry in range(size):
        delta = np.zeros(size)
        delta[entry] = step
        columns.append((np.asarray(function(delta)) - np.asarray(function(-delta))) / (2 * step))
    return np.stack(columns, axis=-1)


def assert_jacobian(
    function: Callable[[np.ndarray], np.ndarray | float],
    jacobian: np.ndarray,
    *,
    rtol: float = 1e-5,
    atol: float = 1e-6,
) -> None:
    """`jacobian` (..., n) is the derivative at zero of `function(delta)`, delta (n,)."""
    numeric = differences(function, np.shape(jacobian)[-1])
    np.testing.assert_allclose(jacobian, numeric, rtol=rtol, atol=atol)
