"""The package from the valve on: held until the cup lets go, flying, landed. Pure code, no ROS."""

from __future__ import annotations

from collections.abc import Callable, Mapping
import math
from typing import Any, NamedTuple

from bellows_ros.core.arrays import Array
from bellows_ros.core.equilibrium import displaced, largest_step
from bellows_ros.core.holding import grip_of
from bellows_ros.core.kernels import ModelTuple, State
from bellows_ros.core.landing import aim, changed, figures, release_deviations
from bellows_ros.core.live.payload import extrapolated, MOST_SUBSTEPS
from bellows_ros.core.live.samples import ORIGIN, Prediction, ZERO
from bellows_ros.core.release import (
    COARSE_STRIDE,
    flight,
    flight_path,
    Held,
    NO_GRIP,
    Release,
    release_of,
    Toss,
    toss_along,
    upward,
)
from bellows_ros.core.simulation import Rows
from bellows_ros.core.tuples import add, scale
from bellows_ros.errors import BellowsError
import numpy as np

AHEAD, TAUS = 0.05, 6.0
"""The cup lets go within the delay, this time (s) and this many tau, or not at all."""
AIMED_AHEAD = 0.4
"""How far ahead (s) a release for the target is searched."""
AIMED_SCAN, AIMED_CLOSELY = 0.01, 1
"""Spacing (s) of that scan, and how many of its times are refined."""
COARSE = 2.0
"""Steps are so many times as long as elsewhere: the landing is within 0.02 mm, 0.2 mrad."""
INSTANT = 1e-7
"""Accuracy (s) of the instant of letting go."""
PUSHES = (1e-4,) * 3 + (1e-3,) * 6 + (1e-2,) * 3
"""Steps of differences by shift (m), turn (rad), linear and angular twist (m/s, rad/s)."""
RENEWED = 10
"""The covariance of the package's state is renewed once in this many landings."""
PATH_POINTS = 24


class Landing(NamedTuple):
    """Where the package would land if the valve were switched at a prediction."""

    toss: Toss
    """Times are s since the prediction."""
    covariance: Array
    """Of position on the floor and rotation vector, in world axes (6, 6)."""


def motion(times_ns: tuple[int, int], start: State, end: State) -> Rows:
    """Return the tool between two states."""
    return Rows(np.array(times_ns), np.array([
        (*o, *q, *v, *w) for o, q, v, w in (start, end)]))


def steadily(prediction: Prediction, duration: float) -> Rows:
    """Return the tool going on from a prediction, its tip straight and its rotation steadily."""
    tool = prediction.tool
    return motion((0, round(duration * 1e9)), tool, extrapolated(tool, duration))


