"""Analytic derivatives against those by a complex step of an independent implementation."""

from dataclasses import replace

from bellows_ros.core.model.cup_package import model_tuple
from bellows_ros.core.model.jacobians import PARAMETER_COLUMNS, parameter_jacobian
import numpy as np
from numpy.testing import assert_allclose

from .. import complex_step
from ..cases import random_cup, random_package, random_pose, state_of

GRAVITY = np.array([0.4, -0.7, -9.6])


class Case:
    """A cup, a package and a tool, as kernels and as the second implementation."""

    def __init__(self, seed, stretch=(0.0, 0.0)):
        """Draw them."""
        rng = np.random.default_rng(seed)
        cup, package = replace(random_cup(rng), stretch=stretch), random_package(rng)
        self.model = model_tuple(cup, package, GRAVITY)
        self.numbers = complex_step.Numbers.of(cup, package, GRAVITY)
        T = random_pose(rng)
        self.tool = T[:3, 3], T[:3, :3], rng.standard_normal(6)
        T_tool_package = random_pose(rng, 0.3, 0.01)
        T_tool_package[2, 3] -= 0.1
        T = T @ T_tool_package
        self.body = T[:3, 3], T[:3, :3], rng.standard_normal(6)


def six_by_six(square):
    a, b, c, d = (np.reshape(block, (3, 3)) for block in square)
    return np.block([[a, b], [c, d]])


def near(actual, expected, part):
    """Compare two matrices, relative to the largest of the second."""
    assert_allclose(actual, expected, rtol=0, atol=part * np.abs(expected).max())


def test_some_of_the_parameters_stand_where_they_are_asked_for():
    case = Case(3)
    rows = case.model, state_of(*case.tool), state_of(*case.body)
    whole, part = np.zeros((6, PARAMETER_COLUMNS)), np.zeros((6, 20))
    parameter_jacobian(*rows, 0, PARAMETER_COLUMNS, whole)
    parameter_jacobian(*rows, 35, 50, part[:, 3:])
    assert_allclose(part[:, 3:18], whole[:, 35:50])
    assert not part[:, :3].any()
    assert not part[:, 18:].any()
