"""PCA prior terms E_PP and E_PD [1, eq. 14-15]: poses as people take them.

Both are a Cauchy loss on one squared norm x̃ᵀ A x̃ of x̃ = theta[6:] - μ: A = I - M Mᵀ (a
projector, so ‖A x̃‖² = x̃ᵀ A x̃) for the projection term, A = M diag(σ)⁻² Mᵀ for the deviation term.
"""

from __future__ import annotations

import math

from fusecap.kernels.jit import kernel


@kernel("f8(f8, f8[::1], f8[:, ::1], f8[::1], f8[:, ::1], f8[::1])")
def add_prior(
    # Term in:
    weight,
    mean,
    matrix,
    # Body in:
    theta,
    # Normal equations out:
    hessian_out,
    gradient_out,
):
    """½ log(1 + λ x̃ᵀ A x̃); adds to the lower triangle of H and to g."""
    size = mean.size
    norm_squared = 0.0
    for i in range(size):
        total = 0.0
        for j in range(size):
            total += matrix[i, j] * (theta[6 + j] - mean[j])
        norm_squared += total * (theta[6 + i] - mean[i])
    s = weight * norm_squared
    weighted = weight / (1.0 + s)
    for i in range(size):
        total = 0.0
        for j in range(size):
            total += matrix[i, j] * (theta[6 + j] - mean[j])
        gradient_out[6 + i] += weighted * total
        for j in range(i + 1):
            hessian_out[6 + i, 6 + j] += weighted * matrix[i, j]
    return 0.5 * math.log1p(s)