Future = Callable[[Prediction, float], Rows]


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
    grip : tuple or None
        That which holds until the valve is switched, as `grip_of` returns it.

    """

    def __init__(self, values: Mapping[str, Any], future: Future = steadily) -> None:
        """Set the data of release and landing."""
        self._values, self._future = values, future
        self.known = min(values['package.size']) > 0.0
        self._release = release_of(values) if self.known else None
        self.grip = grip_of(values)
        self._ahead = values['release.delay'] + TAUS * values['release.tau'] + AHEAD
        self._deviations = release_deviations(values)
        self._uncertain = [*range(12), *(12 + np.flatnonzero(self._deviations)).tolist()]
        self._longest: tuple[ModelTuple | None, float] = None, 0.0
        self.forget()

    def warm_up(self, model: ModelTuple) -> None:
        """Compile all that a toss needs."""
        if self._release is None:
            return
        high = scale(self._release.height + 1.0 + 2.0 * max(self._values['package.size']),
                     upward(model[2]))
        still = Prediction(1, high, *ORIGIN[1:], ZERO, ZERO, (high, *ORIGIN[1:]))
        found = self.landing(model, still, lambda _: np.zeros((12, 12)))
        self.time_to_target(model, still)
        if found is not None:
            flight_path(model, found.toss, 2)
        self.forget()

    def forget(self) -> None:
        """Take the package as held."""
        self.state = ''
        self._switched_ns = self._stamp_ns = 0
        self._landing_ns: int | None = None
        self._body: State | None = None
        self._by: Array | None = None  # (6, 15), derivatives by state and release
        self._covariance = np.zeros((12, 12))
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
        """Return a prediction of the held package, or of the flight once it is released."""
        before, self._before = self._before, now
        if self.state != 'released' or before is None or self._release is None:
            return now
        duration = (now.stamp_ns - before.stamp_ns) * 1e-9
        if not 0.0 < duration < 1.0:
            return now
        tool = motion((before.stamp_ns, now.stamp_ns), before.tool, now.tool)
        switched = (self._switched_ns - before.stamp_ns) * 1e-9
        released, body, landed, _ = self._toss(
            model, self._release, before.body, tool, switched)
        if released < 0.0:
            return now
        self._body = body
        self._stamp_ns = before.stamp_ns + round(released * 1e9)
        self._landing_ns = None if landed < 0.0 else before.stamp_ns + round(landed * 1e9)
        self.state = 'flying'
        return self.fly(model, now.stamp_ns, now.tool) or now

    def fly(self, model: ModelTuple, stamp_ns: int, tool: State) -> Prediction | None:
        """Return the package at a stamp of its flight, or None after landing."""
        if self._body is None or self.state != 'flying':
            return None
        if self._landing_ns is not None and stamp_ns > self._landing_ns:
            self.state = 'landed'
            return None
        duration = (stamp_ns - self._stamp_ns) * 1e-9
        self._body = flight(model[1], model[2], self._body, duration, COARSE_STRIDE)
        self._stamp_ns = max(stamp_ns, self._stamp_ns)
        return Prediction(stamp_ns, *self._body, ZERO, ZERO, tool)

    def later(self, model: ModelTuple, now: Prediction, seconds: float) -> State | None:
        """
        Return the package some time (s) after a prediction, the tool going on as planned.

        None where the cup still holds it then.

        Raises
        ------
        BellowsError
            If it has landed by then.

        """
        if self._release is None or not self.state:
            return None
        released, body, landed = 0.0, now.body, math.inf
        if not now.flies:
            tool = self._future(now, self._ahead)
            switched = (self._switched_ns - now.stamp_ns) * 1e-9
            released, body, landed, _ = self._toss(model, self._release, body, tool, switched)
            if not 0.0 <= released <= seconds:
                return None
        elif self._landing_ns is not None:
            landed = (self._landing_ns - now.stamp_ns) * 1e-9
        if self.state == 'landed' or 0.0 <= landed < seconds:
            raise BellowsError(
                'The package has landed by then, and its later motion is unknown; expected a '
                f'stamp up to {max(0.0, landed):.3f} s after the newest pose of the tool.')
        return flight(model[1], model[2], body, seconds - released, COARSE_STRIDE)

    def _toss(
        self, model: ModelTuple, release: Release, body: State, tool: Rows, switched: float = 0.0,
    ) -> tuple[float, State, float, State]:
        """Return when it is let go and the state then, when it lands and the state then."""
        if self._longest[0] is not model:
            self._longest = model, COARSE * largest_step(model)
        if float(tool.seconds[-1]) > MOST_SUBSTEPS * self._longest[1]:  # would hold up the poses
            return -1.0, body, -1.0, body
        return toss_along(
            model, self.grip or NO_GRIP, release.valve, release.impulse, release.box,
            release.height, body, tool.rows, tool.seconds, switched, self._longest[1], INSTANT)

    def landing(
        self, model: ModelTuple, prediction: Prediction,
        covariance: Callable[[Prediction], Array],
    ) -> Landing | None:
        """
        Return the landing if the valve were switched now and the tool moved on as planned.

        One derivative is renewed each time: all of them take as long as what they are used for
        hardly changes.

        Parameters
        ----------
        model : tuple
            As the kernels take it.
        prediction : Prediction
            Of the held package.
        covariance : callable
            From it to the covariance (12, 12) of its state, in its own axes.

        """
        release = self._release
        if release is None or self.state:
            return None
        try:
            tool = self._future(prediction, self._ahead)
            nominal = Toss(*self._toss(model, release, prediction.body, tool))
            if nominal.landing_time <= nominal.release_time:
                return None
            if self._count % RENEWED == 0:
                self._covariance = covariance(prediction)
            due = self._uncertain
            if self._by is None:
                self._by = np.zeros((6, 15))
            else:
                due = [due[self._count % len(due)]]
            for i in due:
                self._by[:, i] = self._derivative(model, release, prediction, tool, nominal, i)
            self._count += 1
        except (BellowsError, ArithmeticError, ValueError):
            self._by = None
            return None
        of_state, of_release = self._by[:, :12], self._by[:, 12:]
        total = of_state @ self._covariance @ of_state.T + of_release @ of_release.T
        return Landing(nominal, total) if np.isfinite(total).all() else None

    def _derivative(
        self, model: ModelTuple, release: Release, prediction: Prediction, tool: Rows,
        nominal: Toss, i: int,
    ) -> Array:
        """
        Return the change (6,) of a landing by its i-th parameter.

        By shift, turn, linear and angular twist of B in its own axes, for a unit of each, and by
        delay, tau and impulse, for a standard deviation.
        """
        body, size = prediction.body, 1.0
        push = np.zeros(15)
        if i < 12:
            push[i] = size = PUSHES[i]
            x = push.tolist()
            o, q, v, w = displaced(body, (x[0], x[1], x[2]), (x[3], x[4], x[5]))
            body = o, q, add(v, (x[6], x[7], x[8])), add(w, (x[9], x[10], x[11]))
        else:
            push[i] = 1.0
            release = changed(release, push[12:] * self._deviations)
        found = Toss(*self._toss(model, release, body, tool))
        if found.landing_time <= found.release_time:
            raise BellowsError('A toss that differs a little does not land.')
        return figures(found, nominal, model[2]) / size

    def time_to_target(self, model: ModelTuple, prediction: Prediction) -> float | None:
        """Return the time (s) until the valve should be switched for the target, or None."""
        if self._release is None or self.state or not self._values['landing.aim']:
            return None
        x, y = self._values['landing.target']
        try:
            held = Held(
                model, self.grip, self._future(prediction, 2.0 * AIMED_AHEAD),
                prediction.body, 2.0 * AIMED_AHEAD)
            found = aim(held, self._release, (x, y), None, AIMED_AHEAD, AIMED_SCAN, AIMED_CLOSELY)
        except (BellowsError, ArithmeticError, ValueError):
            return None
        return found.switched if math.isfinite(found.distance) else None
