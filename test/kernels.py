"""Compiled code for the tests; what it needs is imported late, as it loads NumPy."""

import multiprocessing


def compile_most():
    """Compile or load what most processes need."""
    from bellows_ros.core.live.uncertainty import warm_up_uncertainty

    _compile_live()
    warm_up_uncertainty()


def compile_all():
    """Compile nearly everything once, before the workers start: two halves that share little."""
    from bellows_ros.core.geometry.jit import COMPILED

    if COMPILED:
        half = multiprocessing.get_context('fork').Process(target=_compile_filters)
        half.start()
        _compile_plans()
        half.join()


def _compile_live():
    """Compile what predicts from poses, and return a model."""
    from bellows_ros.core.live import warm_up
    from bellows_ros.core.model.cup_package import Cup, model_tuple, Package
    import numpy as np

    cup, package = Cup.thesis(), Package(1.0, 0.01 * np.eye(3), np.zeros(3))
    warm_up(cup, package, 9.81, 'world')
    return model_tuple(cup, package, 9.81)


def _compile_plans():
    """Compile what predicts, steers and tosses."""
    from bellows_ros.core.live.flight import Flight
    from bellows_ros.core.parameters.checks import resolve
    from bellows_ros.core.planning.steering import steer

    from .core import plans, tosses

    model = _compile_live()
    Flight(resolve(tosses.values())).warm_up(model)
    steer(model, plans.Move([0.1, 0.0, 0.0], [0.0, 0.0, 0.0], 1.0).plan(), 'inverse')


def _compile_filters():
    """Compile what observes, estimates and simulates, with all derivatives."""
    from bellows_ros.core.identification.search import Search, Segment
    from bellows_ros.core.live.uncertainty import warm_up_uncertainty
    from bellows_ros.core.model.cup_package import Cup, model_tuple
    from bellows_ros.core.model.structure import STRUCTURES
    from bellows_ros.core.observer import warm_up_observer
    from bellows_ros.core.parameters.checks import resolve

    from .core import tosses
    from .core.identification.test_output_error import measured

    cup = Cup.thesis()
    warm_up_observer(resolve(tosses.values()), model_tuple(cup, tosses.PACKAGE, 9.81))
    warm_up_uncertainty()
    search = Search([Segment(measured(9, duration=3.0))], STRUCTURES['axisymmetric'], cup, {})
    search.system(search.start, 0.0)
