"""Simulations of recordings against the rig's truth, equilibria, gravity, and clear errors."""

from bellows_ros.core.geometry.lie import log_so3, quaternion_to_rotation, transform
from bellows_ros.core.model import equilibrium
from bellows_ros.core.model.cup_package import Cup, model_tuple
from bellows_ros.core.model.simulation import simulate, state_row
from bellows_ros.core.parameters.conversion import gravity_of
from bellows_ros.core.recording.alignment import levelling
from bellows_ros.core.signals.trajectory import Trajectory
from bellows_ros.errors import BellowsError, UnstableError
import numpy as np
from numpy.testing import assert_allclose, assert_array_equal
import pytest

from .. import oracle
from ...cell.cup import PLATE
from ...cell.motion import still_tool

LEVEL = state_row((0, 0, 0), (0, 0, 0, 1), np.zeros(6))


def test_plate_under_a_level_tool_hangs_straight_and_lengthens_the_cup():
    cup = Cup.thesis()
    rest = equilibrium.static_equilibrium(model_tuple(cup, PLATE, 9.81), LEVEL)
    # axially the potential is 1/2 k z^2: the stretch is m g / k
    expected = -cup.length - 2.17 * 9.81 / 11530 - 0.03
    assert_allclose(rest[0], [0.0, 0.0, expected], atol=1e-12)
    assert_allclose(rest[1], [0.0, 0.0, 0.0, 1.0], atol=1e-12)


def test_equilibrium_of_a_tilted_tool_minimises_the_energy():
    from scipy.optimize import minimize
    tilt = np.deg2rad(60.0)
    tool = state_row((0, 0, 0), (np.sin(tilt / 2), 0, 0, np.cos(tilt / 2)), np.zeros(6))
    model = model_tuple(Cup.thesis(), PLATE, 9.81)
    rest = equilibrium.static_equilibrium(model, tool)

    def energy(x):
        body = equilibrium.displaced(rest, tuple(0.01 * x[:3]), tuple(0.1 * x[3:]))
        poses = [transform(quaternion_to_rotation(np.array(q)), np.array(o))
                 for o, q, _, _ in (tool, body)]
        return oracle.energies(
            Cup.thesis(), PLATE, np.array(model[2]), *poses, np.zeros(6)).sum()

    found = minimize(energy, np.full(6, 0.3), method='BFGS', options={'gtol': 1e-10})
    assert_allclose(found.x, 0.0, atol=2e-4)  # where differences of energies end


def test_a_cup_too_soft_for_its_package_has_no_equilibrium():
    soft = Cup(np.diag([10.0, 10.0, 10.0, 1e-3, 1e-3, 1e-3]), np.zeros((6, 6)), 0.05)
    tilted = state_row((0, 0, 0), (np.sin(0.7), 0, 0, np.cos(0.7)), np.zeros(6))
    with pytest.raises(UnstableError, match=r'2\.17 kg.*cup\.stiffness'):
        equilibrium.static_equilibrium(model_tuple(soft, PLATE, 9.81), tilted)


def test_a_tool_without_twists_is_refused():
    tool = Trajectory(np.arange(3), np.zeros((3, 3)), np.tile(np.eye(3), (3, 1, 1)))
    with pytest.raises(BellowsError):
        simulate(Cup.thesis(), PLATE, tool)


def test_a_simulation_that_diverges_is_refused():
    driven = Cup(Cup.thesis().stiffness, -50 * Cup.thesis().damping, 0.0481)
    start = state_row((0, 0, -0.08), (0, 0, 0, 1), np.full(6, 0.1))
    with pytest.raises(UnstableError, match=r'package\.mass.*cup\.damping'):
        simulate(driven, PLATE, still_tool(np.eye(4), 10 * 10**9, 1000), start)


def test_the_default_is_exact():
    values = {'gravity.magnitude': 9.81, 'gravity.direction': (0.0, 0.0, -1.0)}
    assert gravity_of(values).tolist() == [0.0, 0.0, -9.81]
    assert_array_equal(levelling((0.0, 0.0, -1.0)), np.eye(3))


@pytest.mark.parametrize('size', [1e-3, 1.0, 1e3])
def test_levelling_is_the_smallest_rotation_that_makes_a_direction_down(size):
    rng = np.random.default_rng(2)
    tilts = [*rng.normal(size=(50, 3)), *1e-9 * rng.normal(size=(20, 3))]
    for direction in [*tilts, *(np.array([0.0, 0.0, s]) + t for s in (1, -1) for t in tilts)]:
        R = levelling(size * direction)
        down = direction / np.linalg.norm(direction)
        assert_allclose(R @ down, [0.0, 0.0, -1.0], atol=1e-14)
        assert_allclose(R @ R.T, np.eye(3), atol=1e-14)
        angle = np.arctan2(np.linalg.norm(down[:2]), -down[2])
        assert_allclose(np.linalg.norm(log_so3(R)), angle, atol=1e-7)
