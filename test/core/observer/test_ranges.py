"""Hostile standard deviations and poses: every state stays in its range, and work is bounded."""

from bellows_ros import BellowsError, LivePredictor
from bellows_ros.core.observer.dynamics import is_possible, stable_step
from bellows_ros.core.observer.states import LARGEST, STATES
import numpy as np
import pytest

from .cases import CUP, PACKAGE, SETTINGS

MASS = PACKAGE.mass
GIVEN = {
    **{name: SETTINGS[name] for name in ('package.mass', 'package.com', 'package.inertia')},
    'cup.stiffness': CUP.stiffness.ravel().tolist(), 'cup.damping': CUP.damping.ravel().tolist(),
    'cup.length': CUP.length}
SHARP = {'measured.noise': [1e-5, 1e-4]}
HOSTILE = [
    {'package.mass_std': 0.99 * MASS}, {'package.com_std': [0.16] * 3},
    {'package.inertia_std': [1e6] * 3 + [0.0] * 3},
    {'cup.stiffness_std': (100.0 * CUP.stiffness).ravel().tolist()},
    {'cup.damping_std': (100.0 * CUP.damping).ravel().tolist()},
    {'measured.camera_std': [1.0, 1.0], 'measured.marker_std': [1.0, 1.0]},
    {'measured.latency': [0.0, 0.5]},
]
ALL = {name: value for each in HOSTILE for name, value in each.items()}


def attacked(live, poses=80, shift=0.01):
    """See wild poses within the cup's reach, one every 32 ms; yield after each."""
    rng, still, upright = np.random.default_rng(0), (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0)
    for k in range(16 * poses):
        stamp_ns = 1_000_000_000 + 2_000_000 * k
        live.on_pose(stamp_ns, 'world', (0.0, 0.0, 0.5), upright)
        live.on_twist(stamp_ns, still, still)
        if k % 16 == 15 and live.latest:
            q = rng.normal(size=4) if k % 32 == 15 else np.array(live.latest.quaternion_xyzw)
            place = np.add(live.latest.position, shift * rng.normal(size=3))
            live.on_measured(stamp_ns - 10_000_000, 'world', tuple(place.tolist()),
                             tuple((q / np.linalg.norm(q)).tolist()))
            yield


@pytest.mark.parametrize('noise', [{}, SHARP])
@pytest.mark.parametrize('parameters', [*HOSTILE, ALL])
def test_no_state_leaves_its_range(parameters, noise):
    """Refuse the poses that would move it there, and go on."""
    live = LivePredictor.from_parameters({**GIVEN, **parameters, **noise})
    for _ in attacked(live):
        observer = live.package.observer
        largest = observer._correction.largest
        for estimate in observer._estimates:
            assert is_possible(estimate.body, estimate.theta, largest)
        assert observer.max_step >= observer._correction.max_step / 30.0
        assert np.isfinite(live.latest.position).all()
    assert sum(observer.counts[name] for name in ('outlier', 'out_of_reach', 'recovered')) > 0


def test_each_row_has_a_range():
    """Reject one that is left, and one that is not a number."""
    body = (0.0,) * 3, (0.0, 0.0, 0.0, 1.0), (0.0,) * 3, (0.0,) * 3
    for row in range(12, len(LARGEST)):
        for size in (1.01 * LARGEST[row], np.nan):
            theta = np.zeros(len(LARGEST) - 12)
            theta[row - 12] = size
            assert not is_possible(body, theta, LARGEST)
    assert is_possible(body, np.zeros(len(LARGEST) - 12), LARGEST)
    assert stable_step(1.0, np.full(len(LARGEST) - 12, 3.0)) > 0.0
    assert np.isfinite([each.largest for each in STATES[2:]]).all()


@pytest.mark.parametrize(('name', 'value'), [
    ('package.mass_std', 10_000.0), ('package.mass_std', 1.01 * MASS),
    ('package.com_std', [0.2, 0.0, 0.0])])
def test_deviation_beyond_its_range_is_refused(name, value):
    """Say which, how much is possible, and what to do; change nothing."""
    with pytest.raises(BellowsError, match=f'{name} is .*expected at most.*Weigh'):
        LivePredictor.from_parameters({**GIVEN, name: value})
    live = LivePredictor.from_parameters(GIVEN)
    before = live.values
    with pytest.raises(BellowsError, match=name):
        live.set_parameters({name: value})
    assert live.values is before
