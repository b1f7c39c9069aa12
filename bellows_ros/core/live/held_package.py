"""State of the held package: start at rest, propagation with the tool, extrapolation."""

import math

from bellows_ros.core.geometry.arrays import Array
from bellows_ros.core.geometry.jit import entry
from bellows_ros.core.geometry.tuples import ZERO
from bellows_ros.core.live.uncertainty import (
    coasting,
    Modes,
    modes_of,
    Prediction,
    Settling,
    UNKNOWN,
)
from bellows_ros.core.model import equilibrium, kernels
from bellows_ros.core.model.cup_package import Cup, model_tuple, Package
from bellows_ros.core.model.kernels import ModelTuple, State, Wrench
from bellows_ros.core.observer.dynamics import MAX_SUBSTEPS
from bellows_ros.core.observer.observer import Observer
from bellows_ros.core.observer.results import Payload
from bellows_ros.core.observer.states import ANOTHER_PACKAGE, SAME_PACKAGE
from bellows_ros.core.parameters.conversion import package_of, stated_std
from bellows_ros.core.parameters.values import Values
from bellows_ros.core.signals.trajectory import NS_PER_S
from bellows_ros.errors import BellowsError
import numpy as np
from numpy.typing import ArrayLike

RETRY_NS = 100_000_000
"""Time until a failed start is repeated, ns, because an equilibrium takes milliseconds."""

checked_wrench = entry(kernels.checked_wrench)
"""`kernels.checked_wrench` for calls from Python."""

MIN_STEP = 1e-6
"""Shortest integration step of a live prediction, s."""


def prepared(
    cup: Cup, package: Package, gravity: ArrayLike
) -> tuple[ModelTuple, float, float, Modes]:
    """
    Return the model of a cup and a package, and quantities derived from it.

    The derived quantities are the longest stable integration step (s), the largest plausible
    displacement of the lip (m), and the modes.

    Raises
    ------
    BellowsError
        If numbers are too large or too small for a prediction.

    """
    try:
        with np.errstate(all='ignore'):
            model = model_tuple(cup, package, gravity)
            A = equilibrium.nominal_system_matrix(model)
            _require_slow(A)
            modes = modes_of(equilibrium.nominal_system_matrix((model[0][:4], *model[1:])))
            reach = 3.0 * (cup.length + equilibrium.sag(model))  # no weight displaces it farther
            return model, equilibrium.largest_step(model, A), reach, modes
    except (ArithmeticError, ValueError) as error:
        raise BellowsError(
            f'The prediction fails with this cup and package ({error}). Check package.mass, '
            'package.inertia, cup.stiffness, cup.damping and their units.') from None


def _require_slow(matrix: Array) -> None:
    """Raise for a system matrix (12, 12) whose model needs too many steps per second."""
    undamped = matrix.copy()
    undamped[6:12, 6:12] = 0.0
    for name, system in (('cup.stiffness', undamped), ('cup.damping', matrix)):
        fastest = float(np.abs(np.linalg.eigvals(system)).max())
        steps = fastest / equilibrium.PHASE_PER_STEP
        if steps * MIN_STEP > 1.0:
            raise BellowsError(
                f'With this {name} the fastest mode of the package is {fastest:.3g} rad/s, which '
                f'takes {steps:.3g} integration steps a second; expected at most '
                f'{1.0 / MIN_STEP:.3g}. Check {name}, package.mass, package.inertia and their '
                'units.')


def stated_payload(values: Values, stamp_ns: int) -> Payload:
    """Return the payload of package.*, with its stated standard deviations."""
    mass, com, inertia, _ = package_of(values).as_tuple
    mass_std, com_std, inertia_std = (
        stated_std(values, f'package.{name}_std', np.zeros(size))
        for name, size in (('mass', 1), ('com', 3), ('inertia', 3)))
    return Payload(stamp_ns, mass, com, inertia, float(mass_std[0]), com_std, inertia_std)


