"""The package after the valve is switched: held until the release, in flight, landed. No ROS."""

from collections.abc import Callable
from contextlib import suppress
from functools import lru_cache
import math
from typing import NamedTuple

from bellows_ros.core.geometry.arrays import Array
from bellows_ros.core.geometry.jit import as_inputs
from bellows_ros.core.geometry.tuples import scale, ZERO
from bellows_ros.core.live.plan_tracker import point_at
from bellows_ros.core.live.uncertainty import Prediction, Uncertainty, UNKNOWN_ROOT
from bellows_ros.core.model.equilibrium import adapted, largest_step, moved_by, pose_error
from bellows_ros.core.model.grip import Grip, NO_FLIGHT
from bellows_ros.core.model.kernels import extrapolated, lip_wrench, ModelTuple, ORIGIN, State
from bellows_ros.core.model.simulation import diverged, require_steps, row_state, ToolRows
from bellows_ros.core.observer.dynamics import MAX_SUBSTEPS
from bellows_ros.core.parameters import conversion
from bellows_ros.core.parameters.values import Values
from bellows_ros.core.signals.trajectory import NS_PER_S
from bellows_ros.core.toss import release
from bellows_ros.core.toss.free_flight import COARSE_ROTATION_PER_STEP, flight, upward
from bellows_ros.core.toss.landing import aim, release_with
from bellows_ros.core.toss.release import HeldMotion, Toss
from bellows_ros.errors import BellowsError
import numpy as np

AIM_TIME = 0.4
"""Duration of the range in which a release that hits the target is searched, s."""
PATH_POINTS = 24
ROOT_STEP = 0.01
"""Step of the covariance of a later state, s."""

_longest_step = lru_cache(maxsize=1)(largest_step)


class Landing(NamedTuple):
    """Landing of the package if the valve were switched at a prediction."""

    stamp_ns: int
    """Stamp of the prediction."""
    toss: Toss
    """Toss, with times in s after the prediction."""
    covariance: Array
    """Covariance of position on the floor and rotation vector, in world axes (6, 6)."""


def _after_now(tool: ToolRows | None) -> tuple[Array, Array]:
    """Return rows and times (s) of a tool's motion after the present; empty if there are none."""
    return (np.empty((0, 13)), np.empty(0)) if tool is None else (tool.rows[1:], tool.seconds[1:])


def at_constant_velocity(now: Prediction, tool: ToolRows | None, duration: float) -> ToolRows:
    """Return the tool's motion for at least a time (s): as planned, then with constant twist."""
    tool = tool or ToolRows(np.zeros(1, np.int64), np.array([np.concatenate(now.tool)]))
    remaining_ns = round(duration * NS_PER_S) - int(tool.stamps_ns[-1])
    if remaining_ns <= 0:
        return tool
    last = np.concatenate(extrapolated(row_state(tool.rows[-1]), remaining_ns / NS_PER_S))
    return ToolRows(
        np.append(tool.stamps_ns, tool.stamps_ns[-1] + remaining_ns), np.vstack([tool.rows, last]))


