"""The package from the valve on: held until the cup lets go, flying, landed. Pure code, no ROS."""

from __future__ import annotations

from collections.abc import Callable, Mapping
import math
from typing import Any, NamedTuple

from bellows_ros.core.arrays import Array
from bellows_ros.core.equilibrium import largest_step
from bellows_ros.core.holding import grip_of
from bellows_ros.core.kernels import ModelTuple, State
from bellows_ros.core.landing import aim, by_state, changed, figures, release_deviations
from bellows_ros.core.lie import quaternion_to_rotation
from bellows_ros.core.live.payload import extrapolated
from bellows_ros.core.live.samples import Prediction, ZERO
from bellows_ros.core.release import (
    COARSE_STRIDE,
    flight,
    flight_path,
    Held,
    land,
    pushed_off,
    release_of,
    Toss,
    toss,
)
from bellows_ros.core.trajectory import Trajectory
from bellows_ros.errors import BellowsError
import numpy as np

AHEAD, TAUS = 0.05, 6.0
"""Within the delay, so many tau and this time (s) the cup lets go, if it does."""
AIMED_AHEAD = 0.4
"""So far ahead (s) a release for the target is sought."""
AIMED_SCAN, AIMED_CLOSELY = 0.01, 1
"""Step (s) of the scan for it, and how many of its times are looked at closely."""
MARGIN = 0.01
"""A state a little different lets go so much (s) later at most."""
RENEWED = 10
"""Every so many landings their derivatives are computed anew."""
PATH_POINTS = 24


class Landing(NamedTuple):
    """Where the package would land if the valve were switched at a prediction."""

    toss: Toss
    """Times are s since the prediction."""
    covariance: Array
    """Of position on the floor and rotation vector, in world axes (6, 6)."""
    path: Array
    """States (N, 13) from letting go to landing."""


def steadily(prediction: Prediction, duration: float) -> Trajectory:
    """Return the tool going on from a prediction, its tip straight and its rotation steadily."""
    ends = prediction.tool, extrapolated(prediction.tool, duration)
    return Trajectory(
        np.array([0, round(duration * 1e9)]), np.array([end[0] for end in ends]),
        quaternion_to_rotation(np.array([end[1] for end in ends])),
        np.array([[*end[2], *end[3]] for end in ends]))


Future = Callable[[Prediction, float], Trajectory]


