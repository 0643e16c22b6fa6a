"""The rod's equations compiled by numba (the extra `fast`): what `rod_equations` does, loop by loop.

NumPy needs some three hundred calls for one solve and spends its time between them. Types are given, so that
everything is compiled when this module is imported, or read from numba's cache on disk, and never later.
"""

import math
from typing import Any, TypeAlias

import numpy as np
from numba import njit
from numba.core.types import Tuple, boolean, float64, int64

from arm_companion.geometry.arrays import Array

Tables: TypeAlias = tuple[Any, ...]
"""Of a rod, in the order of `fast.tables`."""
Evaluated: TypeAlias = tuple[Any, ...]
"""A state: whether the bend stays outside the pitch radius, then the fields of `State`."""

V, M, T3 = float64[::1], float64[:, ::1], float64[:, :, ::1]
_FLAGS = {"contract", "reassoc", "nsz", "arcp"}  # not nnan or ninf: the iteration tests for them
JIT: dict[str, Any] = {"cache": True, "fastmath": _FLAGS, "error_model": "numpy"}
TABLES = Tuple((M, int64[::1], M, M, M, M, V, V, V, V, V, M, V, M, V, M, M))
STATE = Tuple((boolean, T3, M, V, M, M, V, V, V, M, V, V, M, M, M, V, M))


@njit(T3(M, int64, M), **JIT)
def frames(steps: Array, k: int, x: Array) -> Array:
    """Frames at the ends of all intervals; see `Rod._frames`."""
    R = np.empty((k + 1, 3, 3))
    R[0] = np.eye(3)
    a = np.empty((3, 3))
    for i in range(k):
        for order in range(3):
            for axis in range(3):
                total = 0.0
                for j in range(x.shape[1]):
                    total += steps[order * k + i, j] * x[axis, j]
                a[order, axis] = total
        c1x = a[0, 1] * a[1, 2] - a[0, 2] * a[1, 1]
        c1y = a[0, 2] * a[1, 0] - a[0, 0] * a[1, 2]
        c1z = a[0, 0] * a[1, 1] - a[0, 1] * a[1, 0]
        dx, dy, dz = 2 * a[2, 0] - c1x, 2 * a[2, 1] - c1y, 2 * a[2, 2] - c1z
        ex = a[1, 0] + (a[0, 1] * dz - a[0, 2] * dy) / 60
        ey = a[1, 1] + (a[0, 2] * dx - a[0, 0] * dz) / 60
        ez = a[1, 2] + (a[0, 0] * dy - a[0, 1] * dx) / 60
        bx, by, bz = 20 * a[0, 0] + a[2, 0] + c1x, 20 * a[0, 1] + a[2, 1] + c1y, 20 * a[0, 2] + a[2, 2] + c1z
        ux = a[0, 0] + a[2, 0] / 12 + (by * ez - bz * ey) / 240
        uy = a[0, 1] + a[2, 1] / 12 + (bz * ex - bx * ez) / 240
        uz = a[0, 2] + a[2, 2] / 12 + (bx * ey - by * ex) / 240
        t = math.sqrt(ux * ux + uy * uy + uz * uz + 1e-300)
        s = math.sin(t) / t
        h = math.sin(0.5 * t) / t
        v = 2 * h * h
        # I + s K + v K^2 with K = [[0, -uz, ux], [uz, 0, uy], [-ux, -uy, 0]]
        e00, e01, e02 = 1 - v * (uz * uz + ux * ux), -s * uz - v * ux * uy, s * ux - v * uz * uy
        e10, e11, e12 = s * uz - v * ux * uy, 1 - v * (uz * uz + uy * uy), s * uy + v * uz * ux
        e20, e21, e22 = -s * ux - v * uy * uz, -s * uy + v * ux * uz, 1 - v * (ux * ux + uy * uy)
        for row in range(3):
            p, q, r = R[i, row, 0], R[i, row, 1], R[i, row, 2]
            R[i + 1, row, 0] = p * e00 + q * e10 + r * e20
            R[i + 1, row, 1] = p * e01 + q * e11 + r * e21
            R[i + 1, row, 2] = p * e02 + q * e12 + r * e22
    return R