class Flight:
    """
    Follow a package after the valve is switched.

    Parameters
    ----------
    values : mapping
        Parameters by name.
    future : callable
        Function of a prediction, and of a deviation of the progress in standard deviations, that
        returns the tool's planned motion from then on, beginning at 0 ns, or None without a plan.
        After the plan the tool keeps its twist.
    grip : callable, optional
        Function that returns the grip of the held package, like `grip_of`; default: the grip of
        the values.

    Attributes
    ----------
    state : str
        'released' (the valve is switched, the cup still holds), 'flying', 'landed', or '' for a
        held package.
    has_size : bool
        Whether the size of the package is known, without which no landing is computed.

    """

    def __init__(
        self, values: Values,
        future: Callable[[Prediction, float], ToolRows | None] = lambda now, deviations: None,
        grip: Callable[[], Grip | None] | None = None,
    ) -> None:
        self._values, self._future = values, future
        of_values = conversion.grip_of(values)
        self._grip_now = grip or (lambda: of_values)
        self.has_size = min(values.package.size) > 0.0
        self._release = conversion.release_of(values) if self.has_size else NO_FLIGHT
        # additional delay without load, s
        self._ahead = release.latest_release(conversion.release_law_of(values)) + 0.05
        self._factor = conversion.release_factor(values)
        self._of_state, self._by = np.zeros((12, 12)), np.zeros((6, len(release.DIFFERENCE_STEPS)))
        self._by_progress = np.zeros(6)
        self.forget()

    def warm_up(self, model: ModelTuple) -> None:
        """Compile all kernels of a toss."""
        if not self.has_size:
            return
        high = scale(self._release.height + 1.0 + 2.0 * max(self._values.package.size),
                     upward(model[2]))
        still = Prediction(1, high, *ORIGIN[1:], ZERO, ZERO, (high, *ORIGIN[1:]))
        landing = self.landing(model, still, lambda _: np.zeros((12, 12)))
        with suppress(BellowsError):
            self.later(model, still, 0.1)
        self.time_to_target(model, still)
        if landing is not None:
            release.flight_path(model, landing.toss, 2)
        self.forget()

    def forget(self) -> None:
        """Treat the package as held."""
        self.state = ''
        self._switched_ns = self._stamp_ns = 0
        self._landing_ns: int | None = None
        self._body: State | None = None
        self._count = 0  # number of consecutive landings
        self._before: Prediction | None = None

    def switch(self, stamp_ns: int) -> None:
        """Switch the valve at a stamp."""
        if self.has_size and not self.state:
            self._released_grip = self.grip
            self.state, self._switched_ns = 'released', stamp_ns

    @property
    def grip(self) -> Grip | None:
        """Grip before the valve was switched, with the pressure of that time."""
        return self._released_grip if self.state else self._grip_now()

    @property
    def is_free(self) -> bool:
        """Whether the cup has released the package."""
        return self.state in ('flying', 'landed')

    def follow(self, model: ModelTuple, now: Prediction) -> Prediction:
        """Return a prediction of the held package, or of the flight once it is released."""
        before, self._before = self._before, now
        if self.state != 'released' or before is None:
            return now
        duration = (now.stamp_ns - before.stamp_ns) / NS_PER_S
        if not 0.0 < duration < 1.0:
            return now
        tool = ToolRows(np.array([0, now.stamp_ns - before.stamp_ns]), np.array([
            np.concatenate(each.tool) for each in (before, now)]))
        released, body, landed, _ = self._toss(
            model, before, tool, (self._switched_ns - before.stamp_ns) / NS_PER_S, duration)
        if released < 0.0 and self._values.release.opening == 0.0:
            return now
        if released < 0.0:
            since_valve = (now.stamp_ns - self._switched_ns) / NS_PER_S
            opened = release.opened_by(model, self._release.law, since_valve, now.tool, body)
            force, moment = lip_wrench(opened, now.tool, body)
            self._before = now._replace(
                position=body[0], quaternion_xyzw=body[1], linear=body[2], angular=body[3],
                force=force, moment=moment, strains=body[4:])
            return self._before
        self._body = body
        self._stamp_ns = before.stamp_ns + round(released * NS_PER_S)
        self._landing_ns = None if landed < 0.0 else before.stamp_ns + round(landed * NS_PER_S)
        self.state = 'flying'
        return self.fly(model, now.stamp_ns, now.tool) or now

    def fly(self, model: ModelTuple, stamp_ns: int, tool: State) -> Prediction | None:
        """Return the package at a stamp of its flight, or None after landing."""
        if self._body is None or self.state != 'flying':
            return None
        if self._landing_ns is not None and stamp_ns > self._landing_ns:
            self.state = 'landed'
            return None
        duration = (stamp_ns - self._stamp_ns) / NS_PER_S
        self._body = flight(model[1], model[2], self._body, duration, COARSE_ROTATION_PER_STEP)
        self._stamp_ns = max(stamp_ns, self._stamp_ns)
        return Prediction(stamp_ns, *self._body[:4], ZERO, ZERO, tool, flies=True)

    def later(self, model: ModelTuple, now: Prediction, seconds: float) -> State:
        """
        Return the package some time (s) after a prediction, with the tool moving as planned.

        Raises
        ------
        BellowsError
            If the package has landed by then, or the prediction diverges.

        """
        released, body, landed = 0.0, now.body, math.inf
        if not now.flies:
            require_steps(seconds / _longest_step(model), 2_000_000)
            switched = (self._switched_ns - now.stamp_ns) / NS_PER_S if self.state else math.inf
            try:
                released, body, landed, _ = self._toss(
                    model, now, self._future(now, 0.0), switched, seconds)
            except (ArithmeticError, ValueError):  # interpreted kernels raise
                raise diverged() from None
            if not math.isfinite(sum(map(sum, body[:4]))):
                raise diverged()
            if released < 0.0:
                return body
        elif self._landing_ns is not None:
            landed = (self._landing_ns - now.stamp_ns) / NS_PER_S
        if self.state == 'landed' or 0.0 <= landed < seconds:
            raise BellowsError(
                'The package has landed by then, and its later motion is unknown; expected a '
                f'stamp up to {max(0.0, landed):.3f} s after the newest pose of the tool.')
        return flight(model[1], model[2], body, seconds - released, COARSE_ROTATION_PER_STEP)

    def root_later(
        self, model: ModelTuple, now: Prediction, seconds: float, uncertainty: Uncertainty
    ) -> Array:
        """
        Return a factor (12, n) of the covariance of `later`, in body axes.

        Uncertainties of cup, start and tool are propagated along the predicted motion; the last
        column is the deviation of the package by one standard deviation of the progress on the
        plan. Without a plan the acceleration of the tool is unknown. After the valve is switched
        the factor is `UNKNOWN_ROOT`.
        """
        if self.state or now.flies:
            return UNKNOWN_ROOT
        times = np.linspace(0.0, seconds, 1 + math.ceil(seconds / ROOT_STEP))
        switching = model, self.grip or release.NO_GRIP, NO_FLIGHT, math.inf
        body = adapted(model, now.tool, now.body)
        tools, states = np.empty((2, 2, len(times), 13))
        for deviations in (1, 0):
            plan = self._future(now, deviations)
            tool = at_constant_velocity(now, plan, seconds + ROOT_STEP)  # moving at the end
            inputs = as_inputs(tool.rows, tool.seconds)
            tools[deviations] = [np.concatenate(point_at(*inputs, t)) for t in times]
            tools[deviations, 0] = np.concatenate(now.tool)
            release.write_toss(
                switching, body, tools[deviations], times, _longest_step(model),
                states[deviations])
        future = []
        for t, row, state in zip(times.tolist(), tools[0], states[0], strict=True):
            o, q, v, w, *strains = adapted(model, row_state(row), row_state(state))
            future.append(Prediction(
                now.stamp_ns + round(t * NS_PER_S), o, q, v, w, ZERO, ZERO, row_state(row),
                plan is None, now.unsettled, strains=tuple(strains)))
        shift, rotation = pose_error(row_state(states[0, -1]), *row_state(states[1, -1])[:2])
        return np.column_stack([
            uncertainty.later(now, future[1:]),
            np.concatenate([shift, rotation, states[1, -1, 7:] - states[0, -1, 7:]])])

    def _toss(
        self, model: ModelTuple, now: Prediction, tool: ToolRows | None, switched: float,
        until: float,
    ) -> tuple[float, State, float, State]:
        """Return the result of `toss_along` for a package held until a time (s)."""
        return release.toss_along(
            (model, self.grip or release.NO_GRIP, self._release, switched), 0.0, now.tool,
            adapted(model, now.tool, now.body),
            (*_after_now(tool), until, _longest_step(model)))

    def landing(
        self, model: ModelTuple, prediction: Prediction,
        covariance: Callable[[Prediction], Array],
    ) -> Landing | None:
        """
        Return the landing if the valve were switched now and the tool moved as planned.

        Each call renews one derivative, because the derivatives change slowly and all of them
        together take too long.

        Parameters
        ----------
        model : tuple
            As the kernels take it.
        prediction : Prediction
            Prediction of the held package.
        covariance : callable
            Function of a prediction that returns the covariance (12, 12) of its state, in body
            axes.

        """
        longest = 2.0 * _longest_step(model)  # within 0.02 mm and 0.2 mrad at landing
        if not self.has_size or self.state or self._ahead > MAX_SUBSTEPS * longest:
            return None  # too many steps would delay the poses
        is_due = self._count % 10 == 0  # renewed in every tenth landing
        plan = self._future(prediction, 0.0)
        hanging = adapted(model, prediction.tool, prediction.body)

        def landing(
            change: Array, tool: ToolRows | None = plan
        ) -> tuple[float, State, float, State]:
            """Return the landing after a change (20,) of initial state and law of release."""
            switching = (model, self.grip or release.NO_GRIP,
                         release_with(self._release, self._factor @ change[12:]), 0.0)
            found = release.toss_along(
                switching, 0.0, prediction.tool, moved_by(hanging, change[:12]),
                (*_after_now(tool), self._ahead, longest))
            if found[2] <= found[0]:
                raise ArithmeticError('no landing')
            return found

        def change_by(changed: tuple[float, State, float, State]) -> Array:
            """Return the deviation (6,) of another landing: position (m), rotation (rad)."""
            return np.concatenate(release.landing_error(changed[3], nominal[3], model[2]))

        try:
            if is_due:
                self._of_state[:] = covariance(prediction)
            nominal = landing(np.zeros(20))
            steps = np.diag(release.DIFFERENCE_STEPS)
            for k in [self._count % len(steps)] if self._count else range(len(steps)):
                self._by[:, k] = change_by(landing(steps[k])) / steps[k, k]
            if is_due:
                self._by_progress = change_by(
                    landing(np.zeros(20), self._future(prediction, 1.0)))
            by_state, by_law = self._by[:, :12], self._by[:, 12:]
            of_landing = by_state @ self._of_state @ by_state.T + by_law @ by_law.T + np.outer(
                self._by_progress, self._by_progress)
            is_sound = math.isfinite(of_landing.trace())
        except (BellowsError, ArithmeticError, ValueError):
            is_sound = False
        self._count = self._count + 1 if is_sound else 0
        return Landing(prediction.stamp_ns, Toss(*nominal), of_landing) if is_sound else None

    def time_to_target(self, model: ModelTuple, prediction: Prediction) -> float | None:
        """Return the time (s) until the valve should be switched for the target, or None."""
        if not self.has_size or self.state or not self._values.landing.aim:
            return None
        if 2.0 * AIM_TIME > 100_000 * _longest_step(model):  # largest number of integration steps
            return None  # too many steps
        x, y = self._values.landing.target
        try:
            tool = at_constant_velocity(prediction, self._future(prediction, 0.0), 2.0 * AIM_TIME)
            held = HeldMotion(model, self.grip, tool, prediction.body, 2.0 * AIM_TIME)
            aimed = aim(held, self._release, (x, y), None, AIM_TIME, 0.01, 1)
        except (BellowsError, ArithmeticError, ValueError):
            return None
        return aimed.switched if math.isfinite(aimed.distance) else None
