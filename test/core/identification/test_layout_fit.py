"""One cup's numbers from a gripper's motion, simulated as the sum over its cups."""

import functools

from bellows_ros.core.geometry.lie import adjoint, exp_so3, hat, inverse_transform, transform
from bellows_ros.core.identification.least_squares import least_squares
from bellows_ros.core.identification.output_error import output_error
from bellows_ros.core.identification.reduction import statistics
from bellows_ros.core.identification.samples import samples_of
from bellows_ros.core.identification.search import MeasuredSegment
from bellows_ros.core.model.cup_package import Cup
from bellows_ros.core.model.structure import (
    composition,
    given_structure,
    STRUCTURES,
)
from bellows_ros.core.recording.preparation import prepare
from bellows_ros.core.recording.recording import BodyNoise, PrepareSettings
from bellows_ros.core.signals.trajectory import PoseStream, Trajectory
from bellows_ros.errors import BellowsError
import numpy as np
from numpy.testing import assert_allclose
import pytest

from .recordings import GRAVITY, PLATE, Shake
from .. import oracle
from ..motions import noisy

ONE = Cup(np.diag([900.0, 900.0, 1500.0, 1.2, 1.2, 0.5]),
          np.diag([12.0, 12.0, 9.0, 0.02, 0.02, 0.02]), 0.0481)
PLACES = np.array([[0.06, 0.05, 0.0], [-0.06, 0.03, 0.0], [0.01, -0.07, 0.0]])
LAYOUT = given_structure({
    'fit.structure': 'layout', 'cup.layout': tuple(PLACES.ravel())})
NUMBERS = LAYOUT.parameters(ONE.stiffness, ONE.damping)
HZ, DURATION = 1000.0, 6.0


def cups_wrench(T_E_S, v_ES):
    """Return the wrench of all cups at S, by (3.18), (3.27), (3.33) and (3.35) of each."""
    R, half = T_E_S[:3, :3], 0.5 * ONE.length * oracle.Z
    o = half + R @ half + T_E_S[:3, 3] + PLACES @ (R - np.eye(3)).T
    h = np.hstack([o @ (np.eye(3) + R), np.tile(oracle.vee(R - R.T), (len(o), 1))])
    q = h * np.diag(ONE.stiffness)
    f = -0.25 * q[:, :3] @ (R + np.eye(3))
    m = -0.25 * (np.cross(q[:, :3], o @ R) + q[:, 3:] @ (np.trace(R) * np.eye(3) - R.T))
    w = np.tile(v_ES[3:], (len(o), 1))
    v = v_ES[:3] + np.cross(w, PLACES + half)
    damping = np.diag(ONE.damping)
    there = np.hstack([v @ R.T + np.cross(o, w @ R.T), w @ R.T]) * damping
    f -= 0.5 * (v * damping[:3] + there[:, :3] @ R)
    m -= 0.5 * (w * damping[3:] + (np.cross(there[:, :3], o) + there[:, 3:]) @ R)
    return np.concatenate([f.sum(axis=0), (m + np.cross(PLACES + half, f)).sum(axis=0)])


def slope(tool, y):
    """Return the rate of the package's state, each cup pulling at its own lip."""
    T, v, (T_E, v_E) = transform(y[3:12].reshape(3, 3), y[:3]), y[12:], tool
    T_E_S = oracle.lip_pose(PLATE, T_E, T)
    X = adjoint(transform(np.eye(3), PLATE.com))
    f = X.T @ cups_wrench(T_E_S, X @ v - adjoint(inverse_transform(T_E_S)) @ v_E)
    w = v[3:]
    force = f[:3] / PLATE.mass - GRAVITY * T[2, :3] - np.cross(w, v[:3])
    moment = f[3:] - np.cross(w, PLATE.inertia @ w)
    return np.concatenate([T[:3, :3] @ v[:3], (T[:3, :3] @ hat(w)).ravel(), force,
                           np.linalg.solve(PLATE.inertia, moment)])


@functools.cache
def truth():
    """Return tool and package at half the rate: Runge-Kutta steps over two samples of the tool."""
    tool = Shake(3).trajectory(DURATION, HZ)
    at = [(transform(R, o), v)
          for R, o, v in zip(tool.rotation, tool.position, tool.twist, strict=True)]
    y = np.concatenate([tool.position[0] + tool.rotation[0] @ (PLATE.com - [0, 0, ONE.length]),
                        tool.rotation[0].ravel(), np.zeros(6)])
    rows, h = [y], 2.0 / HZ
    for k in range(0, len(at) - 2, 2):
        a = slope(at[k], y)
        b = slope(at[k + 1], y + 0.5 * h * a)
        c = slope(at[k + 1], y + 0.5 * h * b)
        d = slope(at[k + 2], y + h * c)
        y = y + h / 6.0 * (a + 2.0 * b + 2.0 * c + d)
        U, _, Vt = np.linalg.svd(y[3:12].reshape(3, 3))
        y[3:12] = (U @ Vt).ravel()
        rows.append(y)
    rows = np.array(rows)[250:]  # the first swing has gone
    tool = tool.select(slice(500, 500 + 2 * len(rows), 2))
    return Trajectory(tool.stamps_ns, tool.position, tool.rotation), Trajectory(
        tool.stamps_ns, rows[:, :3], rows[:, 3:12].reshape(-1, 3, 3))


