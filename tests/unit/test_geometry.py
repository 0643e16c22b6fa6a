"""Laws of rotations, poses and wrenches."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from arm_companion.geometry import so3, wrench
from arm_companion.geometry.arrays import frozen
from arm_companion.geometry.se3 import Pose

vectors = arrays(np.float64, 3, elements=st.floats(-1.5, 1.5))
tiny = st.sampled_from([0.0, 1e-12, 1e-7, 1e-4, 0.0099, 0.0101, 1.0])
wrenches = arrays(np.float64, 6, elements=st.floats(-10, 10))


def pose(v, p):
    return Pose(so3.exp(v), p)


@given(vectors, tiny)
def test_exp_is_a_rotation_and_log_inverts_it(v, scale):
    R = so3.exp(v * scale)
    assert np.allclose(R.T @ R, np.eye(3), atol=1e-14)
    assert math.isclose(np.linalg.det(R), 1.0, abs_tol=1e-13)
    assert np.allclose(so3.log(R), v * scale, atol=1e-12)


@pytest.mark.parametrize("angle", [math.pi - 1e-2, math.pi - 1.1e-3, math.pi - 9e-4, math.pi - 1e-9, math.pi])
@pytest.mark.parametrize("axis", [(1, 0, 0), (0, -1, 0), (0.6, 0, 0.8), (0.48, 0.6, 0.64)])
def test_log_near_half_a_turn(angle, axis):
    v = angle * np.array(axis, dtype=float)
    assert np.allclose(so3.exp(so3.log(so3.exp(v))), so3.exp(v), atol=1e-9)
    assert math.isclose(np.linalg.norm(so3.log(so3.exp(v))), angle, rel_tol=1e-6)


@given(vectors, vectors, tiny)
def test_left_jacobian_is_the_derivative_of_exp(v, direction, scale):
    v, h = v * scale, 1e-6
    turned = so3.log(so3.exp(v + h * direction) @ so3.exp(v - h * direction).T) / (2 * h)
    assert np.allclose(so3.left_jacobian(v) @ direction, turned, atol=1e-8)
    assert np.allclose(so3.inverse_left_jacobian(v) @ so3.left_jacobian(v), np.eye(3), atol=1e-12)


@given(vectors, vectors)
def test_cross_and_hat_agree_with_numpy(a, b):
    assert np.allclose(so3.cross(a, b), np.cross(a, b), atol=1e-15)
    assert np.allclose(so3.hat(a) @ b, np.cross(a, b), atol=1e-15)
    assert np.allclose(so3.vee(so3.hat(a)), a)


@given(vectors)
def test_quaternions_go_there_and_back(v):
    R = so3.exp(2 * v)
    q = so3.to_quaternion(R)
    assert q[0] >= 0
    assert math.isclose(math.fsum(x * x for x in q), 1.0, rel_tol=1e-12)
    assert np.allclose(so3.from_quaternion(q), R, atol=1e-12)
    assert np.allclose(so3.from_quaternion(-3 * np.array(q)), R, atol=1e-12)


def test_quaternion_of_no_length_is_refused():
    with pytest.raises(ValueError, match="no rotation"):
        so3.from_quaternion((0, 0, 0, 0))
    with pytest.raises(ValueError, match="no rotation"):
        so3.from_quaternion((math.nan, 0, 0, 1))


def test_rpy_turns_yaw_last():
    R = so3.from_rpy(0.0, 0.0, math.pi / 2)
    assert np.allclose(R @ (1, 0, 0), (0, 1, 0))
    expected = so3.exp([0, 0, 0.3]) @ so3.exp([0, -0.2, 0]) @ so3.exp([0.1, 0, 0])
    assert np.allclose(so3.from_rpy(0.1, -0.2, 0.3), expected)


@given(vectors)
def test_perpendicular_completes_a_right_handed_triad(v):
    if np.linalg.norm(v) < 1e-3:
        return
    axis = v / np.linalg.norm(v)
    x, y = so3.perpendicular(axis)
    assert np.allclose(np.array((x, y, axis)) @ np.array((x, y, axis)).T, np.eye(3), atol=1e-12)
    assert np.allclose(np.cross(x, y), axis)


def test_perpendicular_wants_a_unit_vector():
    with pytest.raises(ValueError, match="unit length"):
        so3.perpendicular((1.0, 1.0, 0.0))


@given(vectors, vectors, vectors, vectors, vectors)
def test_poses_compose_and_invert(v, p, w, q, point):
    a, b = pose(v, p), pose(w, q)
    assert np.allclose((a @ b) @ point, a @ (b @ point))
    assert np.allclose((a @ b).matrix(), a.matrix() @ b.matrix())
    assert np.allclose(a.inverse() @ (a @ point), point)
    assert np.allclose((a @ np.vstack((point, point)))[1], a @ point)


@given(vectors, vectors, vectors, vectors)
def test_moved_undoes_difference(v, p, w, q):
    a, b = pose(0.5 * v, p), pose(0.5 * w, q)
    assert np.allclose(a.moved(a.difference(b)).matrix(), b.matrix(), atol=1e-9)


@given(vectors, vectors, wrenches, wrenches)
def test_power_does_not_depend_on_frame_or_point(v, p, w_b, twist_a):
    T_ab = pose(v, p)
    w_a = wrench.transformed(w_b, T_ab)
    X = wrench.transform_matrix(T_ab)
    assert np.allclose(X @ w_b, w_a)
    assert math.isclose(w_a @ twist_a, w_b @ (X.T @ twist_a), rel_tol=1e-9, abs_tol=1e-9)


def test_a_force_beside_the_point_turns_about_it():
    # 2 N along y, applied 3 m along x from the new point
    assert np.allclose(wrench.at_point((0, 2, 0, 0, 0, 0), (3, 0, 0)), (0, 2, 0, 0, 0, 6))


def test_frozen_arrays_are_copies_that_nobody_can_change():
    source = np.ones(3)
    copy = frozen(source, (3,))
    source[0] = 5
    assert copy[0] == 1
    with pytest.raises(ValueError, match="read-only"):
        copy[0] = 2


@pytest.mark.parametrize(
    ("values", "match"), [((1.0, 2.0), "shape"), ((1.0, math.nan, 0.0), "finite"), ((math.inf, 0.0, 0.0), "finite")]
)
def test_frozen_refuses(values, match):
    with pytest.raises(ValueError, match=match):
        frozen(values, (3,))


def test_a_pose_wants_a_rotation():
    with pytest.raises(ValueError, match="not a rotation"):
        Pose(2 * np.eye(3), np.zeros(3))
    with pytest.raises(ValueError, match="not a rotation"):
        Pose(np.diag((1.0, 1.0, -1.0)), np.zeros(3))
