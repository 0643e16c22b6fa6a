"""Rotations in three dimensions: matrices (3, 3), rotation vectors (3,) and quaternions (w, x, y, z).

Series stand in for the quotients near zero, so that every function is smooth through the identity.
"""

import math

import numpy as np

from arm_companion.geometry.arrays import Array, ArrayLike

_SMALL = 1e-4  # squared angle below which four terms of a series reach the last bit
_NEAR_PI = 1e-3  # distance from pi inside which the logarithm is taken from the symmetric part


def _components(v: ArrayLike) -> tuple[float, float, float]:
    x, y, z = v.tolist() if isinstance(v, np.ndarray) else v  # plain numbers: NumPy's own are slow one by one
    return x, y, z  # type: ignore[return-value]


def cross(a: ArrayLike, b: ArrayLike) -> Array:
    """Vector product a x b (3,); several times faster than numpy.cross for so small a case."""
    ax, ay, az = _components(a)
    bx, by, bz = _components(b)
    return np.array((ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx))


def hat(v: ArrayLike) -> Array:
    """Skew matrix K (3, 3) of v (3,): K @ w is v x w."""
    x, y, z = _components(v)
    return np.array((0.0, -z, y, z, 0.0, -x, -y, x, 0.0)).reshape(3, 3)


def vee(K: Array) -> Array:
    """Vector (3,) of the skew part of K: the inverse of `hat`."""
    return 0.5 * np.array((K[2, 1] - K[1, 2], K[0, 2] - K[2, 0], K[1, 0] - K[0, 1]))


def _coefficients(angle2: float) -> tuple[float, float, float]:
    """The quotients sin t / t, (1 - cos t) / t^2 and (t - sin t) / t^3 for t^2 = angle2."""
    if angle2 < _SMALL:
        return (
            1 - angle2 / 6 * (1 - angle2 / 20 * (1 - angle2 / 42)),
            0.5 - angle2 / 24 * (1 - angle2 / 30 * (1 - angle2 / 56)),
            1 / 6 - angle2 / 120 * (1 - angle2 / 42 * (1 - angle2 / 72)),
        )
    angle = math.sqrt(angle2)
    half = math.sin(0.5 * angle)
    return math.sin(angle) / angle, 2 * half * half / angle2, (angle - math.sin(angle)) / (angle2 * angle)


def exp(v: ArrayLike) -> Array:
    """Rotation matrix (3, 3) of the rotation vector v (3,), rad (Rodrigues)."""
    K = hat(v)
    s, c, _ = _coefficients(float(np.dot(v, v)))
    return np.eye(3) + s * K + c * (K @ K)


def log(R: Array) -> Array:
    """Rotation vector (3,), rad, of length at most pi, of the rotation matrix R."""
    w: Array = vee(R)
    sine = math.sqrt(float(w @ w))
    cosine = float(0.5 * (R[0, 0] + R[1, 1] + R[2, 2] - 1.0))
    angle = math.atan2(sine, cosine)
    if sine * sine < _SMALL and cosine > 0:
        # t / sin t in powers of sin^2 t, the series of arcsin
        x = sine * sine
        return w * (1 + x / 6 * (1 + x * 9 / 20 * (1 + x * 25 / 42)))
    if math.pi - angle > _NEAR_PI:
        return w * (angle / sine)
    # (R + R^T) / 2 = I + (1 - cos t) (n n^T - I): its largest column gives the axis, w its sign.
    B = 0.5 * (R + R.T) + (-cosine) * np.eye(3)
    column = B[:, int(np.argmax(np.diag(B)))]
    axis = column / math.sqrt(float(column @ column))
    if float(axis @ w) < 0:
        axis = -axis
    return axis * angle


def left_jacobian(v: ArrayLike) -> Array:
    """J (3, 3): the angular velocity of exp(v), in fixed axes, is J @ dv/dt."""
    K = hat(v)
    _, c, b = _coefficients(float(np.dot(v, v)))
    return np.eye(3) + c * K + b * (K @ K)


