"""SE(2): group axioms, the exponential against the matrix one, and the seam of the circle."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.linalg import expm

from fusion import SkyfixError, se2

coordinate = st.floats(-1e3, 1e3)
angle = st.one_of(st.floats(-50.0, 50.0), st.sampled_from([0.0, np.pi, -np.pi, 1e-12, np.pi - 1e-12, -np.pi + 1e-12]))
batch_shapes = st.sampled_from([(), (1,), (4,), (2, 3)])


@st.composite
def poses(draw, shape=None):
    shape = draw(batch_shapes) if shape is None else shape
    xy = draw(arrays(np.float64, (*shape, 2), elements=coordinate))
    yaw = draw(arrays(np.float64, (*shape, 1), elements=angle))
    return np.concatenate([xy, se2.wrap(yaw)], axis=-1)


def assert_same_pose(a, b, tolerance=1e-9):
    assert a.shape == b.shape
    np.testing.assert_allclose(a[..., :2], b[..., :2], rtol=1e-9, atol=tolerance * 1e3)
    np.testing.assert_allclose(se2.wrap(a[..., 2] - b[..., 2]), 0.0, atol=tolerance)


@given(st.floats(-1e6, 1e6))
def test_wrap_lands_in_the_half_open_interval_and_keeps_the_direction(value):
    wrapped = se2.wrap(value)
    assert -np.pi <= wrapped < np.pi
    np.testing.assert_allclose([np.cos(wrapped), np.sin(wrapped)], [np.cos(value), np.sin(value)], atol=1e-9)


@given(st.floats(-np.pi, np.pi, exclude_max=True))
def test_wrap_leaves_wrapped_angles_bit_for_bit(value):
    assert se2.wrap(value) == value


@pytest.mark.parametrize("value", [np.pi, -np.pi, 3 * np.pi, -3 * np.pi, np.nextafter(-np.pi, -4.0)])
def test_wrap_at_the_seam(value):
    assert -np.pi <= se2.wrap(value) < np.pi
    assert abs(abs(se2.wrap(value)) - np.pi) < 1e-12


@given(st.data())
def test_group_axioms_hold_for_every_batch_shape(data):
    shape = data.draw(batch_shapes)
    a, b, c = (data.draw(poses(shape)) for _ in range(3))
    identity = np.zeros((*shape, 3))
    assert_same_pose(se2.compose(se2.compose(a, b), c), se2.compose(a, se2.compose(b, c)))
    assert_same_pose(se2.compose(a, identity), a)
    assert_same_pose(se2.compose(identity, a), a)
    assert_same_pose(se2.compose(a, se2.inverse(a)), identity)
    assert_same_pose(se2.between(a, b), se2.compose(se2.inverse(a), b))


def test_leading_axes_broadcast():
    one, many = np.array([1.0, 2.0, 0.5]), np.random.default_rng(0).normal(size=(5, 3))
    expected = np.array([se2.compose(one, each) for each in many])
    np.testing.assert_array_equal(se2.compose(one, many), expected)


def test_compose_agrees_with_a_drawing():
    facing_north_at_1_2 = np.array([1.0, 2.0, np.pi / 2])
    three_ahead_one_left = np.array([3.0, 1.0, np.pi / 2])
    np.testing.assert_allclose(se2.compose(facing_north_at_1_2, three_ahead_one_left), [0.0, 5.0, -np.pi], atol=1e-15)


@given(arrays(np.float64, 3, elements=st.floats(-3.0, 3.0)))
def test_exp_is_the_matrix_exponential(twist):
    vx, vy, omega = twist
    matrix = expm(np.array([[0.0, -omega, vx], [omega, 0.0, vy], [0.0, 0.0, 0.0]]))
    x, y, yaw = se2.exp(twist)
    np.testing.assert_allclose([x, y], matrix[:2, 2], atol=1e-12)
    np.testing.assert_allclose([np.cos(yaw), np.sin(yaw)], matrix[:2, 0], atol=1e-12)


@given(poses())
def test_exp_undoes_log(pose):
    assert_same_pose(se2.exp(se2.log(pose)), pose)


@pytest.mark.parametrize("omega", [0.0, 1e-300, 1e-16, -1e-9, 1e-6, -1e-3, 3.0, -np.pi, np.pi - 1e-15])
def test_log_undoes_exp_to_the_last_digits_at_zero_and_at_pi(omega):
    twist = np.array([0.3, -0.7, omega])
    np.testing.assert_allclose(se2.log(se2.exp(twist)), twist, rtol=1e-14, atol=1e-15)


@given(poses(()), arrays(np.float64, 3, elements=st.floats(-1.0, 1.0)))
def test_adjoint_moves_a_twist_to_the_other_side(pose, twist):
    moved = np.einsum("...ij,...j->...i", se2.adjoint(pose), twist)
    assert_same_pose(se2.compose(pose, se2.exp(twist)), se2.compose(se2.exp(moved), pose), 1e-8)


@given(poses((4,)), poses((4,)))
def test_transform_points_follows_composition(a, b):
    points = b[:, :2]
    np.testing.assert_allclose(se2.transform_points(a, points), se2.compose(a, b)[:, :2], atol=1e-9)
    np.testing.assert_allclose(se2.transform_points(se2.inverse(a), se2.transform_points(a, points)), points, atol=1e-6)


@given(st.floats(-np.pi, np.pi), st.floats(0.01, 1.0))
def test_circular_mean_of_a_symmetric_pair_is_its_centre_wherever_the_seam_is(centre, half):
    mean = se2.circular_mean(se2.wrap([centre - half, centre + half]))
    assert abs(se2.wrap(mean - centre)) < 1e-12


def test_circular_mean_honours_weights():
    assert se2.circular_mean([0.0, 1.0], [1.0, 0.0]) == 0.0
    assert se2.circular_mean([np.pi - 0.1, -np.pi + 0.1], [1.0, 1.0]) == pytest.approx(-np.pi, abs=1e-12)


@given(st.floats(-np.pi, np.pi))
def test_cloud_moments_turn_with_the_cloud(turn):
    rng = np.random.default_rng(3)
    cloud = rng.normal([2.0, -1.0, 0.2], [1.0, 0.3, 0.1], (200, 3))
    weights = rng.random(200)
    mean, covariance = se2.weighted_mean_and_covariance(cloud, weights)
    frame = np.array([10.0, 5.0, turn])
    turned_mean, turned_covariance = se2.weighted_mean_and_covariance(se2.compose(frame, cloud), weights)
    assert_same_pose(turned_mean, se2.compose(frame, mean))
    rotation = se2.rotation(turn)
    np.testing.assert_allclose(turned_covariance, rotation @ covariance @ rotation.T, atol=1e-9)


def test_cloud_moments_match_numpy():
    rng = np.random.default_rng(4)
    cloud = rng.normal(0.0, [1.0, 2.0, 0.05], (500, 3))
    _, covariance = se2.weighted_mean_and_covariance(cloud, np.full(500, 7.0))
    np.testing.assert_allclose(covariance, np.cov(cloud.T, ddof=0), rtol=1e-3, atol=1e-6)


@pytest.mark.parametrize("weights", [[0.0, 0.0], [1.0, -0.5], [1.0, np.nan]])
def test_cloud_moments_refuse_weights_that_mean_nothing(weights):
    with pytest.raises(SkyfixError, match="weights"):
        se2.weighted_mean_and_covariance(np.zeros((2, 3)), weights)
