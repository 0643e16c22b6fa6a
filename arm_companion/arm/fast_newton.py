"""Newton's method for a rod, compiled by numba: what `rod_solver.newton` does, with its checks, in one call.

Numba's cache on disk looks at the file that a function stands in and not at those it calls: after a change in
`fast_equations` this file must be saved anew as well (an installation writes both; the tests notice).
"""

import math
from typing import Any

import numpy as np
from numba import njit
from numba.core.types import Tuple, boolean, float64, int64

from arm_companion.arm.fast_equations import JIT, STATE, TABLES, Evaluated, M, Tables, V, evaluate, tangent, turned
from arm_companion.arm.rod_equations import FAINT
from arm_companion.arm.rod_solver import INDIFFERENT
from arm_companion.geometry.arrays import Array

FREE, PINNED, BAR, CLAMPED = 0, 1, 2, 3

_BLOWN = 1e3  # growth of the error at which Newton is lost
_STIFFEN = 1e4


@njit(boolean(M, V), **JIT)
def solve_in_place(A: Array, b: Array) -> bool:
    """Gauss with partial pivoting: b becomes the solution; False when A is singular."""
    n = b.size
    for k in range(n):
        best, at = abs(A[k, k]), k
        for i in range(k + 1, n):
            if abs(A[i, k]) > best:
                best, at = abs(A[i, k]), i
        if not best > 1e-300:
            return False
        if at != k:
            for j in range(k, n):
                A[k, j], A[at, j] = A[at, j], A[k, j]
            b[k], b[at] = b[at], b[k]
        for i in range(k + 1, n):
            factor = A[i, k] / A[k, k]
            if factor != 0:
                for j in range(k + 1, n):
                    A[i, j] -= factor * A[k, j]
                b[i] -= factor * b[k]
    for k in range(n - 1, -1, -1):
        total = b[k]
        for j in range(k + 1, n):
            total -= A[k, j] * b[j]
        b[k] = total / A[k, k]
    return True


@njit(boolean(M), **JIT)
def is_positive(A: Array) -> bool:
    """Cholesky's test for a positive definite A, of which only the lower half is read; A is destroyed."""
    n = A.shape[0]
    for k in range(n):
        pivot = A[k, k]
        for j in range(k):
            pivot -= A[k, j] * A[k, j]
        if not pivot > 0:
            return False
        root = math.sqrt(pivot)
        A[k, k] = root
        for i in range(k + 1, n):
            total = A[i, k]
            for j in range(k):
                total -= A[i, j] * A[k, j]
            A[i, k] = total / root
    return True


@njit(Tuple((V, M, M))(int64, V, V, M, V, M), **JIT)
def _gap(kind: int, support: Array, tip: Array, R_tip: Array, residual: Array, J: Array) -> tuple[Array, Array, Array]:
    """By how much the support is missed (k,), its derivative (size, k), and its forces (size, k)."""
    size = residual.size
    k = 0 if kind == FREE else (3 if kind == PINNED else (5 if kind == BAR else 6))
    gap, C, B = np.empty(k), np.empty((size, k)), np.empty((size, k))
    if kind == FREE:
        return gap, C, B
    o = turned(R_tip, support[:3])
    for a in range(3):
        gap[a] = tip[a] + o[a] - support[3 + a]
    for row in range(size):
        x, y, z = J[row, 3], J[row, 4], J[row, 5]
        C[row, 0] = J[row, 0] + y * o[2] - z * o[1]
        C[row, 1] = J[row, 1] + z * o[0] - x * o[2]
        C[row, 2] = J[row, 2] + x * o[1] - y * o[0]
        for a in range(3):
            B[row, a] = C[row, a]
    if kind == CLAMPED:
        E = np.empty((3, 3))
        for a in range(3):
            for b in range(3):
                E[a, b] = 0.0
                for j in range(3):
                    E[a, b] += R_tip[a, j] * support[6 + 3 * b + j]
        x, y, z = 0.5 * (E[2, 1] - E[1, 2]), 0.5 * (E[0, 2] - E[2, 0]), 0.5 * (E[1, 0] - E[0, 1])
        sine = math.sqrt(x * x + y * y + z * z)
        angle = math.atan2(sine, 0.5 * (E[0, 0] + E[1, 1] + E[2, 2] - 1))
        ratio = angle / sine if sine > 1e-8 else 1.0
        gap[3], gap[4], gap[5] = ratio * x, ratio * y, ratio * z
        for row in range(size):
            for a in range(3):
                C[row, 3 + a] = J[row, 3 + a]
                B[row, 3 + a] = J[row, 3 + a]
    if kind == BAR:
        body = np.empty(3)
        for j in range(3):
            body[j] = 0.0
            for a in range(3):
                body[j] += support[6 + 3 * a + j] * support[15 + a]
        v = turned(R_tip, body)
        for i in range(2):
            p, q, r = support[18 + 3 * i], support[19 + 3 * i], support[20 + 3 * i]
            gap[3 + i] = p * v[0] + q * v[1] + r * v[2]
            dx, dy, dz = v[1] * r - v[2] * q, v[2] * p - v[0] * r, v[0] * q - v[1] * p
            for row in range(size):
                x, y, z = J[row, 3], J[row, 4], J[row, 5]
                C[row, 3 + i] = x * dx + y * dy + z * dz
                B[row, 3 + i] = x * support[24 + 3 * i] + y * support[25 + 3 * i] + z * support[26 + 3 * i]
    return gap, C, B


