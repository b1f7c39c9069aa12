"""Compiled code for the tests; what it needs is imported late, as it loads NumPy."""

import multiprocessing


def compile_all():
    """Compile nearly everything once, before the workers start: three parts that share little."""
    from bellows_ros.core.geometry.jit import COMPILED

    if COMPILED:
        fork = multiprocessing.get_context('fork')
        others = [fork.Process(target=part) for part in (_compile_rubber, _compile_observer)]
        others[0].start()
        _model()  # so that the observer, which is forked with it, does not compile it again
        others[1].start()
        _compile_plans()
        for other in others:
            other.join()


def _model(relaxation=(0.0, 0.0)):
    """Compile what predicts from poses, and return a cup and a model."""
    from dataclasses import replace

    from bellows_ros.core.live import warm_up
    from bellows_ros.core.model.cup_package import Cup, model_tuple, Package
    import numpy as np

    cup = replace(Cup.thesis(), relaxation=relaxation)
    package = Package(1.0, 0.01 * np.eye(3), np.zeros(3))
    warm_up(cup, package, 9.81, 'world')
    return cup, model_tuple(cup, package, 9.81)


def _compile_plans(relaxation=(0.0, 0.0)):
    """Compile what predicts, steers, tosses, estimates and says how sure it is."""
    from bellows_ros.core.identification.search import Search
    from bellows_ros.core.identification.segments import Segment
    from bellows_ros.core.live.flight import Flight
    from bellows_ros.core.live.uncertainty import warm_up_uncertainty
    from bellows_ros.core.model.structure import STRUCTURES
    from bellows_ros.core.parameters.checks import resolve
    from bellows_ros.core.planning.steering import steer

    from .core import plans, tosses
    from .core.identification.test_output_error import measured

    cup, model = _model(relaxation)
    Flight(resolve(tosses.values())).warm_up(model)
    steer(model, plans.Move([0.1, 0.0, 0.0], [0.0, 0.0, 0.0], 1.0).plan(), 'inverse')
    warm_up_uncertainty(relaxation)
    search = Search([Segment(measured(9, duration=3.0))], STRUCTURES['axisymmetric'], cup, {})
    search.system(search.start, 0.0)


def _compile_observer(relaxation=(0.0, 0.0)):
    """Compile what observes."""
    from bellows_ros.core.observer.observer import warm_up_observer
    from bellows_ros.core.parameters.checks import resolve

    from .core import tosses

    warm_up_observer(resolve(tosses.values()), _model(relaxation)[1])


def _compile_rubber():
    """Compile all of it for a cup that relaxes, whose kernels have more arguments."""
    _compile_plans((0.2, 0.2))
    _compile_observer((0.2, 0.2))
