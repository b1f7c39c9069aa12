"""Analytic derivatives against those by a complex step of an independent implementation."""

from bellows_ros.core.jacobians import (
    body_jacobians,
    parameter_jacobian,
    PARAMETERS,
    tool_jacobians,
)
from bellows_ros.core.kernels import advance
from bellows_ros.core.lie import exp_so3, quaternion_to_rotation, rotation_to_quaternion
from bellows_ros.core.model import model_tuple
from bellows_ros.core.sensitivities import sensitivities
from bellows_ros.core.simulation import simulate_rows, state_row
from bellows_ros.core.tuples import SMALL_ANGLE_SQUARED
import numpy as np
from numpy.testing import assert_allclose
import pytest

from . import complex_step
from .cases import random_cup, random_package, random_pose

GRAVITY = np.array([0.4, -0.7, -9.6])


class Case:
    """A cup, a package and two tool samples, as kernels and as the second implementation."""

    def __init__(self, seed, turn=0.1):
        """Draw them; the tool turns by so much (rad) from sample to sample."""
        rng = np.random.default_rng(seed)
        cup, package = random_cup(rng), random_package(rng)
        self.model = model_tuple(cup, package, GRAVITY)
        self.numbers = complex_step.Numbers.of(cup, package, GRAVITY)
        T = random_pose(rng)
        R_end = T[:3, :3] @ exp_so3(turn * np.array([0.48, -0.6, 0.64]))
        self.tool = T[:3, 3], T[:3, :3], rng.standard_normal(6)
        self.end = T[:3, 3] + 0.01 * rng.standard_normal(3), R_end, rng.standard_normal(6)
        T_tool_package = random_pose(rng, 0.3, 0.01)
        T_tool_package[2, 3] -= 0.1
        T = T @ T_tool_package
        self.body = T[:3, 3], T[:3, :3], rng.standard_normal(6)

    @staticmethod
    def row(state):
        """Return a state as the kernels take it."""
        return state_row(state[0], rotation_to_quaternion(state[1]), state[2])


def six_by_six(square):
    a, b, c, d = (np.reshape(block, (3, 3)) for block in square)
    return np.block([[a, b], [c, d]])


def near(actual, expected, part):
    """Compare two matrices, relative to the largest of the second."""
    assert_allclose(actual, expected, rtol=0, atol=part * np.abs(expected).max())


@pytest.mark.parametrize('seed', range(3))
def test_accelerations_follow_states(seed):
    case = Case(seed)
    rows = case.model, case.row(case.tool), case.row(case.body)

    def of_body(x):
        return complex_step.acceleration(
            case.numbers, case.tool, complex_step.changed(case.body, x))

    def of_tool(x):
        return complex_step.acceleration(
            case.numbers, complex_step.changed(case.tool, x), case.body)

    for function, jacobians in ((of_body, body_jacobians), (of_tool, tool_jacobians)):
        pose, twist = jacobians(*rows)
        expected = complex_step.derivative(function, np.zeros(12))
        near(six_by_six(pose), expected[:, :6], 1e-12)
        near(six_by_six(twist), expected[:, 6:], 1e-12)


@pytest.mark.parametrize('seed', range(3))
def test_accelerations_follow_parameters(seed):
    case = Case(seed)
    out = np.zeros((6, PARAMETERS))
    parameter_jacobian(
        case.model, case.row(case.tool), case.row(case.body), 0, PARAMETERS, out, 0)
    expected = complex_step.derivative(
        lambda p: complex_step.acceleration(p, case.tool, case.body), case.numbers)
    for column in range(PARAMETERS):
        near(out[:, column], expected[:, column], 1e-11)


def test_some_of_the_parameters_stand_where_they_are_asked_for():
    case = Case(3)
    rows = case.model, case.row(case.tool), case.row(case.body)
    whole, part = np.zeros((6, PARAMETERS)), np.zeros((6, 20))
    parameter_jacobian(*rows, 0, PARAMETERS, whole, 0)
    parameter_jacobian(*rows, 35, 50, part, 3)
    assert_allclose(part[:, 3:18], whole[:, 35:50])
    assert not part[:, :3].any()
    assert not part[:, 18:].any()


