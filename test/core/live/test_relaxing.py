"""Cups that relax or have stretch: live, planned, steered and observed."""

from dataclasses import replace

from bellows_ros.core.geometry import lie
from bellows_ros.core.live import Predictor
from bellows_ros.core.model.cup_package import model_tuple
from bellows_ros.core.model.simulation import simulate
from bellows_ros.core.planning.plan_prediction import PlanSimulation
from bellows_ros.core.planning.steering import steer
import numpy as np
from numpy.testing import assert_allclose
import pytest

from ..tosses import GRIP
from ...cell.cup import CUP, PACKAGE
from ...cell.motion import Move

RUBBER = replace(CUP, relaxation=(0.2, 0.25))
STRETCHED = replace(CUP, stretch=(-2.5e4, -15.0))
SLIDE = Move([0.6, 0.0, 0.0], [0.0, 0.3, 0.0], 0.6)


def live(cup=RUBBER, **more):
    return Predictor(cup, PACKAGE, 9.81, **more)


def tilted(t, angle=0.3):
    """Return the pose of a tool that is tilted within 0.2 s from 0.1 s on."""
    s = np.clip((t - 0.1) / 0.2, 0.0, 1.0)
    angle *= s**3 * (10 - 15 * s + 6 * s * s)
    return lie.rotation_to_quaternion(lie.exp_so3(np.array([angle, 0.0, 0.0])))


def test_relaxation_and_stretch_are_set_while_running():
    predictor, still = live(CUP), ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0))
    for k, cup in enumerate((CUP, RUBBER, RUBBER, STRETCHED, CUP)):
        predictor.package.set_model(cup, PACKAGE)
        (found,) = predictor.on_pose(1 + k * 4_000_000, 'world', *still)
        assert len(found.strains) == 2 * any(cup.relaxation)
        assert_allclose(found.position[2], -0.0779, atol=2e-3)
    observer = predictor.package.observer
    predictor.package.set_model(RUBBER, PACKAGE)
    for k in range(5, 30):
        (found,) = predictor.on_pose(1 + k * 4_000_000, 'world', *still)
        predictor.on_measured(
            1 + k * 4_000_000, 'world', found.position, found.quaternion_xyzw)
    assert observer.counts['used'] > 10
    assert len(found.strains) == 2
    assert np.isfinite(predictor.covariance(found.stamp_ns)).all()
    assert predictor.package.has_covariance


@pytest.mark.parametrize('cup', [RUBBER, STRETCHED])
def test_observer_follows_its_cup_without_an_alarm(cup):
    """Poses of a cup whose relaxation or stretch is known are no sign of wear."""
    predictor, truth = live(cup), live(cup)
    rng = np.random.default_rng(0)
    for ms in range(0, 6000, 4):
        pose = (0.0, 0.0, 0.0), tuple(tilted(ms * 1e-3).tolist())
        (true,) = truth.on_pose(ms * 1_000_000 + 1, 'world', *pose)
        predictor.on_pose(ms * 1_000_000 + 1, 'world', *pose)
        if ms % 32 == 0:
            q = lie.rotation_to_quaternion(
                lie.quaternion_to_rotation(np.array(true.quaternion_xyzw))
                @ lie.exp_so3(2e-3 * rng.standard_normal(3)))
            predictor.on_measured(
                ms * 1_000_000 + 1, 'world',
                tuple((true.position + 3e-4 * rng.standard_normal(3)).tolist()), tuple(q.tolist()))
    assert predictor.package.observer.counts['used'] > 100
    assert predictor.alarms == []


@pytest.mark.parametrize('cup', [RUBBER, STRETCHED])
def test_a_plan_is_predicted_and_steered(cup):
    tool, model = SLIDE.plan(), model_tuple(cup, PACKAGE, 9.81)
    found = PlanSimulation(model, GRIP, tool).predict()
    expected = simulate(cup, PACKAGE, tool, gravity=9.81)
    assert_allclose(found.states[:, :3], expected.position, atol=1e-8)
    assert len(steer(model, tool, 'zvd').modes) >= 1
