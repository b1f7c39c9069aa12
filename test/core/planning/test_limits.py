"""What a motion asks of an arm against closed forms, and motions stretched into limits."""

from dataclasses import replace
import math

from bellows_ros.core.model.cup_package import model_tuple
from bellows_ros.core.planning.limits import demands, NO_LIMITS, RATES, stretched, TooFastError
from bellows_ros.core.planning.points import timed
from bellows_ros.core.planning.steering import steer
from bellows_ros.errors import BellowsError
import numpy as np
from numpy.testing import assert_allclose
import pytest

from ..plans import CUP, Move, PACKAGE

PLAN = Move([0.6, 0.0, 0.0], [0.0, 0.0, 0.9], 0.8).plan()


def test_demands_are_those_of_the_quintic():
    """15/8 D/T, 10/sqrt(3) D/T^2 and 60 D/T^3, the last one reached at the very ends."""
    found = demands(PLAN)
    for names, size in ((tuple(RATES)[:3], 0.6), (tuple(RATES)[3:], 0.9)):
        truth = (15 / 8 * size / 0.8, 10 / math.sqrt(3) * size / 0.8**2, 60 * size / 0.8**3)
        assert_allclose([found[name] for name in names[:2]], truth[:2], rtol=1e-3)
        assert_allclose(found[names[2]], truth[2], rtol=0.03)


def test_safety_and_workspace_count():
    limits = NO_LIMITS._replace(safety_factor=2.0)
    scale, reason = stretched(limits, lambda s: (timed(PLAN, s), 1.5 * s))
    assert reason == 'safety_factor'
    assert 4 / 3 <= scale < 1.02 * 4 / 3
    assert stretched(limits, lambda s: (PLAN, 3.0)) == (1.0, '')
    inside = NO_LIMITS._replace(low=np.full(3, -0.1), high=np.array([0.7, 0.1, 0.1]))
    assert stretched(inside, lambda s: (PLAN, 0.0)) == (1.0, '')
    inside.high[0] = 0.5
    with pytest.raises(BellowsError, match=r'\b20\b'):
        stretched(inside, lambda s: (PLAN, 0.0))


@pytest.mark.parametrize('power', [0.5, 1.0, 5.0])
def test_the_shortest_time_is_found_however_fast_the_demand_falls(power):
    """The acceleration of a motion that is 2 at first falls with a power of the time."""
    limits = NO_LIMITS._replace(rates={**NO_LIMITS.rates, 'speed': demands(PLAN)['speed'] / 2.0})

    def motion(scale):
        return timed(PLAN, scale ** power), math.inf

    assert_allclose(stretched(limits, motion)[0], 2.0 ** (1.0 / power), rtol=2e-3)


def test_what_is_possible_in_more_time_alone_is_sought_there():
    def motion(scale):
        if scale < 1.3:
            raise TooFastError('It bends.')
        return timed(PLAN, scale), math.inf

    scale, reason = stretched(NO_LIMITS, motion)
    assert reason == 'bending'
    assert_allclose(scale, 1.3, rtol=2e-3)
    with pytest.raises(TooFastError):
        stretched(NO_LIMITS, lambda _: motion(1.0))


def test_a_step_of_one_millisecond_counts():
    """Drives take set points at 1 kHz; between points 4 ms apart this jolt is four times less."""
    rows = PLAN.twist.copy()
    at = np.linspace(0.0, 0.8, len(PLAN))
    rows[:, 0] += 0.01 * np.exp(-((at - 0.4) / 7e-4) ** 2)
    jolted = replace(PLAN, twist=rows)
    assert demands(jolted)['acceleration'] > 1.5 * demands(PLAN)['acceleration']


@pytest.mark.parametrize(('name', 'limit'), [
    ('acceleration', 8.0), ('angular_acceleration', 60.0), ('angular_jerk', 2000.0)])
def test_an_inverse_within_limits_takes_the_shortest_time(name, limit):
    """Every shorter time, in steps of 2 %, exceeds the limit: also where demands are not even."""
    limits = NO_LIMITS._replace(rates={**NO_LIMITS.rates, name: limit})
    model = model_tuple(CUP, PACKAGE, 9.81)
    plan = Move([0.6, 0.2, 0.0], [0.0, 0.0, 0.3], 0.45).plan(200)

    def motion(scale):
        return steer(model, timed(plan, scale), 'inverse').tool, math.inf

    scale, reason = stretched(limits, motion)
    assert reason == name and demands(motion(scale)[0])[name] <= limit
    for shorter in np.arange(1.0, 0.99 * scale, 0.02):
        assert demands(motion(shorter)[0])[name] > limit
