"""Compiled code for the tests."""


def compile_most() -> None:
    """Compile or load most kernels: once before the workers start, and not in each of them."""
    from bellows_ros.core.live import warm_up
    from bellows_ros.core.live.uncertainty import warm_up_uncertainty
    from bellows_ros.core.model import Cup, Package
    import numpy as np

    package = Package(1.0, 0.01 * np.eye(3), np.zeros(3))
    for twist_frame in ('world', 'tool'):
        warm_up(Cup.thesis(), package, 9.81, twist_frame)
    warm_up_uncertainty()
