"""The valve from recordings of tosses: against what was drawn, and what it does without."""

from pathlib import Path

from bellows_ros.core.geometry.jit import COMPILED
from bellows_ros.errors import BellowsError
from bellows_ros.files.parameter_files import read_parameters
from bellows_ros.files.safe_yaml import load
from bellows_ros.workflows.release import identify_release, NO_GRIP, NO_VALVE
from bellows_ros.workflows.simulate import simulate_recording
import numpy as np
import pytest

BAGS = Path(__file__).parents[2] / 'bags'
VALUES = {
    **read_parameters(BAGS / 'tossing.yaml'), 'release.delay_std': 5e-4, 'release.tau_std': 0.0,
    'release.impulse': 0.05,
}

pytestmark = pytest.mark.skipif(
    not COMPILED, reason='twenty interpreted fits take too long; see numba')


def recorded_tosses(bag, count):
    """Record so many tosses at 360 Hz with 0.1 mm and 0.5 mrad; return what was drawn for them."""
    motion = load(BAGS / 'tosses.yaml')
    motion['waypoints']['repeat'] = count - 1
    motion['release']['times'] = motion['release']['times'][:count]
    return simulate_recording(VALUES, motion, bag).tosses


@pytest.fixture(scope='module')
def recorded(tmp_path_factory):
    """Give a recording of six tosses, and what was drawn for them."""
    bag = tmp_path_factory.mktemp('tosses') / 'bag'
    return bag, recorded_tosses(bag, 6)


@pytest.mark.stress
def test_twenty_tosses_tell_the_valve(tmp_path):
    """Delay to 0.5 ms, tau to 5 %, the scatter of the delay to 20 %."""
    drawn = recorded_tosses(tmp_path / 'bag', 20)
    found = identify_release({**VALUES, 'bags': [str(tmp_path / 'bag')]})
    fit, delays = found.fit, np.array([toss.delay for toss in drawn])
    assert len(found.tosses) == 20 and not found.warnings
    assert abs(fit.delay - 0.012) < 5e-4
    assert fit.tau == pytest.approx(0.015, rel=0.05)
    assert fit.delay_scatter == pytest.approx(np.std(delays, ddof=1), rel=0.2)
    off = [(toss.late - true.release_time + true.valve_time) / toss.late_std
           for (_, toss), true in zip(found.tosses, drawn, strict=True)]
    assert 0.6 < np.sqrt(np.mean(np.square(off))) < 1.5


def test_finds_the_valve_that_was_simulated(recorded):
    """Within its own standard errors, of each toss and of all of them."""
    bag, drawn = recorded
    found = identify_release({**VALUES, 'bags': [str(bag)]})
    fit = found.fit
    assert len(found.tosses) == 6 and not found.warnings
    assert fit.delay == pytest.approx(0.012, abs=min(3.0 * fit.delay_error, 1e-3))
    assert fit.tau == pytest.approx(0.015, abs=min(3.0 * fit.tau_error, 1.5e-3))
    assert fit.impulse == pytest.approx(0.05, abs=4.0 * fit.impulse_error)
    assert found.chi2 == pytest.approx(1.0, abs=0.1)
    late = [toss.release_time - toss.valve_time for toss in drawn]
    off = [(toss.late - true) / toss.late_std
           for (_, toss), true in zip(found.tosses, late, strict=True)]
    assert np.abs(off).max() < 4.0
    assert found.as_json()['units']['tau'] == 's'
    assert found.parameters()['release.delay_std'] == pytest.approx(
        np.hypot(fit.delay_scatter, fit.delay_error))


def test_says_what_is_not_identifiable(recorded):
    """Without a valve only the blow-off is found, without a grip no tau."""
    values = {**VALUES, 'bags': [str(recorded[0])]}
    blind = identify_release({**values, 'topics.valve': ''})
    assert NO_VALVE in blind.warnings
    assert set(blind.parameters()) == {'release.impulse', 'release.impulse_std'}
    assert blind.fit.impulse == pytest.approx(0.05, abs=4.0 * blind.fit.impulse_error)
    loose = identify_release({**values, 'vacuum.holding': 0.0})
    assert NO_GRIP in loose.warnings
    late = [toss.release_time - toss.valve_time for toss in recorded[1]]
    of_the_mean = np.sqrt(np.sum([toss.late_std ** 2 for _, toss in loose.tosses])) / 6
    assert loose.fit.delay == pytest.approx(np.mean(late), abs=4.0 * of_the_mean)


def test_a_recording_without_tosses_is_refused(tmp_path):
    """Say how many were found, and how many are needed."""
    motion = {**load(BAGS / 'throw.yaml'), 'package': {'rate_hz': 120.0}}
    simulate_recording(VALUES, motion, tmp_path / 'bag')
    with pytest.raises(BellowsError, match=r'\b3\b.*\b0\b'):
        identify_release({**VALUES, 'bags': [str(tmp_path / 'bag')]})
