"""How sure a solve is: covariances of poses, and what they come to for every bone.

With L from `band.eliminate`, B_k = the eliminated block (t + k, t) and Y = L⁻ᵀ, covariances follow
from the newest instant backwards (Takahashi's recursion by blocks):

    Σ_t,t+k = -Y (B₁ᵀ Σ_t+1,t+k + B₂ᵀ Σ_t+2,t+k)
    Σ_tt    =  Y Yᵀ - Y (Σ_t,t+1 B₁ + Σ_t,t+2 B₂)ᵀ
"""

from __future__ import annotations

from numba import float64 as f8
from numba import int64 as i8
from numba import void

from fusecap.kernels.band import divide, subtract
from fusecap.kernels.groups import BODY, POSED
from fusecap.kernels.jit import kernel

_MATRIX, _CUBE = f8[:, ::1], f8[:, :, ::1]
Y, T1, T2, N1, N2, C1, C2, Q, S11, S12, S21, S22 = range(12)
ROOM = 12
"""Matrices (P, P) that `covariance` works with."""


@kernel(void(_MATRIX, _MATRIX, f8))
def _transposed(a, out, sign):
    for i in range(a.shape[0]):
        for j in range(a.shape[1]):
            out[j, i] = sign * a[i, j]


@kernel(void(_MATRIX, _MATRIX, _CUBE, _MATRIX))
def newest(lower, covariance_out, room, square):
    """Σ (P, P) = (L Lᵀ)⁻¹ of the last instant; room (12, P, P), square (3, 3)."""
    size = lower.shape[0]
    room[Y] = 0.0
    room[Q] = 0.0
    for i in range(size):
        room[Y, i, i] = 1.0
        room[Q, i, i] = -1.0
    divide(room[Y], lower, square)
    divide(room[Q], lower, square)
    covariance_out[:] = 0.0
    subtract(covariance_out, room[Y], room[Q], False, square)


@kernel(void(f8[:, :, :, ::1], i8, _CUBE, _MATRIX, _MATRIX))
def step_back(hessian, t, room, covariance_out, square):
    """Σ_tt of one instant, from the last to the first in turn; room (12, P, P) carries the others'.

    H (N, 3, P, P) as `band.eliminate` leaves it.
    """
    total, size = hessian.shape[0], hessian.shape[2]
    if t == total - 1:
        newest(hessian[t, 0], covariance_out, room, square)
        room[S11] = covariance_out
        room[S12] = 0.0
        room[S21] = 0.0
        room[S22] = 0.0
        return
    # T_k = -B_kᵀ, N_k = (B₁ᵀ Σ_1k + B₂ᵀ Σ_2k)ᵀ, C_k = Σ_t,t+k, Q = -(Y - C₁ B₁ - C₂ B₂)
    _transposed(hessian[t + 1, 1], room[T1], -1.0)
    room[T2] = 0.0
    if t + 2 < total:
        _transposed(hessian[t + 2, 2], room[T2], -1.0)
    room[N1] = 0.0
    room[N2] = 0.0
    room[C1] = 0.0
    room[C2] = 0.0
    room[Y] = 0.0
    for i in range(size):
        room[Y, i, i] = 1.0
    divide(room[Y], hessian[t, 0], square)
    subtract(room[N1], room[S11], room[T1], False, square)
    subtract(room[N1], room[S12], room[T2], False, square)
    subtract(room[N2], room[S21], room[T1], False, square)
    subtract(room[N2], room[S22], room[T2], False, square)
    subtract(room[C1], room[Y], room[N1], False, square)
    subtract(room[C2], room[Y], room[N2], False, square)
    for i in range(size):
        for j in range(size):
            room[Q, i, j] = -room[Y, i, j]
    subtract(room[Q], room[C1], room[T1], False, square)
    subtract(room[Q], room[C2], room[T2], False, square)
    covariance_out[:] = 0.0
    subtract(covariance_out, room[Q], room[Y], False, square)
    # What rounding makes unequal would grow threefold with every step.
    for i in range(size):
        for j in range(i):
            mean = 0.5 * (covariance_out[i, j] + covariance_out[j, i])
            covariance_out[i, j] = mean
            covariance_out[j, i] = mean
    room[S22] = room[S11]
    room[S11] = covariance_out
    room[S12] = room[C1]
    _transposed(room[C1], room[S21], 1.0)


@kernel(void(BODY, POSED, _MATRIX, _MATRIX, f8[::1], f8[::1]))
def spread(body, posed, covariance, chain, turn_out, place_out):
    """Traces [rad², m²] of what a covariance (P, P) says of every bone's turn and joint.

    chain (6, P) is scratch.
    """
    parents, position, twist = body.parents, posed.position, posed.twist
    for bone in range(parents.size):
        # Rows of the Jacobian: the joint's place, then the bone's turn; only columns that move it.
        above = bone
        while above >= 0:
            at = 3 + 3 * above
            ox = position[bone, 0] - position[above, 0]
            oy = position[bone, 1] - position[above, 1]
            oz = position[bone, 2] - position[above, 2]
            for j in range(3):
                w0, w1, w2 = twist[above, 0, j], twist[above, 1, j], twist[above, 2, j]
                chain[0, at + j] = w1 * oz - w2 * oy
                chain[1, at + j] = w2 * ox - w0 * oz
                chain[2, at + j] = w0 * oy - w1 * ox
                chain[3, at + j] = w0
                chain[4, at + j] = w1
                chain[5, at + j] = w2
            above = parents[above]
        place = covariance[0, 0] + covariance[1, 1] + covariance[2, 2]
        turn = 0.0
        above = bone
        while above >= 0:
            at = 3 + 3 * above
            for j in range(3):
                for i in range(3):
                    place += 2.0 * chain[i, at + j] * covariance[i, at + j]
            other = bone
            while other >= 0:
                to = 3 + 3 * other
                for j in range(3):
                    for k in range(3):
                        value = covariance[at + j, to + k]
                        place += value * (
                            chain[0, at + j] * chain[0, to + k]
                            + chain[1, at + j] * chain[1, to + k]
                            + chain[2, at + j] * chain[2, to + k]
                        )
                        turn += value * (
                            chain[3, at + j] * chain[3, to + k]
                            + chain[4, at + j] * chain[4, to + k]
                            + chain[5, at + j] * chain[5, to + k]
                        )
                other = parents[other]
            above = parents[above]
        turn_out[bone] = turn
        place_out[bone] = place