@njit(boolean(M, M, V), **JIT)
def is_stable(K: Array, C: Array, scale: Array) -> bool:
    """Whether K is positive on the motions that C forbids not, judged with the forbidden ones made stiff."""
    size, k = C.shape
    A = np.empty((size, size))
    for a in range(size):
        for b in range(a + 1):
            total = 0.5 * (K[a, b] + K[b, a])
            for i in range(k):
                by = _STIFFEN * scale[0] / (scale[1] * scale[1] if i < 3 else 1.0)
                total += by * C[a, i] * C[b, i]
            A[a, b] = total
        A[a, a] -= INDIFFERENT * scale[0]
    return is_positive(A)


@njit(float64(STATE, float64, TABLES), **JIT)
def imbalance(state: Evaluated, scale: float, tables: Tables) -> float:
    """See `Rod.imbalance`."""
    _, _, _, _, _, _, _, r, cos, sin, _, cable_w, _, _, weights, stiffness, node_chord = tables
    _, D, _, _, _, m, _, _, _, kappa, tension, _, _, near, length, _, _ = state
    wrong, bend, load = 0.0, 0.0, 0.0
    for j in range(weights.size):
        x, y, z = kappa[0, j], kappa[1, j], kappa[2, j]
        cable_x, cable_y, cable_z = 0.0, 0.0, 0.0
        for i in range(tension.size):
            if cable_w[i, j] > 0:
                pulled = tension[i] / length[i, j]
                cable_x += r[j] * cos[i] * near[i, j] * pulled
                cable_y += r[j] * sin[i] * near[i, j] * pulled
                cable_z += r[j] * r[j] * pulled
            drop = 2 * tension[i] * node_chord[i, j]
            cable_x += drop * x
            cable_y += drop * y
        for axis in range(3):
            moment = D[axis, 0, j] * m[0, j] + D[axis, 1, j] * m[1, j] + D[axis, 2, j] * m[2, j]
            own = stiffness[axis, j] * kappa[axis, j]
            rest = own - moment
            if axis == 0:
                rest -= cable_x
            elif axis == 1:
                rest -= cable_y
            else:
                rest += cable_z * z
            give = weights[j] / stiffness[axis, j]
            wrong += give * rest * rest
            bend += give * own * own
            load += give * moment * moment
    return wrong / (load + min(bend, 3 * load) + FAINT * scale)


_RESULT = Tuple((int64, int64, float64, float64, boolean, V, V, M, M, V))


