"""Compilation of all entries ahead of the tests, in as many processes as cores."""

from collections.abc import Callable, Iterable
from concurrent.futures import as_completed, ProcessPoolExecutor
from dataclasses import replace
from multiprocessing import get_context

from bellows_ros.core import live, usable_cores
from bellows_ros.core.identification import residuals
from bellows_ros.core.identification.segments import Segment
from bellows_ros.core.identification.unknowns import Problem
from bellows_ros.core.live import landing
from bellows_ros.core.model.cup_package import Cup, model_tuple, Package
from bellows_ros.core.model.simulation import simulate
from bellows_ros.core.model.structure import STRUCTURES
from bellows_ros.core.observer.observer import warm_up_observer
from bellows_ros.core.parameters.checks import resolve
from bellows_ros.core.parameters.values import Values
from bellows_ros.core.planning.plan_prediction import PlanSimulation
from bellows_ros.core.planning.steering import steer
from bellows_ros.core.recording.recording import BodyNoise
from bellows_ros.core.signals.trajectory import Trajectory
import numpy as np

GRAVITY = 9.81
PACKAGE = Package(1.0, 0.01 * np.eye(3), np.array([0.0, 0.0, -0.03]))
RELAXING = 0.2, 0.2
"""Relaxation of a cup whose entries have more arguments."""


def warm_up(
    parts: Iterable[str], relaxations: Iterable[tuple[float, float]],
    progress: Callable[[str, float], None] = lambda stage, fraction: None,
) -> None:
    """Compile the entries of some of `PARTS` for cups with some relaxations."""
    tasks = [(part, relaxation) for part in parts for relaxation in relaxations]
    progress('Machine code', 0.0)
    with ProcessPoolExecutor(usable_cores(), get_context('spawn')) as pool:
        running = [pool.submit(compile_part, *task) for task in tasks]
        for done, future in enumerate(as_completed(running)):
            future.result()
            progress('Machine code', (done + 1) / len(tasks))


def compile_part(part: str, relaxation: tuple[float, float] = (0.0, 0.0)) -> None:
    """Compile a part for a cup with a relaxation."""
    PARTS[part](replace(Cup.thesis(), relaxation=relaxation))


def _values(cup: Cup) -> Values:
    """Return parameters of a package that may be dropped."""
    return resolve({
        'cup.stiffness': cup.stiffness.ravel().tolist(),
        'cup.damping': cup.damping.ravel().tolist(), 'cup.length': cup.length,
        'package.mass': 1.0, 'package.com': [0.0, 0.0, -0.03],
        'package.inertia': [0.01, 0.01, 0.01, 0.0, 0.0, 0.0], 'package.size': [0.1, 0.1, 0.1],
        'vacuum.holding': 6e4, 'cup.lip_radius': 0.03})


def _moving(duration: float) -> Trajectory:
    """Return a motion of the tool from rest to rest (s)."""
    s = np.linspace(0.0, 1.0, round(250.0 * duration) + 1)
    step, slope = s**3 * (10 - 15 * s + 6 * s**2), 30 * s**2 * (1 - s)**2 / duration
    twist = np.zeros((len(s), 6))
    twist[:, 0] = 0.1 * slope
    return Trajectory(
        np.rint(1e9 * duration * s).astype(np.int64), np.outer(step, [0.1, 0.0, 0.0]),
        np.broadcast_to(np.eye(3), (len(s), 3, 3)), twist)


def compile_prediction(cup: Cup) -> None:
    """Compile predictions from poses."""
    live.warm_up(cup, PACKAGE, GRAVITY, 'world')


def compile_fit(cup: Cup) -> None:
    """Compile a fit of output error to a recording."""
    tool = _moving(3.0)
    noise = BodyNoise(np.repeat([1e-4, 5e-4], 3))
    segment = Segment(
        tool, simulate(cup, PACKAGE, tool, gravity=GRAVITY), PACKAGE, GRAVITY, noise, noise)
    problem = Problem.of([segment], STRUCTURES['axisymmetric'], cup, {})
    residuals.evaluated(problem, problem.start, segment, segment.first)


def compile_plans(cup: Cup) -> None:
    """Compile predictions of plans, steering and tosses."""
    model = model_tuple(cup, PACKAGE, GRAVITY)
    landing.warm_up(_values(cup), model)
    PlanSimulation(model, (60.0, 0.02, 0.5), _moving(1.0), tail=0.1).predict()
    steer(model, _moving(1.0), 'zvd')


def compile_observer(cup: Cup) -> None:
    """Compile corrections by measured poses."""
    warm_up_observer(_values(cup), model_tuple(cup, PACKAGE, GRAVITY))


PARTS: dict[str, Callable[[Cup], None]] = {
    'fit': compile_fit, 'observer': compile_observer, 'plans': compile_plans,
    'prediction': compile_prediction}
"""Entries that are compiled together, the longest first."""
