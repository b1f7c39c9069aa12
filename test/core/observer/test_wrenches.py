"""A force-torque sensor in the observer: derivative, errors, loss and wrong set-ups."""

from bellows_ros.core.geometry import lie
from bellows_ros.core.model.equilibrium import moved_by
from bellows_ros.core.model.kernels import law_of, model_row
from bellows_ros.core.observer import states
from bellows_ros.core.observer.wrenches import block, CUP, SetUp
from bellows_ros.core.parameters.checks import resolve
from bellows_ros.core.sensors.set_up import Still
from bellows_ros.core.sensors.wrench import WrenchSensor
import numpy as np
from numpy.testing import assert_allclose
import pytest

from .cases import observer, PACKAGE, tool_motion, truth
from .wrench_run import predict, simulated, STEP_NS


def test_derivative_of_a_block_is_its_difference():
    """By the package's error at the begin of the block, com, K and P."""
    made, (stamps, tool) = observer(), tool_motion(np.random.default_rng(0), 0.6)
    body = truth(tool)
    made.start(int(stamps[0]), tool[0], body[0])
    for k in range(1, len(tool)):
        made.follow(int(stamps[k]), tool[k - 1], tool[k])
    first, last, model = 130, 145, made.model
    wrenches = stamps[first + 1:last + 1], np.zeros((last - first, 6))
    theta, mount = np.zeros(states.ROWS - states.STATE), made.wrenches.sensor.mount

    def mean(error):
        beginning = (int(stamps[first]), tool[first], moved_by(body[first], error[:12]),
                     theta + error[states.STATE:])
        return block(model_row(model), law_of(model), beginning, (
            *made._track.rows, made._track.count), wrenches, int(stamps[last]), 1e-3, mount)[:2]

    H, rows = mean(np.zeros(states.ROWS))[1], np.eye(states.ROWS)
    for row in (*range(12), *range(states.COM, states.COM + 3),
                states.STIFFNESS, states.STIFFNESS + 4, states.DAMPING + 2):
        difference = (mean(1e-6 * rows[row])[0] - mean(-1e-6 * rows[row])[0]) / 2e-6
        assert_allclose(H[:, row], difference, atol=0.12 * np.abs(difference).max() + 1e-3)


def test_wrench_alone_finds_mass_and_place_and_helps_a_camera():
    run, mass = simulated(1, 'ATI', True, 4.0), []

    def note(k, live, reading):
        mass[:] = live.payload.mass - run.mass, live.payload.mass_std
        if live.package.observer and (estimate := live.package.observer.estimate):
            assert not estimate.theta[CUP - states.STATE].any()
        return reading

    first = round(0.1e9 / STEP_NS)
    alone, fused, camera = (np.sqrt(np.mean(predict(run, 1, *use)[1][first:] ** 2)) for use in (
        (False, True, note), (True, True), (True, False)))
    assert alone < 4e-3 and fused < camera
    assert abs(mass[0]) < min(0.02 * run.mass, 2.0 * mass[1])


@pytest.mark.parametrize('offset', [4.1, -4.1])
def test_offset_of_a_data_sheet_is_no_mass(offset):
    """Of 4 N along gravity, which motion alone distinguishes from 0.4 kg."""
    run = simulated(0, 'UR', True, 3.2)
    found = predict(run, 0, before=lambda k, live, reading: reading + [
        0.0, 0.0, offset, 0.0, 0.0, 0.0])[0].payload
    assert abs(found.mass - run.mass) < 2.0 * found.mass_std < 0.1 * run.mass


def test_loss_is_told():
    """Within 20 ms, with the delay of the sensor, and nothing before."""
    run = simulated(2, 'ATI', True, 3.3, 'lost', 3.0)
    alarm, *_ = predict(run, 2)[0].alarms
    delay = (alarm.stamp_ns - int(run.stamps[0])) * 1e-9 - 3.0 + run.parameters['wrench.delay']
    assert (alarm.kind, alarm.shown_by, 0.0 < delay < 0.02) == ('lost', 'wrench', True)


@pytest.mark.parametrize('camera', [False, True])
def test_sensor_of_the_other_sign_is_not_used(camera):
    """Check the set-up in motion, too: from 1 s on, when the tool moves."""
    run = simulated(0, 'UR', True, 2.5)
    live, errors = predict(run, 0, camera, before=lambda k, live, reading: (
        -reading if k * STEP_NS > 1e9 else np.nan * reading))
    assert live.wrench_fault
    without = predict(run, 0, camera, False)[1]
    assert_allclose(errors[800:], without[800:], atol=1e-3)