@njit(_RESULT(V, V, int64, V, V, M, V, V, M, boolean, V, TABLES), **JIT)
def newton(
    c: Array,
    wrench: Array,
    kind: int,
    support: Array,
    load: Array,
    hung: Array,
    pull: Array,
    stiffness: Array,
    K: Array,
    has_tangent: bool,
    limits: Array,
    tables: Tables,
) -> tuple[Any, ...]:
    """See `rod_solver.newton`.

    Args:
        c: guess (size,).
        wrench: guess of the multipliers (k,).
        kind: of support.
        support: pivot, point, R row by row, axis, two directions across it, two moment directions (30,).
        load: gravity, end mass, force, moment, follower force, follower moment (16,).
        hung: points and dead forces (h, 6); with a pivot off the centre the last row is the support's own.
        pull: (n,).
        stiffness: (n,).
        K: tangent of a neighbour (size, size).
        has_tangent: whether K is one.
        limits: moment scale, length, tolerance, largest step, most steps, mass of the arm.
        tables: of the rod.

    Returns:
        Status (0 solved, 1 lost, 2 bent too sharp), steps, error, imbalance, stability, c, multipliers, tangent,
        constraint derivative, and tip, R_tip, base wrench and tensions in one row.
    """
    scale, L, tolerance, step_limit, most = limits[0], limits[1], limits[2], limits[3], int(limits[4])
    size = c.size
    c, wrench, hung = c.copy(), wrench.copy(), hung.copy()
    central = support[0] == 0 and support[1] == 0 and support[2] == 0
    full = load.copy()
    last = math.inf
    k = wrench.size
    status, steps, error = 1, 0, math.inf
    A, right = np.empty((size + k, size + k)), np.empty(size + k)
    while True:
        for a in range(16):
            full[a] = load[a]
        if kind != FREE:
            for a in range(3):
                if central:
                    full[4 + a] += wrench[a]
                else:
                    hung[hung.shape[0] - 1, 3 + a] = wrench[a]
            if kind == CLAMPED:
                for a in range(3):
                    full[7 + a] += wrench[3 + a]
            if kind == BAR:
                for i in range(2):
                    for a in range(3):
                        full[7 + a] += wrench[3 + i] * support[24 + 3 * i + a]
        state = evaluate(c, full, hung, pull, stiffness, tables)
        residual = state[15]
        gap, C, B = _gap(kind, support, state[3], state[4], residual, state[16])
        if not state[0]:
            status = 2
            break
        error, force = 0.0, 0.0
        for a in range(size):
            error = max(error, abs(residual[a]))
        for a in range(k):
            force = max(force, abs(wrench[a]))
        error /= scale + force * L
        for a in range(k):
            error = max(error, abs(gap[a]) / (L if a < 3 else 1.0))
        if error < tolerance:
            status = 0
            break
        if not error < _BLOWN * max(last, 1e-3) or steps == most:
            break
        last = error
        if not has_tangent or steps > 0:
            K = tangent(state, full, hung, stiffness, tables)
        for a in range(size):
            right[a] = residual[a]
            for b in range(size):
                A[a, b] = K[a, b]
            for b in range(k):
                by = 1 / L if b < 3 else 1.0
                A[a, size + b] = -B[a, b] * by
                A[size + b, a] = C[a, b] * by
        for a in range(k):
            right[size + a] = gap[a] / (L if a < 3 else 1.0)
            for b in range(k):
                A[size + a, size + b] = 0.0
        if not solve_in_place(A, right):
            break
        largest = 0.0
        for a in range(size):
            largest = max(largest, abs(right[a]))
        share = 1.0 if largest < step_limit else step_limit / largest
        for a in range(size):
            c[a] -= share * right[a]
        for a in range(k):
            wrench[a] -= share * right[size + a] / (L if a < 3 else 1.0)
        steps += 1
    stable, apart = False, math.inf
    if status == 0:
        if steps < 2 and (has_tangent or steps == 0):  # a neighbour's tangent says nothing about this equilibrium
            K = tangent(state, full, hung, stiffness, tables)
        stable = is_stable(K, C, limits)
        apart = imbalance(state, scale, tables)
    ends = np.empty(18 + pull.size)
    for a in range(3):
        ends[a] = state[3][a]
        for b in range(3):
            ends[3 + 3 * a + b] = state[4][a, b]
        ends[12 + a] = state[7][a] + limits[5] * load[a]
        ends[15 + a] = state[6][a]
    for a in range(pull.size):
        ends[18 + a] = state[10][a]
    return status, steps, error, apart, stable, c, wrench, K, C, ends
