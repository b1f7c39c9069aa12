"""The safety factor of the grip against the pressure on the ring, friction, and Coulomb."""

import math

from bellows_ros.core.findings import Level
from bellows_ros.core.model.grip import margin, safety_factors
from bellows_ros.core.parameters.conversion import grip_of
from bellows_ros.core.parameters.table import PARAMETERS
from bellows_ros.core.parameters.values import Values
import numpy as np
from numpy.testing import assert_allclose
import pytest

SUCTION, RADIUS, FRICTION = 60.0, 0.025, 0.5
GRIP = (SUCTION, RADIUS, FRICTION)
CASES = range(8)


def wrench(seed):
    """Return a force (N) and a moment (N m) of the size of those in a transport."""
    rng = np.random.default_rng(seed)
    return tuple(rng.normal(0, 12, 3).tolist()), tuple(rng.normal(0, 0.15, 3).tolist())


def ring(points, turn=0.0):
    """Return the (x, y) of points on the lip."""
    angle = turn + 2 * np.pi * np.arange(points) / points
    return RADIUS * np.cos(angle), RADIUS * np.sin(angle)


@pytest.mark.parametrize('seed', CASES)
def test_at_the_peel_factor_the_pressure_is_zero_at_one_point(seed):
    f, m = wrench(seed)
    s = safety_factors(GRIP, f, m)[0]
    if math.isinf(s):
        s = 1e3  # any load of this direction presses
    x, y = ring(64, math.atan2(-m[0], m[1]))  # the first point lies in the moment's plane
    # linear across the ring: p = (N + 2 (x m_y - y m_x) s / r^2) / 64 has this sum and moments
    p = ((SUCTION - s * f[2]) + 2 * s * (x * m[1] - y * m[0]) / RADIUS ** 2) / 64
    assert_allclose([p.sum(), (-y * p).sum(), (x * p).sum()],
                    [SUCTION - s * f[2], s * m[0], s * m[1]], atol=1e-9)
    assert p.min() >= -1e-9
    if s != 1e3:
        assert_allclose(p.min(), 0.0, atol=1e-9 * SUCTION)


@pytest.mark.parametrize('seed', CASES)
def test_at_the_slip_factor_friction_is_used_up(seed):
    f, m = wrench(seed)
    s = safety_factors(GRIP, f, m)[1]
    if math.isinf(s):
        pytest.skip('pressed so that it never slips')
    normal = SUCTION - s * f[2]
    q = s * math.hypot(f[0], f[1], m[2] / RADIUS)
    assert_allclose(q, FRICTION * normal, rtol=1e-12)


@pytest.mark.parametrize(('peeled', 'above'), [(0.0, 0.111), (0.5, 0.333)])
def test_slip_factor_exceeds_a_coulomb_ring_by_the_stated_amount(peeled, above):
    angle = np.arange(0.0, 2.0 * np.pi, 0.01)
    pressure, x, y = 1.0 + peeled * np.cos(angle), np.cos(angle), np.sin(angle)
    most = 0.0
    for radius in np.linspace(0.02, 3.0, 40):  # of the instant centre of the slip, in radii
        for turn in np.arange(0.0, 2.0 * np.pi, 0.2):
            vx, vy = -(y - radius * np.sin(turn)), x - radius * np.cos(turn)
            part = pressure / np.hypot(vx, vy)
            f = [np.mean(part * vx), np.mean(part * vy), 0.0]
            m = [0.0, 0.0, np.mean(part * (x * vy - y * vx))]
            _, slip = safety_factors((1.0, 1.0, 1.0), tuple(f), tuple(m))
            most = max(most, slip - 1.0)
    assert most == pytest.approx(above, abs=0.01)


def test_infinite_where_the_cup_is_pushed():
    pushed = (0.0, 0.0, -30.0)
    assert safety_factors(GRIP, pushed, (0.0, 0.0, 0.0)) == (math.inf, math.inf)
    assert safety_factors(GRIP, pushed, (0.5, 0.0, 0.0))[0] == SUCTION / 10.0
    assert safety_factors(GRIP, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)) == (math.inf, math.inf)


def test_the_grip_of_parameters():
    values = Values({name: p.default for name, p in PARAMETERS.items()})
    assert grip_of(values) is None
    values = values.replaced({'cup.lip_radius': 0.02})
    assert grip_of(values) is None
    assert_allclose(grip_of(values, 5e4), (5e4 * math.pi * 4e-4, 0.02, 0.5))
    assert grip_of(values, -100.0)[0] == 0.0  # heard, and above ambient
    values = values.replaced({'vacuum.holding': 6e4, 'cup.suction_area': 1e-3})
    assert_allclose(grip_of(values), (60.0, 0.02, 0.5))


def test_the_margin_is_the_smallest_factor_with_its_time():
    """As counted one by one, with a sample that is not known left out."""
    rows = np.array([[*safety_factors(GRIP, *wrench(k)), 0.0, 0.0] for k in range(50)])
    found = margin(GRIP, np.vstack([rows, np.full((1, 4), np.nan)]), 0.1 * np.arange(51))
    each = [(factor, mode, 0.1 * k) for k in range(50) for factor, mode in zip(
        safety_factors(GRIP, *wrench(k)), ('peel', 'slip'), strict=True)]
    assert tuple(found) == min(each)
    assert (found.finding.level == Level.OK) == (found.factor >= 1.0)