def by_output_error(package_noise):
    """Return the fit to a robot's poses and a camera's of 62.5 Hz, from a start far off."""
    rng, tool_noise = np.random.default_rng(1), (2e-5, 5e-5)
    tool, package = (noisy(rng, body, noise) for body, noise in zip(
        truth(), (tool_noise, package_noise), strict=True))
    return output_error(
        [MeasuredSegment(tool, package.select(slice(0, None, 8)), PLATE, GRAVITY,
                         *(BodyNoise(np.repeat(std, 3)) for std in (tool_noise, package_noise)))],
        LAYOUT, Cup(2.0 * ONE.stiffness, 0.6 * ONE.damping, ONE.length))


def test_the_wrench_of_this_simulation_is_the_sum_of_the_oracles():
    rng = np.random.default_rng(0)
    R, o, v = exp_so3(rng.normal(size=3) * 0.3), rng.normal(size=3) * 0.01, rng.normal(size=6)
    f = np.zeros(6)
    for a in PLACES:
        own = oracle.wrench_at_lip(
            ONE, transform(R, o + R @ a - a), v + np.append(np.cross(v[3:], a), np.zeros(3)))
        f += np.append(own[:3], own[3:] + np.cross(a, own[:3]))
    assert_allclose(cups_wrench(transform(R, o), v), f, rtol=1e-10)


def test_one_cup_is_found_by_output_error_with_honest_errors():
    fit = by_output_error((1e-4, 5e-4))
    std = np.sqrt(np.diag(fit.covariance))
    assert fit.converged and not fit.notes
    assert np.all(np.abs(fit.parameters - NUMBERS) < 4.0 * std)
    assert np.all(std < np.array([0.01, 0.005, 0.02, 0.1, 0.02, 0.1, 0.1, 0.1]) * NUMBERS)
    assert fit.labels == STRUCTURES['axisymmetric'].labels
    assert_allclose(fit.stiffness, np.diag(np.diag(fit.stiffness)))  # that of one cup


def test_what_the_other_cups_hide_is_named():
    fit = by_output_error((2e-3, 1e-2))
    std = np.sqrt(np.diag(fit.covariance))
    known = dict(zip(fit.labels, np.isfinite(std), strict=True))
    assert known['K x'] and known['K z'] and known['K rx'] and known['P x']
    assert not known['K rz'] and not known['P rz']
    assert all(any(note.startswith(f'{label} is not') and 'one cup alone' in note
                   for note in fit.notes) for label in ('K rz', 'P rz'))
    seen = np.isfinite(std)
    assert np.all(np.abs(fit.parameters - NUMBERS)[seen] < 4.0 * std[seen])


@pytest.mark.parametrize(('noise', 'within'), [(0.0, 1e-5), (1.0, 0.1)])
def test_one_cup_is_found_by_least_squares(noise, within):
    rng = np.random.default_rng(2)
    streams = [PoseStream(name, 'world', body.stamps_ns, body.position, body.rotation)
               for name, body in zip(('tool', 'package'), (
                   noisy(rng, own, (2e-5 * noise, 1e-4 * noise)) for own in truth()), strict=True)]
    recording = prepare(*streams, PrepareSettings(
        payload=PLATE, gravity=GRAVITY, tool_half_window=12, package_half_window=12))
    fit = least_squares([
        statistics(samples_of(recording), ONE.length, LAYOUT, recording.noise)])
    assert_allclose(fit.parameters, NUMBERS, rtol=within)


def test_a_structure_of_cups_is_their_composition():
    """Within the full 6x6, as the covariance of a composed cup has it."""
    x = np.random.default_rng(3).uniform(0.5, 2.0, 8)
    of_one = STRUCTURES['axisymmetric'].upper @ x
    both = np.kron(np.eye(2), composition(np.array(LAYOUT.places)))
    assert_allclose(STRUCTURES['full'].upper @ LAYOUT.within(STRUCTURES['full']) @ x,
                    both @ of_one, atol=1e-12)
    assert STRUCTURES['full'].contains(LAYOUT)
    assert not STRUCTURES['diagonal'].contains(LAYOUT)


@pytest.mark.parametrize('layout', [(0.0, 0.0, 0.0), (0.05, 0.0), (0.05, 0.0, 0.0) * 2])
def test_a_layout_of_one_cup_or_none_is_refused(layout):
    with pytest.raises(BellowsError, match=r'cup\.layout'):
        given_structure({'fit.structure': 'layout', 'cup.layout': layout})
