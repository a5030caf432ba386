"""Dense Cholesky factorisation and solves for the 66 x 66 normal equations.

The factor is the L of H = Lᵀ L, found from the last row up: then every inner loop runs along rows
of the lower triangle and counts from 0, which compiles to vector instructions. L keeps 1 / L_ii on
its diagonal: every later use divides by it.
"""

from __future__ import annotations

import math

from fusecap.kernels.jit import kernel


@kernel("b1(f8[:, ::1], f8[::1], f8[:, ::1])")
def factor(matrix, diagonal_addition, lower_out):
    """L with Lᵀ L = matrix + diag(addition), from the lower triangle; False if not positive.

    Four rows are finished, then subtracted from all rows above in one pass.
    """
    size = matrix.shape[0]
    for i in range(size):
        for j in range(i + 1):
            lower_out[i, j] = matrix[i, j]
        lower_out[i, i] += diagonal_addition[i]
    for end in range(size, 0, -4):
        start = max(end - 4, 0)
        for i in range(end - 1, start - 1, -1):
            for k in range(i + 1, end):
                share = lower_out[k, i]
                for j in range(i + 1):
                    lower_out[i, j] -= share * lower_out[k, j]
            if not lower_out[i, i] > 0.0:
                return False
            reciprocal = 1.0 / math.sqrt(lower_out[i, i])
            for j in range(i):
                lower_out[i, j] *= reciprocal
            lower_out[i, i] = reciprocal
        for i in range(start):
            s0, s1 = lower_out[start, i], lower_out[start + 1, i]
            s2, s3 = lower_out[start + 2, i], lower_out[start + 3, i]
            for j in range(i + 1):
                lower_out[i, j] -= (
                    s0 * lower_out[start, j]
                    + s1 * lower_out[start + 1, j]
                    + s2 * lower_out[start + 2, j]
                    + s3 * lower_out[start + 3, j]
                )
    return True


@kernel("void(f8[:, ::1], f8[::1], f8[::1])")
def solve_factored(lower, right, solution_out):
    """Solve Lᵀ L x = right."""
    size = right.size
    for i in range(size):
        solution_out[i] = right[i]
    for i in range(size - 1, -1, -1):
        value = solution_out[i] * lower[i, i]
        solution_out[i] = value
        for j in range(i):
            solution_out[j] -= lower[i, j] * value
    for i in range(size):
        total = solution_out[i]
        for j in range(i):
            total -= lower[i, j] * solution_out[j]
        solution_out[i] = total * lower[i, i]