@njit(V(M, V), **JIT)
def turned(R: Array, v: Array) -> Array:
    """R @ v without a call into BLAS."""
    out = np.empty(3)
    for i in range(3):
        out[i] = R[i, 0] * v[0] + R[i, 1] * v[1] + R[i, 2] * v[2]
    return out


@njit(Tuple((V, V))(M, V, M), **JIT)
def _end(R: Array, load: Array, hung: Array) -> tuple[Array, Array]:
    """Resultant of the end's loads; `load` is gravity, end mass, force, moment, follower force and moment."""
    F, M = np.empty(3), np.empty(3)
    f, m = turned(R, load[10:13]), turned(R, load[13:16])
    for i in range(3):
        F[i] = load[4 + i] + load[3] * load[i] + f[i]
        M[i] = load[7 + i] + m[i]
    for row in range(hung.shape[0]):
        o = turned(R, hung[row, :3])
        x, y, z = hung[row, 3], hung[row, 4], hung[row, 5]
        F[0] += x
        F[1] += y
        F[2] += z
        M[0] += o[1] * z - o[2] * y
        M[1] += o[2] * x - o[0] * z
        M[2] += o[0] * y - o[1] * x
    return F, M


@njit(STATE(V, V, M, V, V, TABLES), **JIT)
def evaluate(c: Array, load: Array, hung: Array, pull: Array, stiffness: Array, tables: Tables) -> Evaluated:
    """See `Rod.evaluate`; the first entry says whether the bend stays outside the pitch radius."""
    steps, at_nodes, basis, weighted, _, outer, beyond, r, cos, sin, straight, cable_w, diagonal, chord, _, _, _ = (
        tables
    )
    nb, q = basis.shape
    size, n = diagonal.size, cos.size
    x = np.zeros((3, nb))
    for j in range(size):
        x[j // nb, j % nb] = c[j]
    k = steps.shape[0] // 3
    R = frames(steps, k, x)
    D = np.empty((3, 5, q))
    for i in range(q):
        at = at_nodes[i] + 1
        for comp in range(5):
            D[0, comp, i] = R[at, comp % 3, 1]
            D[1, comp, i] = -R[at, comp % 3, 0]
            D[2, comp, i] = R[at, comp % 3, 2]
    PQ = np.zeros((6, q + 1))
    for comp in range(3):
        for j in range(q):
            t = D[2, comp, j]
            for i in range(q + 1):
                PQ[comp, i] += t * outer[j, i]
                PQ[comp + 3, i] += t * beyond[j] * outer[j, i]
    R_tip = R[k].copy()
    F, M = _end(R_tip, load, hung)
    m, P = np.empty((3, q)), np.empty((3, q))
    base = np.empty(3)
    for i in range(q + 1):
        for comp in range(3):
            a, b = (comp + 1) % 3, (comp + 2) % 3
            value = M[comp] + PQ[a, i] * F[b] - PQ[b, i] * F[a] + PQ[3 + a, i] * load[b] - PQ[3 + b, i] * load[a]
            if i < q:
                m[comp, i] = value
                P[comp, i] = PQ[comp, i]
            else:
                base[comp] = value
    tip = PQ[:3, q].copy()
    kappa = np.zeros((3, q))
    for axis in range(3):
        for j in range(nb):
            for i in range(q):
                kappa[axis, i] += x[axis, j] * basis[j, i]
    residual = diagonal * c
    J = np.empty((size, 6))
    terms = np.empty((7, q))
    for axis in range(3):
        for i in range(q):
            dx, dy, dz = D[axis, 0, i], D[axis, 1, i], D[axis, 2, i]
            terms[0, i] = dy * P[2, i] - dz * P[1, i]
            terms[1, i] = dz * P[0, i] - dx * P[2, i]
            terms[2, i] = dx * P[1, i] - dy * P[0, i]
            terms[3, i], terms[4, i], terms[5, i] = dx, dy, dz
            terms[6, i] = dx * m[0, i] + dy * m[1, i] + dz * m[2, i]
        for j in range(min(nb, size - axis * nb)):
            row = axis * nb + j
            for term in range(7):
                total = 0.0
                for i in range(q):
                    total += terms[term, i] * weighted[j, i]
                if term < 6:
                    J[row, term] = total
                else:
                    residual[row] -= total
    tension, longer = np.empty(n), np.empty(n)
    path, near, length = np.empty((n, size)), np.empty((n, q)), np.empty((n, q))
    good = True
    bend, twist = np.empty(q), np.empty(q)
    for i in range(n):
        total = -straight[i]
        for j in range(q):
            a = 1 - r[j] * (cos[i] * kappa[0, j] + sin[i] * kappa[1, j])
            good = good and a > 0
            w = r[j] * kappa[2, j]
            ell = math.sqrt(a * a + w * w)
            near[i, j], length[i, j] = a, ell
            total += cable_w[i, j] * ell
            share = cable_w[i, j] / ell
            bend[j] = share * a * r[j]
            twist[j] = share * w * r[j]
        for j in range(nb):
            bent, turned = 0.0, 0.0
            for s in range(q):
                bent += bend[s] * basis[j, s]
                turned += twist[s] * basis[j, s]
            path[i, j] = -cos[i] * bent - 2 * chord[i, j] * c[j]
            path[i, nb + j] = -sin[i] * bent - 2 * chord[i, nb + j] * c[nb + j]
            if 2 * nb + j < size:
                path[i, 2 * nb + j] = turned
        for j in range(2 * nb):
            total -= chord[i, j] * c[j] * c[j]
        longer[i] = total
        tension[i] = max(0.0, stiffness[i] * (pull[i] + total)) if stiffness[i] > 0 else pull[i]
        for j in range(size):
            residual[j] += tension[i] * path[i, j]
    return good, D, P, tip, R_tip, m, base, F, M, kappa, tension, longer, path, near, length, residual, J


@njit(M(STATE, V, M, V, TABLES), **JIT)
def tangent(state: Evaluated, load: Array, hung: Array, stiffness: Array, tables: Tables) -> Array:
    """See `Rod.tangent`."""
    _, _, basis, weighted, inner, _, beyond, r, cos, sin, _, cable_w, diagonal, chord, weights, _, _ = tables
    _, D, _, _, R_tip, m, _, F, end, kappa, tension, _, path, near, length, _, J = state
    nb, q = basis.shape
    size, n = diagonal.size, cos.size
    K = np.zeros((size, size))
    h = np.zeros((6, q))
    for i in range(n):
        if tension[i] <= 0:
            continue
        cc, cs, ss = cos[i] * cos[i], cos[i] * sin[i], sin[i] * sin[i]
        for j in range(q):
            weight = tension[i] * cable_w[i, j] / (length[i, j] * length[i, j] * length[i, j])
            twist = r[j] * r[j] * kappa[2, j]
            bent = weight * near[i, j]
            h[0, j] += cc * weight * twist * twist
            h[1, j] += cs * weight * twist * twist
            h[2, j] += ss * weight * twist * twist
            h[3, j] += cos[i] * bent * r[j] * twist
            h[4, j] += sin[i] * bent * r[j] * twist
            h[5, j] += bent * near[i, j] * r[j] * r[j]
        if stiffness[i] > 0:
            for a in range(size):
                for b in range(a + 1):
                    K[a, b] += stiffness[i] * path[i, a] * path[i, b]
        for a in range(2 * nb):
            K[a, a] -= 2 * tension[i] * chord[i, a]
    for a in range(nb):
        for b in range(a + 1):
            xx, xy, yy, xz, yz, zz = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
            for j in range(q):
                product = basis[a, j] * basis[b, j]
                xx += h[0, j] * product
                xy += h[1, j] * product
                yy += h[2, j] * product
                xz += h[3, j] * product
                yz += h[4, j] * product
                zz += h[5, j] * product
            K[a, b] += xx
            K[nb + a, nb + b] += yy
            K[nb + a, b] += xy
            if a != b:
                K[nb + b, a] += xy
            if 2 * nb + a < size:
                K[2 * nb + a, b] += xz
                K[2 * nb + a, nb + b] += yz
                K[2 * nb + a, 2 * nb + b] += zz
            if a != b and 2 * nb + b < size:
                K[2 * nb + b, a] += xz
                K[2 * nb + b, nb + a] += yz
    for a in range(size):
        K[a, a] += diagonal[a]
        for b in range(a):
            K[b, a] = K[a, b]
    phi = np.zeros((size, 3, q))
    side = np.empty((size, 3, q))
    nx, along = np.empty((3, q)), np.empty(q)
    for i in range(q):
        along[i] = 0.0
        for comp in range(3):
            nx[comp, i] = weights[i] * (F[comp] + load[comp] * beyond[i])
            along[i] += nx[comp, i] * D[2, comp, i]
    for row in range(size):
        axis, j = row // nb, row % nb
        for s in range(q):
            rx, ry, rz = basis[j, s] * D[axis, 0, s], basis[j, s] * D[axis, 1, s], basis[j, s] * D[axis, 2, s]
            for i in range(q):
                phi[row, 0, i] += rx * inner[s, i]
                phi[row, 1, i] += ry * inner[s, i]
                phi[row, 2, i] += rz * inner[s, i]
        for i in range(q):
            dx, dy, dz = D[axis, 0, i], D[axis, 1, i], D[axis, 2, i]
            px, py, pz = phi[row, 0, i], phi[row, 1, i], phi[row, 2, i]
            w = weighted[j, i]
            pt = px * D[2, 0, i] + py * D[2, 1, i] + pz * D[2, 2, i]
            side[row, 0, i] = w * (dy * m[2, i] - dz * m[1, i]) + pt * nx[0, i] - px * along[i]
            side[row, 1, i] = w * (dz * m[0, i] - dx * m[2, i]) + pt * nx[1, i] - py * along[i]
            side[row, 2, i] = w * (dx * m[1, i] - dy * m[0, i]) + pt * nx[2, i] - pz * along[i]
    S, Q = side.reshape(size, 3 * q), phi.reshape(size, 3 * q)
    for a in range(size):
        # Symmetric but for the moment at the end, M . (phi_b x phi_a).
        mx = end[1] * J[a, 5] - end[2] * J[a, 4]
        my = end[2] * J[a, 3] - end[0] * J[a, 5]
        mz = end[0] * J[a, 4] - end[1] * J[a, 3]
        for b in range(a + 1):
            total = 0.0
            for i in range(3 * q):
                total += S[a, i] * Q[b, i]
            K[a, b] -= total
            if a != b:
                K[b, a] -= total + mx * J[b, 3] + my * J[b, 4] + mz * J[b, 5]
    f, g = turned(R_tip, load[10:13]), turned(R_tip, load[13:16])
    turning = f[0] != 0 or f[1] != 0 or f[2] != 0 or g[0] != 0 or g[1] != 0 or g[2] != 0
    for row in range(hung.shape[0]):
        o = turned(R_tip, hung[row, :3])
        x, y, z = hung[row, 3], hung[row, 4], hung[row, 5]
        dot = o[0] * x + o[1] * y + o[2] * z
        for a in range(size):
            ao = J[a, 3] * o[0] + J[a, 4] * o[1] + J[a, 5] * o[2]
            for b in range(size):
                bf = J[b, 3] * x + J[b, 4] * y + J[b, 5] * z
                ab = J[a, 3] * J[b, 3] + J[a, 4] * J[b, 4] + J[a, 5] * J[b, 5]
                K[a, b] -= ao * bf - dot * ab
    if turning:
        for b in range(size):
            tx, ty, tz = J[b, 3], J[b, 4], J[b, 5]
            fx, fy, fz = ty * f[2] - tz * f[1], tz * f[0] - tx * f[2], tx * f[1] - ty * f[0]
            gx, gy, gz = ty * g[2] - tz * g[1], tz * g[0] - tx * g[2], tx * g[1] - ty * g[0]
            for a in range(size):
                K[a, b] -= J[a, 0] * fx + J[a, 1] * fy + J[a, 2] * fz + J[a, 3] * gx + J[a, 4] * gy + J[a, 5] * gz
    return K
