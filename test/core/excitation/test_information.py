"""The information of a motion, against the scatter of estimates."""

from bellows_ros.core.excitation import motion_design
from bellows_ros.core.excitation.motion_design import Tracking
from bellows_ros.core.identification.problem import Problem
from bellows_ros.core.identification.search import evaluated, measured_courses, settled
from bellows_ros.core.identification.segments import MeasuredSegment, Segment
from bellows_ros.core.model.cup_package import Cup, model_tuple, Package
from bellows_ros.core.model.simulation import simulate
from bellows_ros.core.model.structure import STRUCTURES
from bellows_ros.core.recording.recording import BodyNoise, Noise
from bellows_ros.core.synthetic.motion import Oscillation, Pose
import numpy as np
import pytest

from ..motions import noisy

STRUCTURE = STRUCTURES['axisymmetric']
TRUTH = np.array([5400.0, 9200.0, 4.2, 1.35, 55.0, 24.0, 0.06, 0.1])
PACKAGE = Package(1.8, np.diag([0.00438, 0.00654, 0.00984]), np.array([0.0, 0.0, -0.03]))
TRACKING = Tracking(1 / 500, Noise(2e-5, 5e-5), 1 / 360, Noise(1e-4, 5e-4))
LINES = np.array([(0, 0.02, 1.1), (1, 0.02, 1.3), (2, 0.01, 3.1), (2, 0.003, 6.0),
                  (3, 0.1, 1.7), (4, 0.1, 2.3), (5, 0.2, 1.5), (5, 0.1, 2.9)])


def cup_of(x):
    return Cup(*STRUCTURE.matrices(x), 0.046)


def model_of(x):
    return model_tuple(cup_of(x), PACKAGE, 9.81)


def motion(duration):
    n, frequency = len(LINES), np.repeat(LINES[:, 2:], 2, axis=1)
    phase = np.random.default_rng(5).uniform(0.0, 6.0, n)
    return Oscillation(Pose(np.zeros(3), np.eye(3)), 0.5, 0.5, duration, LINES[:, 1],
                       LINES[:, 0].astype(int), frequency, phase)


def stamps(rate_hz, duration, first=0.0):
    count = int(duration * rate_hz)
    return 10**9 + np.round((first + np.arange(count) / rate_hz) * 1e9).astype(np.int64)


def expected(tool):
    return motion_design.standard_errors(
        motion_design.motion_information(cup_of(TRUTH), PACKAGE, 9.81, tool, TRACKING, STRUCTURE))


def estimates(mover, duration, draws):
    """Yield errors of estimates over their expected standard errors, one row per recording."""
    rng = np.random.default_rng(11)
    tool = mover.trajectory(stamps(500.0, duration), 10**9)
    at = mover.trajectory(stamps(360.0, duration - 0.2, 0.1), 10**9)
    usual, cup = expected(at), cup_of(TRUTH)
    body = simulate(cup, PACKAGE, at)
    for _ in range(draws):
        measured = MeasuredSegment(
            noisy(rng, tool, TRACKING.tool), noisy(rng, body, TRACKING.package), PACKAGE, 9.81,
            *(BodyNoise(np.repeat(noise, 3)) for noise in (TRACKING.tool, TRACKING.package)))
        problem = Problem.of([Segment.of(measured)], STRUCTURE, cup, {})
        found = settled(evaluated(problem, problem.start, measured_courses(problem)))
        yield (problem.units * (found.theta - problem.start)) / usual


@pytest.mark.parametrize('draws, within', [
    (25, 0.15), pytest.param(100, 0.1, marks=pytest.mark.stress)])
def test_estimates_scatter_as_expected(draws, within):
    """Estimates from the truth on, of recordings with noise on both bodies."""
    scatter = np.array(list(estimates(motion(4.0), 4.0, draws)))
    # of 8 parameters together a root mean square of 25 draws is known to 5 %, of 100 to 2.5 %
    assert abs(np.sqrt(np.mean(scatter**2)) - 1.0) < within


def test_without_information_there_is_no_standard_error():
    assert motion_design.standard_errors(np.diag([1.0, 0.0])).tolist() == [1.0, np.inf]
