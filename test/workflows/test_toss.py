"""The valve from recordings of tosses: against what was drawn, and what it does without."""

from pathlib import Path

from bellows_ros.core.geometry.jit import COMPILED
from bellows_ros.core.parameters.checks import resolve
from bellows_ros.core.parameters.values import Values
from bellows_ros.core.toss.landing import coverage, SECOND_ORDER
from bellows_ros.errors import NoTopicError
from bellows_ros.files.parameter_files import read_parameters
from bellows_ros.files.safe_yaml import load
from bellows_ros.workflows.simulate import simulate_recording
from bellows_ros.workflows.toss import identify_release, toss_plan
import numpy as np
import pytest

BAGS = Path(__file__).parents[2] / 'bags'
VALUES = Values({
    **read_parameters(BAGS / 'tossing.yaml'), 'release.delay': 0.012, 'release.delay_std': 5e-4,
    'release.tau': 0.015, 'release.impulse': 0.05, 'release.impulse_std': 0.005,
    'release.blow_off': 0.0, 'release.opening': 0.0, 'release.sticking': 0.0,
})

pytestmark = pytest.mark.skipif(
    not COMPILED, reason='twenty interpreted fits take too long; see numba')


def simulated(values, count, bag):
    """Record so many tosses at 360 Hz with 0.1 mm and 0.5 mrad; return what was drawn for them."""
    motion = load(BAGS / 'tosses.yaml')
    motion['waypoints']['repeat'] = count - 1
    motion['release']['times'] = motion['release']['times'][:count]
    return simulate_recording(values, motion, bag).tosses


@pytest.fixture(scope='module')
def recorded(tmp_path_factory):
    """Give a recording of six tosses, and how long after the valve each was let go."""
    bag = tmp_path_factory.mktemp('tosses') / 'bag'
    return bag, [toss.release_time - toss.valve_time for toss in simulated(VALUES, 6, bag)]


def test_finds_the_valve_that_was_simulated(recorded):
    """Within its own standard errors; the numbers of a cup that opens are not needed."""
    bag, late = recorded
    found = identify_release(VALUES.replaced({'bags': [str(bag)]}))
    fit = found.fit
    assert len(fit.drops) == 6 and not found.warnings
    assert fit.free == (0, 1, 2)
    assert fit.law[0] == pytest.approx(0.012, abs=max(3.0 * fit.std[0], 1e-3))
    assert fit.law[1] == pytest.approx(0.015, abs=max(3.0 * fit.std[1], 1.5e-3))
    assert fit.law[2] == pytest.approx(0.05, abs=0.01)
    assert fit.chi2 == pytest.approx(1.0, abs=0.1)
    np.testing.assert_allclose([drop.released for drop in fit.drops], late, atol=1.5e-3)
    content = found.parameters()
    assert content['release.delay_std'] == pytest.approx(np.hypot(fit.std[0], fit.scatter[0]))
    assert content['release.mass_range'] == (1.8, 1.8)
    assert resolve(VALUES.replaced(content))


def test_says_first_that_no_valve_was_recorded_and_needs_no_grip(recorded):
    """Without a topic it is refused; without a grip tau is not identifiable."""
    values = VALUES.replaced({'bags': [str(recorded[0])]})
    with pytest.raises(NoTopicError, match='topics.valve'):
        identify_release(values.replaced({'topics.valve': '/another'}))
    loose = identify_release(values.replaced({'vacuum.holding': 0.0}))
    assert loose.fit.free == (0, 2)
    assert loose.fit.law[0] == pytest.approx(np.mean(recorded[1]), abs=3e-3)


def test_the_ellipse_holds_what_the_law_does_to_second_order():
    """Of 300 tosses with the law of 53 drops; the first derivatives alone hold 86 %."""
    values = read_parameters(BAGS / 'tossing.yaml')
    result = toss_plan(BAGS / 'throw.yaml', values, 2.95, monte_carlo=300)
    made, errors = result.parts, result.drawn.errors
    first = made._replace(parts=made.parts * (np.array(made.names) != SECOND_ORDER)[:, None])
    assert coverage(first.covariance, errors) < 0.9 < 0.92 < coverage(made.covariance, errors)
    assert made.parts[-1, 0] == pytest.approx(errors[:, 0].mean(), abs=2e-3)  # 4 standard errors