# on both sides of the angle at which series and closed forms meet
@pytest.mark.parametrize('turn', [1e-9, 0.1, 0.4, 0.99 * SMALL_ANGLE_SQUARED**0.5, 0.51, 1.2])
@pytest.mark.parametrize('substeps', [1, 3])
def test_steps_follow_states_and_parameters(turn, substeps):
    case, duration = Case(4, turn), 0.008
    rows = [case.row(state) for state in (case.body, case.tool, case.end)]
    changes = np.zeros((2, 12, 24))
    changes[0, :, :12], changes[1, :, 12:] = np.eye(12), np.eye(12)
    (_, end), (_, found) = sensitivities(
        case.model, rows[0], np.array([np.concatenate(row) for row in rows[1:]]),
        np.array([duration]), np.array([substeps]), slice(0, PARAMETERS), changes)
    plain = advance(case.model, *rows, duration, substeps)
    assert_allclose(end, np.concatenate(plain), rtol=0, atol=1e-15)
    states = case.body, case.tool, case.end
    after = complex_step.advance(case.numbers, *states, duration, substeps)
    assert_allclose(after[0].real, plain[0], atol=1e-13)

    def of_state(which):
        def function(x):
            moved = list(states)
            moved[which] = complex_step.changed(moved[which], x)
            return complex_step.change(
                after, complex_step.advance(case.numbers, *moved, duration, substeps))
        return complex_step.derivative(function, np.zeros(12))

    body, parameters, start, last = np.split(found, np.cumsum([12, PARAMETERS, 12]), axis=1)
    for which, derivative in enumerate((body, start, last)):
        near(derivative, of_state(which), 1e-11)
    expected = complex_step.derivative(
        lambda p: complex_step.change(
            after, complex_step.advance(p, *states, duration, substeps)), case.numbers)
    for column in range(PARAMETERS):
        near(parameters[:, column], expected[:, column], 1e-9)


def test_whole_motions_follow_their_start_parameters_and_tool():
    rng = np.random.default_rng(5)
    case, n = Case(5), 5
    still = np.concatenate([*case.row(case.tool)[:2], np.zeros(6)])
    tool = np.tile(still, (n, 1)) + 1e-3 * rng.standard_normal((n, 13)) * (np.arange(13) < 3)
    durations, substeps = np.full(n - 1, 0.004), np.full(n - 1, 2)
    start = case.row(case.body)
    changes = rng.standard_normal((n, 12, 1))
    states, found = sensitivities(
        case.model, start, tool, durations, substeps, slice(0, 42), changes)
    assert_allclose(
        states, simulate_rows(case.model, start, tool, durations, substeps), atol=1e-15)

    def motion(p, x, along):
        body = complex_step.changed(case.body, x)
        poses = [(row[:3], quaternion_to_rotation(row[3:7]), row[7:]) for row in tool]
        poses = [
            complex_step.changed(pose, along * c[:, 0])
            for pose, c in zip(poses, changes, strict=True)]
        for a, b in zip(poses[:-1], poses[1:], strict=True):
            body = complex_step.advance(p, body, a, b, 0.004, 2)
        return body

    end = motion(case.numbers, np.zeros(12), 0.0)
    near(found[-1, :, :12], complex_step.derivative(
        lambda x: complex_step.change(end, motion(case.numbers, x, 0.0)), np.zeros(12)), 1e-9)
    expected = complex_step.derivative(
        lambda p: complex_step.change(end, motion(p, np.zeros(12), 0.0)), case.numbers)
    for column in range(42):
        near(found[-1, :, 12 + column], expected[:, column], 1e-9)
    near(found[-1, :, 54:], complex_step.derivative(
        lambda a: complex_step.change(end, motion(case.numbers, np.zeros(12), a[0])), [0.0]), 1e-9)