@pytest.mark.parametrize('size', [1e3, 9.9e5])
def test_wrenches_of_any_size_leave_finite_numbers(size):
    """Of payload, poses and alarms, up to the bound of all messages."""
    run, rng = simulated(0, 'UR', True, 1.2), np.random.default_rng(0)
    with np.errstate(all='raise', under='ignore'):
        live, errors = predict(run, 0, before=lambda k, live, reading: (
            reading + size * rng.normal(size=6) * (k % 50 == 0)))
    assert np.isfinite(errors).all() and np.isfinite([live.payload.mass, *live.payload.com]).all()
    assert np.isfinite([live.payload.mass_std, *live.payload.com_std]).all()
    assert all(np.isfinite([*each.shift, *each.rotation, *each.value, *each.std]).all()
               for each in live.alarms)


@pytest.mark.parametrize('more', [
    {'package.com': [0.0, 0.0, -0.2], 'package.mass_std': 0.18, 'package.com_std': [-1.0] * 3},
    {'cup.layout': [0.0, 0.0, 1.0]}])
def test_wrenches_that_contradict_the_parameters_are_refused(more):
    """Predict on, whatever the package or the gripper is said to be."""
    run = simulated(0, 'UR', True, 1.4)
    live, errors = predict(run._replace(parameters={**run.parameters, **more}), 0)
    assert np.isfinite(errors).all() and np.isfinite(live.payload.mass)


def test_time_that_goes_back_restarts_the_wrenches():
    """As a recording that is played in a loop: a reset forgets their stamps."""
    made, wrench = observer(), ((0.0, 0.0, -10.0), (0.0, 0.0, 0.0))
    assert [made.wrenches.add(stamp, wrench) > 0 for stamp in (10**12, 10**9)] == [True, False]
    made.forget()
    assert made.wrenches.add(10**9, wrench)


SENSOR = WrenchSensor.of(resolve({'wrench.frame': '0 0 0.12 0 0 0 1'}))
WEIGHT = 9.81 * PACKAGE.mass
TURNED = {'axes': np.diag([1.0, -1.0, -1.0]), 'swapped': np.eye(3)[[1, 2, 0]]}
UNITS = {'kgf': np.full(6, 1.0 / 9.80665), 'newton_mm': np.repeat([1.0, 1e3], 3)}
SET_UPS = (None, 'sign', 'world_axes', 'base', 'tcp', 'zeroed_holding', 'compensated', 'unknown',
           *TURNED, *UNITS)


def shown_by(set_up, rng):
    """Return the check after readings in two tilts, with errors of package, gains and zero."""
    check, tilt = SetUp(SENSOR), lie.exp_so3(rng.uniform(0.2, 0.5) * np.array([
        np.cos(angle := rng.uniform(0.0, 6.3)), np.sin(angle), 0.0]))
    mass, com = 1.0 + 0.07 * rng.normal(), np.r_[7e-3 * rng.normal(size=2), 3e-3 * rng.normal()]
    zero, gain = np.repeat([0.3, 0.02], 3) * rng.normal(size=6), 1.0 + 0.01 * rng.normal(size=6)
    for stamp_ns, R in enumerate((*[np.eye(3)] * 8, *[tilt @ lie.exp_so3(
            [0.0, 0.0, rng.uniform(-1.5, 1.5)])] * 4)):
        force = R.T @ [0.0, 0.0, -WEIGHT]
        load, true = (np.r_[f, np.cross(arm, f)] for f, arm in (
            (force, [0.0, 0.0, -0.196]), (mass * force, com - [0.0, 0.0, 0.196])))
        shown = {
            'sign': -true, 'world_axes': np.r_[R @ true[:3], R @ true[3:]],
            'base': np.r_[R @ true[:3], R @ true[3:]] * [-1.0, -1.0, 1.0, -1.0, -1.0, 1.0],
            'tcp': true + np.r_[np.zeros(3), np.cross([0.0, 0.0, 0.12], true[:3])],
            'zeroed_holding': true - np.r_[0.0, 0.0, -mass * WEIGHT, np.zeros(3)],
            'compensated': np.zeros(6), 'unknown': true * [1.0, 1.0, 3.0, 1.0, 1.0, 1.0],
            **{turned: np.r_[Q @ true[:3], Q @ true[3:]] for turned, Q in TURNED.items()},
        }.get(set_up, true)
        noise = np.repeat([0.04, 2e-3], 3) * rng.normal(size=6)
        check.add(stamp_ns, Still(
            UNITS.get(set_up, 1.0) * (gain * shown + zero + noise), load, R), WEIGHT)
    return check


@pytest.mark.parametrize('set_up', SET_UPS)
def test_wrong_set_up_is_named(set_up):
    """Of 100 cells in two tilts: a sound sensor never, a wrong one in 95 %, and no other."""
    found = [shown_by(set_up, np.random.default_rng([seed, 5])) for seed in range(100)]
    named = [check.fault and check.fault.name for check in found]
    cause = {'base': 'world_axes', 'swapped': 'axes'}.get(set_up, set_up)
    assert {*named} <= {None, cause, 'unknown'} and named.count(cause) >= 95
    if set_up in TURNED:
        q = np.array([float(part) for part in found[0].fault.rotation.split()])
        assert_allclose(lie.quaternion_to_rotation(q).T, TURNED[set_up], atol=1e-12)