def inverse_left_jacobian(v: ArrayLike) -> Array:
    """Inverse (3, 3) of `left_jacobian`; singular at angles of 2 pi."""
    K = hat(v)
    angle2 = float(np.dot(v, v))
    if angle2 < _SMALL:
        d = 1 / 12 + angle2 / 720 + angle2 * angle2 / 30240
    else:
        angle = math.sqrt(angle2)
        d = (1 - 0.5 * angle / math.tan(0.5 * angle)) / angle2
    return np.eye(3) - 0.5 * K + d * (K @ K)


def is_rotation(R: Array, tolerance: float) -> bool:
    """Whether the columns of R (3, 3) are a right-handed orthonormal triad, each product to within `tolerance`."""
    (a, b, c), (d, e, f), (g, h, i) = R.tolist()  # plain numbers: NumPy takes five times as long for so few
    off = max(
        abs(a * a + d * d + g * g - 1),
        abs(b * b + e * e + h * h - 1),
        abs(c * c + f * f + i * i - 1),
        abs(a * b + d * e + g * h),
        abs(a * c + d * f + g * i),
        abs(b * c + e * f + h * i),
    )
    return bool(off <= tolerance and a * (e * i - f * h) - b * (d * i - f * g) + c * (d * h - e * g) > 0)


def from_rpy(roll: float, pitch: float, yaw: float) -> Array:
    """R_12 (3, 3) = Rz(yaw) Ry(pitch) Rx(roll), rad: turns axes 1 into axes 2, maps coordinates in 2 to 1."""
    cr, sr = math.cos(roll), math.sin(roll)
    cp, sp = math.cos(pitch), math.sin(pitch)
    cy, sy = math.cos(yaw), math.sin(yaw)
    return np.array(
        (
            (cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr),
            (sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr),
            (-sp, cp * sr, cp * cr),
        )
    )


def from_quaternion(q: ArrayLike) -> Array:
    """R (3, 3) of the quaternion (w, x, y, z), which need not be of unit length.

    Raises:
        ValueError: when its length is zero or not finite.
    """
    w, x, y, z = (float(value) for value in q)  # type: ignore[arg-type]
    n = w * w + x * x + y * y + z * z
    if not (0 < n < math.inf):
        raise ValueError(f"no rotation has the quaternion {(w, x, y, z)}")
    s = 2.0 / n
    return np.array(
        (
            (1 - s * (y * y + z * z), s * (x * y - w * z), s * (x * z + w * y)),
            (s * (x * y + w * z), 1 - s * (x * x + z * z), s * (y * z - w * x)),
            (s * (x * z - w * y), s * (y * z + w * x), 1 - s * (x * x + y * y)),
        )
    )


def to_quaternion(R: Array) -> tuple[float, float, float, float]:
    """Unit quaternion (w, x, y, z) with w >= 0 of the rotation matrix R (3, 3)."""
    xx, yy, zz = float(R[0, 0]), float(R[1, 1]), float(R[2, 2])
    # Four times the squares of the components; the largest is the safe one to divide by (Shepperd).
    squares = (1 + xx + yy + zz, 1 + xx - yy - zz, 1 - xx + yy - zz, 1 - xx - yy + zz)
    largest = max(range(4), key=squares.__getitem__)
    a, b, c = float(R[2, 1] - R[1, 2]), float(R[0, 2] - R[2, 0]), float(R[1, 0] - R[0, 1])
    d, e, f = float(R[1, 0] + R[0, 1]), float(R[0, 2] + R[2, 0]), float(R[2, 1] + R[1, 2])
    row = ((squares[0], a, b, c), (a, squares[1], d, e), (b, d, squares[2], f), (c, e, f, squares[3]))[largest]
    scale = math.copysign(0.5 / math.sqrt(squares[largest]), row[0])
    return row[0] * scale, row[1] * scale, row[2] * scale, row[3] * scale


def perpendicular(axis: ArrayLike) -> Array:
    """Two unit vectors (2, 3) that form a right-handed triad with the unit vector `axis` (3,) as the third.

    Raises:
        ValueError: when `axis` is not of unit length.
    """
    z = np.asarray(axis, dtype=np.float64)
    if abs(float(z @ z) - 1.0) > 1e-6:
        raise ValueError(f"axis {z.tolist()} is not of unit length")
    helper = np.zeros(3)
    helper[int(np.argmin(np.abs(z)))] = 1.0
    x = cross(helper, z)
    x /= math.sqrt(float(x @ x))
    return np.array((x, cross(z, x)))
