"""
Predict and identify the motion of a package held by a bellows suction cup.

The names in `__all__` are the library, which is loaded at the first use of a name.
"""

from typing import Any, TYPE_CHECKING

from bellows_ros.version import __version__  # noqa: F401

if TYPE_CHECKING:
    from bellows_ros.library import *  # noqa: F403

__all__ = [  # noqa: F405
    'BellowsError', 'Cup', 'LivePredictor', 'Package', 'Prediction', 'Trajectory', 'box_inertia',
    'fastest', 'identify', 'observe', 'parameters_of', 'plan', 'read_cup',
    'read_package', 'read_parameters', 'replay', 'savgol', 'simulate', 'static_equilibrium',
    'steer', 'toss', 'write_cup', 'write_parameters',
]


def __getattr__(name: str) -> Any:
    """Load the library at its first use."""
    if name not in __all__:
        raise AttributeError(f"module 'bellows_ros' has no attribute '{name}'")
    from bellows_ros import library

    return getattr(library, name)


def __dir__() -> list[str]:
    """Return the names of the library."""
    return __all__