class HeldPackage:
    """
    A package on a cup, and its newest prediction.

    Parameters
    ----------
    cup, package : Cup, Package
    gravity : float or array_like (3,)
        Magnitude along -z of the world, or vector in the world, m/s^2.
    values : mapping
        Parameters of the observer.

    Attributes
    ----------
    outcome : str
        Fault of the last call: 'diverged', 'no_equilibrium', or ''.
    sample : Prediction or None
        Prediction at the newest sample of the tool, from which the package is advanced.
    has_covariance : bool
        Whether the last covariance was not `UNKNOWN`.
    observer : Observer
        Observer that propagates the package, and corrects it with measurements.

    """

    def __init__(self, cup: Cup, package: Package, gravity: ArrayLike, values: Values) -> None:
        self._gravity = gravity
        self.settling = Settling()
        self.observer, self.has_covariance = Observer(values), True
        self.sample: Prediction | None = None
        self.set_model(cup, package)
        self.forget()

    @property
    def model(self) -> ModelTuple:
        """The model as the kernels take it."""
        return self.observer.model

    @property
    def is_settling(self) -> bool:
        """Whether an error of the start remains."""
        return self.sample is not None and self.sample.stamp_ns < self.settling.until_ns

    def set_model(self, cup: Cup, package: Package) -> None:
        """Continue with another cup or package; pose and motion are kept."""
        model, longest_step, self._reach, self.settling.modes = prepared(
            cup, package, self._gravity)
        self._retry_ns = -1
        self.observer.set_model(model, longest_step, self._reach)
        if self.sample is not None:
            self._begin(equilibrium.adapted(model, self.sample.tool, self.observer.body))

    def _begin(self, body: State) -> None:
        """Let the observer begin with the newest sample and a package."""
        assert self.sample
        self.observer.start(
            self.sample.stamp_ns, self.sample.tool, body, not self.settling.is_known)
        if self.settling.is_known:
            self.observer.settle(self.settling.error_at)

    def forget(self, kept: tuple[int, ...] = ANOTHER_PACKAGE) -> None:
        """Restart from rest at the next tool sample, with the estimates in given rows kept."""
        self.observer.forget(kept)
        self.sample = None
        self._retry_ns = -1
        self.outcome = ''

    def follow(self, stamp_ns: int, before: State | None, now: State) -> Prediction | None:
        """
        Advance to a tool sample, or start from rest at this sample.

        Parameters
        ----------
        stamp_ns : int
            Stamp of the sample.
        before : State, optional
            Better estimate of the tool at the previous sample, if available.
        now : State
            Pose and body twist of the tool at the stamp.

        """
        self.outcome, last, observer = '', self.sample, self.observer
        if last is None:
            return self._start(stamp_ns, now)
        result = self._advanced(
            before or last.tool, now, (stamp_ns - last.stamp_ns) / NS_PER_S, stamp_ns)
        if result is None:
            self.outcome = 'diverged'
            observer.forget(SAME_PACKAGE)
            return self._start(stamp_ns, now)
        body, (force, moment) = result
        self.sample = Prediction(stamp_ns, *body[:4], force, moment, now, strains=body[4:])
        if self.settling.update(stamp_ns, now):
            observer.settle(self.settling.error_at)
        return self.sample

    def coast(self, stamp_ns: int) -> Prediction | None:
        """
        Predict with the tool extrapolated, without changing the state for the next sample.

        Returns None without a sample.
        """
        base = self.sample
        if base is None or stamp_ns <= base.stamp_ns:
            return None
        duration = (stamp_ns - base.stamp_ns) / NS_PER_S
        tool = kernels.extrapolated(base.tool, duration)
        result = self._advanced(base.tool, tool, duration)
        if result is None:
            return None
        body, (force, moment) = result
        return Prediction(stamp_ns, *body[:4], force, moment, tool, True, body[4:])

    def covariance(self, stamp_ns: int, is_coasting: bool) -> Array | None:
        """Return the 12 by 12 covariance of a prediction; `UNKNOWN` if rounding spoils it."""
        since_ns = self.sample.stamp_ns if self.sample and is_coasting else stamp_ns
        try:
            P = self.observer.covariance(since_ns)
            if P is not None:
                self.has_covariance = bool(np.isfinite(np.linalg.cholesky(P)).all())
                P = P + coasting((stamp_ns - since_ns) / NS_PER_S)
        except (BellowsError, ArithmeticError, ValueError):  # indefinite by rounding
            self.has_covariance = False
        return P if self.has_covariance else UNKNOWN

    def _advanced(
        self, start: State, end: State, duration: float, stored_ns: int = 0
    ) -> tuple[State, Wrench] | None:
        """
        Return package and wrench after the tool's step, or None if they are not finite.

        The observer stores the package at a given stamp (ns).
        """
        observer = self.observer
        if equilibrium.substeps_for(duration, observer.max_step) > MAX_SUBSTEPS:
            return None
        try:
            if stored_ns and (estimate := observer.follow(stored_ns, start, end)):
                body, wrench, sound = estimate
            else:
                body = (observer.body if stored_ns
                        else observer.propagated_briefly(start, end, duration))
                wrench, sound = checked_wrench(self.model, end, body, self._reach)
        except (ArithmeticError, ValueError):  # interpreted kernels raise instead of nan
            return None
        return (body, wrench) if sound else None

    def _start(self, stamp_ns: int, tool: State) -> Prediction | None:
        """Start with the package at rest below the tool, if possible."""
        self.sample = None
        outcome, self.outcome = self.outcome, 'no_equilibrium'
        if stamp_ns < self._retry_ns:
            return None
        self._retry_ns = stamp_ns + RETRY_NS
        try:
            body = equilibrium.static_equilibrium(self.model, tool)
            still: State = tool[0], tool[1], ZERO, ZERO
            wrench, is_sound = checked_wrench(self.model, still, body, math.inf)
        except (BellowsError, ArithmeticError, ValueError):
            return None
        if not is_sound:
            return None
        self.outcome, self._retry_ns = outcome, -1
        self.sample = Prediction(stamp_ns, *body[:4], *wrench, tool, strains=body[4:])
        self.settling.begin(stamp_ns, tool)
        self._begin(body)
        return self.sample
