"""Compilation of kernels for the tests; imports are late, as NumPy takes long to load."""

import multiprocessing

RUBBER = (0.2, 0.2)
"""Relaxation of a cup whose kernels have more arguments."""


def compile_all():
    """Compile nearly everything once, before the workers start: three parts that share little."""
    from bellows_ros.core.geometry.jit import COMPILED

    if COMPILED:
        fork = multiprocessing.get_context('fork')
        others = [fork.Process(target=part) for part in (_compile_rubber, compile_observer)]
        others[0].start()
        compile_model()  # so that the observer, which is forked with it, does not compile it again
        others[1].start()
        compile_plans()
        _compile_search()
        for other in others:
            other.join()


def _cup(relaxation):
    """Return a cup."""
    from dataclasses import replace

    from bellows_ros.core.model.cup_package import Cup

    return replace(Cup.thesis(), relaxation=relaxation)


def compile_model(relaxation=(0.0, 0.0)):
    """Compile the kernels of a prediction from poses; return the model."""
    from bellows_ros.core.live import warm_up
    from bellows_ros.core.model.cup_package import model_tuple, Package
    import numpy as np

    cup, package = _cup(relaxation), Package(1.0, 0.01 * np.eye(3), np.zeros(3))
    warm_up(cup, package, 9.81, 'world')
    return model_tuple(cup, package, 9.81)


def compile_plans(relaxation=(0.0, 0.0)):
    """Compile the kernels of plans, steering, tosses and covariances."""
    from bellows_ros.core.live.flight import Flight
    from bellows_ros.core.live.uncertainty import warm_up_uncertainty
    from bellows_ros.core.parameters.checks import resolve
    from bellows_ros.core.planning.steering import steer

    from .core import plans, tosses

    model = compile_model(relaxation)
    Flight(resolve(tosses.values())).warm_up(model)
    steer(model, plans.Move([0.1, 0.0, 0.0], [0.0, 0.0, 0.0], 1.0).plan(), 'inverse')
    warm_up_uncertainty(relaxation)


def _compile_search(relaxation=(0.0, 0.0)):
    """Compile the kernels of the output-error fit."""
    from bellows_ros.core.identification.problem import Problem
    from bellows_ros.core.identification.segments import Segment
    from bellows_ros.core.model.structure import STRUCTURES

    from .core.identification.test_output_error import measured

    segment = Segment.of(measured(9, duration=3.0))
    problem = Problem.of([segment], STRUCTURES['axisymmetric'], _cup(relaxation), {})
    problem.whitened(problem.start, segment, segment.first)


def compile_observer(relaxation=(0.0, 0.0)):
    """Compile the kernels of the observer."""
    from bellows_ros.core.observer.observer import warm_up_observer
    from bellows_ros.core.parameters.checks import resolve

    from .core import tosses

    warm_up_observer(resolve(tosses.values()), compile_model(relaxation))


def _compile_rubber():
    """Compile the kernels above for a cup that relaxes."""
    compile_plans(RUBBER)
    _compile_search(RUBBER)
    compile_observer(RUBBER)
