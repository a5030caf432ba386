"""Dense Cholesky factorisation and solves for the 66 x 66 normal equations."""

from __future__ import annotations

import math

from fusecap.kernels.jit import kernel


@kernel("b1(f8[:, ::1], f8[::1], f8[:, ::1])")
def factor(matrix, diagonal_addition, lower_out):
    """L with L Lᵀ = matrix + diag(addition), from the lower triangle; False if not positive."""
    size = matrix.shape[0]
    for i in range(size):
        row = lower_out[i]
        for j in range(i):
            other = lower_out[j]
            total = matrix[i, j]
            for k in range(j):
                total -= row[k] * other[k]
            row[j] = total * other[j]
        total = matrix[i, i] + diagonal_addition[i]
        for k in range(i):
            total -= row[k] * row[k]
        if not total > 0.0:
            return False
        # The diagonal keeps 1 / L_ii: every later use divides by it.
        row[i] = 1.0 / math.sqrt(total)
    return True


@kernel("void(f8[:, ::1], f8[::1], f8[::1])")
def solve_factored(lower, right, solution_out):
    """Solve L Lᵀ x = right; `lower` holds reciprocals on its diagonal (see `factor`)."""
    size = right.size
    for i in range(size):
        total = right[i]
        for k in range(i):
            total -= lower[i, k] * solution_out[k]
        solution_out[i] = total * lower[i, i]
    for i in range(size - 1, -1, -1):
        value = solution_out[i] * lower[i, i]
        solution_out[i] = value
        for k in range(i):
            solution_out[k] -= lower[i, k] * value


@kernel("void(f8[:, ::1], f8[:, ::1], f8[::1])")
def inverse_diagonal(lower, inverse_scratch, diagonal_out):
    """Diagonal of (L Lᵀ)⁻¹, by inverting L row by row."""
    size = lower.shape[0]
    for i in range(size):
        diagonal_out[i] = 0.0
    for i in range(size):
        row = inverse_scratch[i]
        for j in range(i):
            row[j] = 0.0
        for k in range(i):
            factor_ik = lower[i, k]
            above = inverse_scratch[k]
            for j in range(k + 1):
                row[j] -= factor_ik * above[j]
        reciprocal = lower[i, i]
        for j in range(i):
            row[j] *= reciprocal
        row[i] = reciprocal
        for j in range(i + 1):
            diagonal_out[j] += row[j] * row[j]