class Flight:
    """
    Follow a package after the valve has been switched.

    Parameters
    ----------
    values : mapping
        Parameters by name.
    future : callable
        From a prediction and a time (s) to the tool's motion from then on.

    Attributes
    ----------
    state : str
        'released' (the valve is switched, the cup still holds), 'flying', 'landed', or '' where
        the package is held.
    known : bool
        Whether the size of the package is known; without it there is no landing.

    """

    def __init__(self, values: Mapping[str, Any], future: Future = steadily) -> None:
        """Take what is known of release and landing."""
        self._values, self._future = values, future
        self.known = min(values['package.size']) > 0.0
        self._release = release_of(values) if self.known else None
        self._longest: tuple[ModelTuple | None, float] = None, 0.0
        self.forget()

    def forget(self) -> None:
        """Take the package as held."""
        self.state = ''
        self._switched_ns = self._stamp_ns = 0
        self._landing_ns: int | None = None
        self._body: State | None = None
        self._by: Array | None = None
        self._count = 0
        self._before: Prediction | None = None

    def switch(self, stamp_ns: int) -> None:
        """Note that the valve is switched at a stamp."""
        if self._release is not None and not self.state:
            self.state, self._switched_ns = 'released', stamp_ns

    @property
    def is_free(self) -> bool:
        """Whether the cup has let go."""
        return self.state in ('flying', 'landed')

    def follow(self, model: ModelTuple, now: Prediction) -> Prediction:
        """Return a prediction of the held package, or that of the flight where it is let go."""
        before, self._before = self._before, now
        if self.state != 'released' or before is None or self._release is None:
            return now
        duration = (now.stamp_ns - before.stamp_ns) * 1e-9
        if not 0.0 < duration < 1.0:
            return now
        tool = Trajectory(
            np.array([before.stamp_ns, now.stamp_ns]), np.array([before.tool[0], now.tool[0]]),
            quaternion_to_rotation(np.array([before.tool[1], now.tool[1]])),
            np.array([[*t.tool[2], *t.tool[3]] for t in (before, now)]))
        held = Held(model, grip_of(self._values), tool, before.body, duration)
        switched = (self._switched_ns - before.stamp_ns) * 1e-9
        released, body = held.let_go(self._release.valve, switched)
        if released < 0.0 or switched > duration:
            return now
        _, package, gravity = model
        self._body = pushed_off(package, body, self._release.impulse)
        self._stamp_ns = before.stamp_ns + round(released * 1e9)
        after, _ = land(
            package, gravity, self._release.box, self._release.height, self._body, COARSE_STRIDE)
        self._landing_ns = None if after < 0.0 else self._stamp_ns + round(after * 1e9)
        self.state = 'flying'
        return self.fly(model, now.stamp_ns, now.tool) or now

    def fly(self, model: ModelTuple, stamp_ns: int, tool: State) -> Prediction | None:
        """Return where the package is at a stamp of its flight; None once it has landed."""
        if self._body is None or self.state != 'flying':
            return None
        if self._landing_ns is not None and stamp_ns > self._landing_ns:
            self.state = 'landed'
            return None
        duration = (stamp_ns - self._stamp_ns) * 1e-9
        self._body = flight(model[1], model[2], self._body, duration, COARSE_STRIDE)
        self._stamp_ns = max(stamp_ns, self._stamp_ns)
        return Prediction(stamp_ns, *self._body, ZERO, ZERO, tool)

    def landing(
        self, model: ModelTuple, prediction: Prediction, covariance: Array
    ) -> Landing | None:
        """
        Return where it would land if the valve were switched now, the tool going on as planned.

        Parameters
        ----------
        model : tuple
            As the kernels take it.
        prediction : Prediction
            Of the held package.
        covariance : array (12, 12)
            Of its state, in its own axes.

        """
        release = self._release
        if release is None or self.state:
            return None
        grip = grip_of(self._values)
        ahead = release.valve[0] + TAUS * release.valve[1] + AHEAD
        try:
            if self._longest[0] is not model:
                self._longest = model, largest_step(model)
            held = Held(
                model, grip, self._future(prediction, ahead), prediction.body, ahead,
                self._longest[1])
            nominal = toss(held, release, 0.0, COARSE_STRIDE)
            self._count += 1
            if self._by is None or self._count % RENEWED == 0:
                ahead = nominal.release_time + MARGIN
                self._by = by_state(Held(
                    model, grip, self._future(prediction, ahead),
                    prediction.body, ahead, self._longest[1]), release, nominal)
            parts = [self._by @ covariance @ self._by.T]
            for sigma, unit in zip(release_deviations(self._values), np.eye(3), strict=True):
                if sigma > 0.0:
                    part = figures(
                        toss(held, changed(release, sigma * unit), 0.0, COARSE_STRIDE), nominal,
                        model[2])
                    parts.append(np.outer(part, part))
        except (BellowsError, ArithmeticError, ValueError):
            return None
        total = np.sum(parts, axis=0)
        if not np.isfinite(total).all():
            return None
        return Landing(nominal, total, flight_path(model, nominal, PATH_POINTS))

    def time_to_target(self, model: ModelTuple, prediction: Prediction) -> float | None:
        """Return after what time (s) to switch the valve for the target; None without one."""
        if self._release is None or self.state or not self._values['landing.aim']:
            return None
        x, y = self._values['landing.target']
        try:
            held = Held(
                model, grip_of(self._values), self._future(prediction, 2.0 * AIMED_AHEAD),
                prediction.body, 2.0 * AIMED_AHEAD)
            found = aim(held, self._release, (x, y), None, AIMED_AHEAD, AIMED_SCAN, AIMED_CLOSELY)
        except (BellowsError, ArithmeticError, ValueError):
            return None
        return found.switched if math.isfinite(found.distance) else None
