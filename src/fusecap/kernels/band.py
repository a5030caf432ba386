"""Block Cholesky of a window's normal equations, in place: instants couple with the two before.

Blocks (P, P) with P a multiple of three, so all inner loops run on three rows by three: nine sums
along contiguous rows, which compilers turn into vector instructions. No library's threads: where
detectors keep all cores busy those wait for one another for milliseconds.
"""

from __future__ import annotations

import math

from numba import boolean, void
from numba import float64 as f8
from numba import int64 as i8

from fusecap.kernels.jit import kernel

_MATRIX = f8[:, ::1]


@kernel(void(_MATRIX, _MATRIX, i8, i8, i8, f8[:, ::1]))
def _products(a, b, i, j, length, out):
    """Out (3, 3): rows i, i+1, i+2 of a times rows j, j+1, j+2 of b, over the first `length`."""
    s00 = s01 = s02 = s10 = s11 = s12 = s20 = s21 = s22 = 0.0
    a0, a1, a2 = a[i], a[i + 1], a[i + 2]
    b0, b1, b2 = b[j], b[j + 1], b[j + 2]
    for k in range(length):
        s00 += a0[k] * b0[k]
        s01 += a0[k] * b1[k]
        s02 += a0[k] * b2[k]
        s10 += a1[k] * b0[k]
        s11 += a1[k] * b1[k]
        s12 += a1[k] * b2[k]
        s20 += a2[k] * b0[k]
        s21 += a2[k] * b1[k]
        s22 += a2[k] * b2[k]
    out[0, 0], out[0, 1], out[0, 2] = s00, s01, s02
    out[1, 0], out[1, 1], out[1, 2] = s10, s11, s12
    out[2, 0], out[2, 1], out[2, 2] = s20, s21, s22


@kernel(boolean(_MATRIX, _MATRIX))
def factor(block, square):
    """L of a symmetric block's lower triangle, in its place; False where it is not positive."""
    size = block.shape[0]
    for i in range(0, size, 3):
        for j in range(0, i + 3, 3):
            _products(block, block, i, j, j, square)
            for a in range(3):
                for b in range(3 if j < i else a + 1):
                    value = block[i + a, j + b] - square[a, b]
                    for c in range(b):
                        value -= block[i + a, j + c] * block[j + b, j + c]
                    if j == i and a == b:
                        if not value > 0.0:
                            return False
                        block[i + a, i + a] = math.sqrt(value)
                    else:
                        block[i + a, j + b] = value / block[j + b, j + b]
    return True


@kernel(void(_MATRIX, _MATRIX, _MATRIX))
def divide(block, lower, square):
    """Block L^-T, in its place."""
    size = block.shape[0]
    for i in range(0, size, 3):
        for j in range(0, size, 3):
            _products(block, lower, i, j, j, square)
            for a in range(3):
                for b in range(3):
                    value = block[i + a, j + b] - square[a, b]
                    for c in range(b):
                        value -= block[i + a, j + c] * lower[j + b, j + c]
                    block[i + a, j + b] = value / lower[j + b, j + b]


@kernel(void(_MATRIX, _MATRIX, _MATRIX, boolean, _MATRIX))
def subtract(block, a, b, lower_only, square):
    """Block -= a bᵀ, where `lower_only` on and below the diagonal only."""
    size = block.shape[0]
    for i in range(0, size, 3):
        for j in range(0, i + 3 if lower_only else size, 3):
            _products(a, b, i, j, size, square)
            for m in range(3):
                for n in range(3):
                    block[i + m, j + n] -= square[m, n]


@kernel(boolean(f8[:, :, :, ::1], _MATRIX, i8, f8, f8, _MATRIX))
def eliminate(hessian, gradient, count, damping, ridge, square):
    """Eliminate the first `count` instants of H (N, 3, P, P), g (N, P); False if H is not positive.

    Their blocks become L, their gradients L⁻¹ g, and what is left of the others is what the
    eliminated ones say of them. Their diagonal is raised by `damping` times itself and by `ridge`.
    """
    total, size = hessian.shape[0], hessian.shape[2]
    for t in range(count):
        for i in range(size):
            hessian[t, 0, i, i] += damping * max(hessian[t, 0, i, i], 1e-6) + ridge
    for t in range(count):
        own = hessian[t, 0]
        if not factor(own, square):
            return False
        for i in range(size):
            value = gradient[t, i]
            for k in range(i):
                value -= own[i, k] * gradient[t, k]
            gradient[t, i] = value / own[i, i]
        for k in range(1, min(3, total - t)):
            block = hessian[t + k, k]
            divide(block, own, square)
            for i in range(size):
                value = 0.0
                for j in range(size):
                    value += block[i, j] * gradient[t, j]
                gradient[t + k, i] -= value
            subtract(hessian[t + k, 0], block, block, True, square)
        if t + 2 < total:
            subtract(hessian[t + 2, 1], hessian[t + 2, 2], hessian[t + 1, 1], False, square)
    return True


@kernel(void(f8[:, :, :, ::1], _MATRIX, _MATRIX))
def step_of(hessian, gradient, step_out):
    """-H⁻¹ g (N, P) of a system whose instants have all been eliminated."""
    total, size = gradient.shape
    for t in range(total - 1, -1, -1):
        step = step_out[t]
        for i in range(size):
            step[i] = -gradient[t, i]
        for k in range(1, min(3, total - t)):
            block, later = hessian[t + k, k], step_out[t + k]
            for j in range(size):
                for i in range(size):
                    step[i] -= block[j, i] * later[j]
        own = hessian[t, 0]
        for i in range(size - 1, -1, -1):
            step[i] /= own[i, i]
            for k in range(i):
                step[k] -= own[i, k] * step[i]
