"""The landing of the package when the valve is switched: one toss from the predicted state."""

from typing import NamedTuple

from bellows_ros.core.geometry.arrays import Array
from bellows_ros.core.geometry.tuples import scale
from bellows_ros.core.live.uncertainty import Prediction, STILL
from bellows_ros.core.model.equilibrium import adapted, largest_step, moved_by
from bellows_ros.core.model.grip import Grip
from bellows_ros.core.model.kernels import ModelTuple, State
from bellows_ros.core.parameters import conversion
from bellows_ros.core.parameters.values import Values
from bellows_ros.core.signals.trajectory import NS_PER_S
from bellows_ros.core.toss import release
from bellows_ros.core.toss.free_flight import upward
from bellows_ros.core.toss.landing import release_with
import numpy as np

OPENING_TIME = 0.05
"""Longest time that the opening of the cup adds to the release of an unloaded cup, s."""


class Landing(NamedTuple):
    """Landing of a released package."""

    stamp_ns: int
    """Stamp at which the package lands."""
    body: State
    """Package at the landing, in the world."""
    covariance: Array
    """Covariance of position on the floor and rotation vector, in world axes (6, 6)."""


def landing(
    values: Values, model: ModelTuple, grip: Grip | None, now: Prediction, covariance: Array,
    switched_ns: int = 0,
) -> Landing | None:
    """
    Return the landing of a package whose valve is switched off, None without a landing.

    The landing depends on package.size. The tool keeps its twist until the cup lets go.

    Parameters
    ----------
    values : Values
        Parameters, with package.size.
    model : tuple
        Model for the kernels.
    grip : tuple or None
        Grip before the valve was switched.
    now : Prediction
        Last prediction of the held package.
    covariance : array (12, 12)
        Covariance of the prediction, in body axes.
    switched_ns : int
        Time from the prediction to the valve, ns.

    """
    if not min(values.package.size) > 0.0:
        return None
    values = conversion.with_assumed_release(values)
    law, factor = conversion.release_of(values), conversion.release_factor(values)
    switched = switched_ns / NS_PER_S
    ahead = (np.empty((0, 13)), np.empty(0),
             switched + release.latest_release(law.law) + OPENING_TIME, largest_step(model))
    body = adapted(model, now.tool, now.body)

    def landed_after(change: Array) -> tuple[float, State]:
        """Return time (s) and state of the landing after a change (18,) of state and law."""
        switching = (model, grip or release.NO_GRIP, release_with(law, factor @ change[12:]),
                     switched)
        released, _, landed, state = release.toss_along(
            switching, 0.0, now.tool, moved_by(body, change[:12]), ahead)
        if landed <= released:
            raise ArithmeticError
        return landed, state

    steps = np.array(release.DIFFERENCE_STEPS)
    try:
        seconds, nominal = landed_after(np.zeros(18))
        errors = [release.landing_error(landed_after(step)[1], nominal, model[2])
                  for step in np.diag(steps)]
    except (ArithmeticError, ValueError):  # interpreted kernels raise
        return None
    changes = np.reshape(errors, (18, 6)) / steps[:, None]
    of_landing = changes[:12].T @ covariance @ changes[:12] + changes[12:].T @ changes[12:]
    if not (np.isfinite(of_landing).all() and np.isfinite(np.concatenate(nominal[:2])).all()):
        return None
    return Landing(now.stamp_ns + round(seconds * NS_PER_S), nominal, of_landing)


def warm_up(values: Values, model: ModelTuple) -> None:
    """Compile the landing with a package at rest above the floor."""
    values = values.replaced({'package.size': (0.1, 0.1, 0.1)})  # may be unknown
    high = scale(values.landing.height + 1.0 + 2.0 * max(values.package.size), upward(model[2]))
    landing(values, model, None, STILL._replace(position=high, tool=(high, *STILL.tool[1:])),
            np.eye(12))
