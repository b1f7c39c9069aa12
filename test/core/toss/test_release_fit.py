"""Delay, tau and scatter of a valve from simulated tosses, as a motion capture sees them."""

from bellows_ros.core.geometry.jit import COMPILED
from bellows_ros.core.geometry.lie import exp_so3, quaternion_to_rotation
from bellows_ros.core.model.cup_package import model_tuple
from bellows_ros.core.model.simulation import state_row
from bellows_ros.core.signals.trajectory import Trajectory
from bellows_ros.core.toss.release import flight, Held, NO_FLIGHT, pushed_off, STRIDE
from bellows_ros.core.toss.release_fit import letting_go, LettingGo, valve_fit
from bellows_ros.errors import BellowsError
import numpy as np
import pytest

from .. import tosses

MODEL = model_tuple(tosses.CUP, tosses.PACKAGE, 9.81)
NOISE = (1e-4, 5e-4)
DELAY, TAU, SCATTER, IMPULSE = 0.012, 0.02, 5e-4, 0.05


def held_at(held, time):
    """Return the state of the held package at a sample of the plan."""
    return state_row(*np.split(held.states[np.searchsorted(held.times, time - 1e-9)], [3, 7]))


def tossed(held, plan, rng, switched, delay):
    """Return tool and package, 0.15 s before the valve to 0.25 s after, and the state there."""
    time, body = held.let_go(NO_FLIGHT._replace(valve=(delay, TAU)), switched)[:2]
    body = pushed_off(MODEL[1], body, IMPULSE)
    t = plan.seconds
    part = plan.select((t >= switched - 0.15) & (t <= switched + 0.3))
    position, rotation = [], []
    for s in part.seconds + (part.stamps_ns[0] - plan.stamps_ns[0]) * 1e-9:
        state = held_at(held, s) if s <= time else (
            flight(MODEL[1], MODEL[2], body, s - time, STRIDE))
        position.append(np.array(state[0]) + NOISE[0] * rng.standard_normal(3))
        rotation.append(quaternion_to_rotation(np.array(state[1])) @ exp_so3(
            NOISE[1] * rng.standard_normal(3)))
    first = held_at(held, part.stamps_ns[0] * 1e-9)
    package = Trajectory(part.stamps_ns, np.array(position), np.array(rotation))
    return part, package, first, switched - part.stamps_ns[0] * 1e-9


def test_finds_the_valve_in_twenty_noisy_tosses():
    """Delay to 0.5 ms, tau to 5 %, the scatter of the delay to 20 %; 360 Hz."""
    if not COMPILED:
        pytest.skip('twenty interpreted fits take too long; see numba')
    rng = np.random.default_rng(5)
    plan = tosses.plan(360)
    held = Held(MODEL, tosses.GRIP, plan)
    delays, found = [], []
    for switched in np.linspace(0.25, 0.68, 20):
        delays.append(DELAY + SCATTER * rng.standard_normal())
        tool, package, start, valve = tossed(held, plan, rng, switched, delays[-1])
        about = valve + 0.03
        found.append(letting_go(MODEL, tosses.GRIP, tool, package, start, valve, about, NOISE))
    fit = valve_fit(found, tosses.GRIP[0])
    assert np.mean([t.chi2 for t in found]) == pytest.approx(1.0, abs=0.1)
    assert abs(fit.delay - DELAY) < 5e-4
    assert fit.tau == pytest.approx(TAU, rel=0.05)
    assert fit.delay_scatter == pytest.approx(np.std(delays, ddof=1), rel=0.2)
    assert fit.impulse == pytest.approx(IMPULSE, abs=4.0 * fit.impulse_error)


def test_refuses_too_few_tosses_and_equal_loads():
    """Each with its own message."""
    one = LettingGo(0.02, 1e-5, 40.0, 0.0, 1e-3, 2.0, 1.0)
    with pytest.raises(BellowsError, match=r'\b3\b.*\b1\b'):
        valve_fit([one], 90.0)
    with pytest.raises(BellowsError):
        valve_fit([one] * 5, 90.0)
