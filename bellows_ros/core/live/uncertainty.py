"""
Predictions, and their covariance from uncertain K and P and from noise on the tool's pose.

The covariance is of first order, from the small motions about the package's rest under the initial
tool:

- each uncertain entry of K and P drives a sensitivity of the state along the real motion, as the
  wrench is linear in it (4.67);
- noise of the tool's pose, white from sample to sample, gives a constant part, the covariance of a
  linear system in steady state;
- while the tool is extrapolated its unknown acceleration is added;
- the initial error under a moving tool is followed as it swings out.

Rotation of the axes during the motion is neglected. All numbers are in body axes: displacement,
rotation, linear and angular twist. Every part is stored as a root (12, n), whose product with its
transpose is the covariance, positive semidefinite in spite of rounding. Without a stable rest of
the package there is no covariance (`available`). A cup that relaxes has 12 more states, its
internal strains, on which noise of the tool has no effect.

A package starts at rest below its tool. If the tool moves then, or if its poses jump implausibly
later, the prediction has an error that decays with the package's modes. Until then the prediction
settles (`Settling`).
"""

from collections.abc import Callable, Sequence
from copy import copy
from dataclasses import replace
from functools import cache, partial
import math
from typing import NamedTuple

from bellows_ros.core.geometry import tuples as t3
from bellows_ros.core.geometry.arrays import Array
from bellows_ros.core.geometry.jit import entry, kernel
from bellows_ros.core.geometry.lie import hat
from bellows_ros.core.geometry.tuples import Quaternion, rotation_matrix, Vector, ZERO
from bellows_ros.core.model import equilibrium
from bellows_ros.core.model.cup_package import Cup, model_tuple, Package
from bellows_ros.core.model.jacobians import parameter_jacobian
from bellows_ros.core.model.kernels import ModelTuple, ORIGIN, State, Strains
from bellows_ros.core.model.structure import composition
from bellows_ros.core.parameters.checks import resolve
from bellows_ros.core.parameters.conversion import parameter_std, places_of
from bellows_ros.core.parameters.values import Values
from bellows_ros.core.signals.trajectory import NS_PER_S
from bellows_ros.errors import BellowsError
import numpy as np

STEP_NS = 4_000_000
"""Shortest step of the sensitivities, ns, short for the package's modes."""

COASTING_STD = np.tile(np.repeat([5.0, 25.0], 3), 2)
"""Standard deviations of an unobserved arm's acceleration, for pose and twist, m/s^2 and
rad/s^2."""

UNKNOWN_ROOT = 1e3 * np.eye(12)
"""Factor of an unknown covariance (m, rad, m/s, rad/s)."""

RETRY_NS = 100_000_000
"""Time until a failed computation, which takes milliseconds, is repeated, ns."""


class Unsettled(NamedTuple):
    """Possible error of the package's state at one time, in each direction."""

    since_ns: int
    shift: float
    """m."""
    rotation: float
    """rad."""
    speed: float
    """m/s."""
    rate: float
    """rad/s."""


class Prediction(NamedTuple):
    """The package at one stamp; SI units."""

    stamp_ns: int
    position: Vector
    """Origin of B in the world, m."""
    quaternion_xyzw: Quaternion
    """Orientation of B in the world."""
    linear: Vector
    """Linear body twist, R^T do/dt, in B axes, m/s."""
    angular: Vector
    """Body rate in B axes, rad/s."""
    force: Vector
    """Force of the cup on the package, in lip axes, N."""
    moment: Vector
    """Moment of the cup on the package about the lip's centre, in lip axes, N m."""
    tool: State = ORIGIN
    """Pose and body twist of the tool used for the prediction."""
    coasting: bool = False
    """Whether the tool is extrapolated for lack of poses."""
    unsettled: Unsettled | None = None
    """Remaining error of the start or of doubtful poses; None without."""
    covariance: Callable[[], Array | None] | None = None
    """Function that returns the covariance of the state (12, 12), in body axes, if an observer
    provides it."""
    strains: Strains = ()
    """Internal strains of the cup, if it relaxes."""
    flies: bool = False
    """Whether the cup has released the package."""

    @property
    def body(self) -> State:
        """Pose and body twist of the package, as the kernels take them."""
        return (self.position, self.quaternion_xyzw, self.linear, self.angular, *self.strains)


STILL = Prediction(1, *ORIGIN, ZERO, ZERO)
"""Prediction for a package of unknown state."""


class Uncertainty:
    """
    Covariance of predictions.

    Parameters
    ----------
    model : tuple
        Model for the kernels.
    values : mapping
        Parameters by name: cup.stiffness_std, cup.damping_std, tool_noise.*.

    Attributes
    ----------
    available : bool
        Whether the last factor was not `UNKNOWN_ROOT`.

    """

    def __init__(self, model: ModelTuple, values: Values) -> None:
        """Set the uncertainties; the model is linearised at the first prediction."""
        self.available = True
        self._model = model
        self._noise = np.repeat([values.tool_noise.position, values.tool_noise.rotation], 3)
        std = parameter_std(values)[:42]  # of the upper triangles of K and of P of one cup
        of_gripper = np.kron(np.eye(2), composition(places_of(values)))
        self._factor = (of_gripper * std)[:, std > 0.0]
        self._sensitivity: Array | None = None
        self._transient: Array = np.eye(12)
        self._transient_since_ns = self._last_ns = self._measured_ns = self._tried_ns = -1
        self._period_ns = STEP_NS

    def covariance(self, prediction: Prediction) -> Array:
        """
        Return the covariance of a prediction (12, 12): pose, then twist, in body axes.

        The state is displacement (m), rotation (rad), linear and angular twist (m/s, rad/s).
        Predictions must be given in the order of their stamps.
        """
        root = self.root(prediction)
        return np.asarray(root @ root.T)

    def root(self, prediction: Prediction) -> Array:
        """Return a factor (12, n) of the covariance, `UNKNOWN_ROOT` for an undefined one."""
        stamp_ns = prediction.stamp_ns
        if not prediction.coasting:
            interval = stamp_ns - self._measured_ns
            if self._measured_ns >= 0 and 0 < interval < 100_000_000:  # rounded to 2^n us
                self._period_ns = 1000 * 2 ** round(math.log2(max(interval, 1000) / 1000))
            self._measured_ns = stamp_ns
        observed = prediction.covariance and prediction.covariance()
        if observed is None and not self.available and abs(stamp_ns - self._tried_ns) < RETRY_NS:
            return UNKNOWN_ROOT
        try:
            root = self._root(prediction) if observed is None else np.asarray(
                np.linalg.cholesky(observed))
            self.available = bool(np.isfinite(root).all())
        except (BellowsError, ArithmeticError, ValueError):  # no rest, or indefinite by rounding
            self.available = False
        if self.available:
            return root
        if observed is None:
            self._sensitivity, self._tried_ns = None, stamp_ns
        return UNKNOWN_ROOT

    def later(self, now: Prediction, future: Sequence[Prediction]) -> Array:
        """Return `root` at the end of a predicted motion, without changing the sensitivities."""
        ahead = copy(self)
        observed = None if ahead.root(now) is UNKNOWN_ROOT or not now.covariance else (
            now.covariance())
        try:
            for prediction in future:
                ahead._sensitivity_at(prediction)
            root = ahead._root(future[-1])
            if observed is not None:
                seconds = (future[-1].stamp_ns - now.stamp_ns) / NS_PER_S
                root = np.hstack([root, expm(ahead._A * seconds)[:12, :12] @ np.linalg.cholesky(
                    observed)])
        except (BellowsError, ArithmeticError, ValueError):
            return UNKNOWN_ROOT
        return root if np.isfinite(root).all() else UNKNOWN_ROOT

    def _root(self, prediction: Prediction) -> Array:
        """Return the factor of all parts, possibly not finite."""
        parts = [self._sensitivity_at(prediction)[:12]]
        parts.append(self._noise_root(self._period_ns / NS_PER_S)[:12])
        if prediction.coasting:
            seconds = (prediction.stamp_ns - self._measured_ns) / NS_PER_S
            parts.append(np.diag([0.5 * seconds ** 2] * 6 + [seconds] * 6) * COASTING_STD)
        if start := prediction.unsettled:  # remaining initial errors, one column each
            if start.since_ns != self._transient_since_ns:
                seconds = max(0.0, (prediction.stamp_ns - start.since_ns) / NS_PER_S)
                self._transient = expm(self._A * seconds)[:, :12]
                self._transient_since_ns = start.since_ns
            parts.append(self._transient[:12] * np.repeat(start[1:], 3))
        transform = np.eye(12)  # a twist's error by the error phi of its axes: v x phi
        transform[6:9, 3:6], transform[9:, 3:6] = hat(prediction.linear), hat(prediction.angular)
        return np.asarray(transform @ np.hstack(parts))

    def _linearise(self, tool: State) -> None:
        """Linearise the small motions about the package's rest under a tool."""
        still = ZERO, tool[1], ZERO, ZERO
        rest = equilibrium.static_equilibrium(self._model, still)
        jacobian = equilibrium.linearise(self._model, still, rest)
        self._A = equilibrium.system_matrix(self._model, still, rest)
        self._propagation = cache(partial(propagation, self._A))
        self._noise_root = cache(partial(
            noise_root, self._A, jacobian.tool_pose, jacobian.tool_twist, self._noise))
        self._transient_since_ns = -1

    def _sensitivity_at(self, prediction: Prediction) -> Array:
        """Return d state / d parameter times the parameters' standard deviations, by column."""
        duration_ns = prediction.stamp_ns - self._last_ns
        S = self._sensitivity
        if S is not None and 0 <= duration_ns < STEP_NS:
            return S
        count = len(self._factor)
        slopes = np.zeros((12 + 6 * len(self._model[0][4:]), count))
        parameter_jacobian(
            self._model, prediction.tool, prediction.body, 0, count, slopes[6:12])
        forcing = slopes @ self._factor
        if S is None or not 0 <= duration_ns < 500_000_000:
            self._linearise(prediction.tool)
            S = np.asarray(np.linalg.solve(self._A, -forcing))  # at rest
        else:
            transition, gain = self._propagation(1e-4 * max(1, round(duration_ns / 100_000)))
            S = transition @ S + gain @ forcing
            if prediction.unsettled is not None:
                self._transient = transition @ self._transient
        self._sensitivity, self._last_ns = S, prediction.stamp_ns
        return S


def propagation(A: Array, seconds: float) -> tuple[Array, Array]:
    """Return exp(A h) and its integral."""
    n = len(A)
    both = expm(np.block([[A, np.eye(n)], [np.zeros((n, 2 * n))]]) * seconds)
    return both[:n, :n], both[:n, n:]


def noise_root(
    A: Array, tool_pose: Array, tool_twist: Array, noise: Array, period: float
) -> Array:
    """
    Return the factor of the covariance by many samples e of noise, each held for a period.

    The tool's twist is de/dt with slope B_v. Integration by parts replaces B_v de/dt by the input
    A B_v e and the boundary term B_v e. L and T L are reduced to one triangle (12, 12).
    """
    direct, by_pose = np.zeros((2, len(A), 6))
    direct[6:12], by_pose[6:12] = tool_twist, tool_pose
    transition, gain = propagation(A, period)
    root: Array = gain @ (by_pose + A @ direct) * noise
    for _ in range(15):  # a horizon of 2^15 samples
        root = np.linalg.qr(np.hstack([root, transition @ root]).T)[1].T
        transition = transition @ transition
    return np.asarray(np.hstack([root, direct * noise]))


def expm(M: Array) -> Array:
    """Return exp(M) by a series with halving, to rounding; SciPy's takes 0.3 s to load."""
    halvings = max(0, math.frexp(float(np.abs(M).sum(axis=1).max()))[1] + 1)
    term = result = np.eye(len(M))
    for k in range(1, 14):  # the norm is at most 0.5
        term = term @ M / (k * 2.0 ** halvings)
        result = result + term
    return np.asarray(np.linalg.matrix_power(result, 2 ** halvings))


def warm_up_uncertainty(relaxation: tuple[float, float] = (0.0, 0.0)) -> None:
    """Compile all kernels of a covariance, with a model that has one."""
    package = Package(1.0, 0.01 * np.eye(3), np.array([0.0, 0.0, -0.03]))
    model = model_tuple(replace(Cup.thesis(), relaxation=relaxation), package, 9.81)
    values = resolve({
        'cup.stiffness_std': (1.0,) * 36, 'cup.damping_std': (1.0,) * 36,
        'tool_noise.position': 1.0, 'tool_noise.rotation': 1.0, 'package.mass': 1.0})
    strains = equilibrium.adapted(model, ORIGIN, ORIGIN)[4:]
    Uncertainty(model, values).covariance(STILL._replace(strains=strains))


def in_world_axes(root: Array, quaternion_xyzw: tuple[float, float, float, float]) -> Array:
    """Return the covariance (6, 6) about fixed world axes (REP-103) of a root in body axes."""
    R = np.reshape(rotation_matrix(quaternion_xyzw), (3, 3))
    turned = np.concatenate([R @ root[:3], R @ root[3:]])
    return np.asarray(turned @ turned.T)


SPAN_NS = 100_000_000
"""Time after a start for the estimate of the tool's motion, in two halves, ns."""

MIN_DECAY_RATE, MIN_FREQUENCY = 0.1, 1.0
"""Smallest assumed decay rate (1/s) and frequency (rad/s) of a package."""


class Modes(NamedTuple):
    """Small motions of a package about its rest."""

    decay: float
    """Decay rate of the least damped mode, 1/s."""
    frequency: float
    """Frequency of the slowest mode, rad/s."""
    compliance: tuple[float, float, float]
    """Shift (m) and rotation (rad) per m/s^2 of the tool, and rotation per rad/s^2 of the tool."""


def modes_of(system: Array) -> Modes:
    """Return the modes of the small motions with a system matrix (12, 12), without relaxation."""
    eigenvalues = np.linalg.eigvals(system)
    compliance = np.linalg.inv(system[6:, :6])
    shift, angle, by_angular = (float(np.linalg.norm(part, 2)) for part in (
        compliance[:3, :3], compliance[3:, :3], compliance[3:, 3:]))
    return Modes(max(MIN_DECAY_RATE, -float(eigenvalues.real.max())),
                 max(MIN_FREQUENCY, float(np.abs(eigenvalues).min())), (shift, angle, by_angular))


class Settling:
    """
    Error of the state after a start or after doubtful poses.

    Attributes
    ----------
    now : Unsettled or None
        Remaining error of the state, None once decayed.
    modes : Modes
        Modes of the package, to be set first; a running decay keeps its end when they change.

    """

    def __init__(self) -> None:
        self.modes: Modes
        self.clear()

    def clear(self) -> None:
        self.now: Unsettled | None = None
        self._samples: list[tuple[int, State]] = []  # after a start, until its motion is estimated
        self._until_ns = 0

    def begin(self, stamp_ns: int, tool: State) -> None:
        """Start at rest below a tool whose motion is not yet estimated."""
        self._samples = [(stamp_ns, tool)]
        # m/s, rad/s, m/s^2, rad/s^2
        self.now = self._error_at_rest(stamp_ns, 0.5, 1.0, 5.0, 25.0)

    def inflate(self, stamp_ns: int, shift: float, rotation: float) -> None:
        """Add an implausible shift (m) and rotation (rad) of the tool to the error."""
        before = self.now or Unsettled(stamp_ns, 0.0, 0.0, 0.0, 0.0)
        self.now = before._replace(
            since_ns=stamp_ns, shift=max(shift, before.shift),
            rotation=max(rotation, before.rotation))
        self._samples = []
        self._until_ns = stamp_ns + self._duration_ns(self.now)

    def update(self, stamp_ns: int, tool: State) -> Unsettled | None:
        """Return the remaining error at a sample of the tool; after a start estimate its twist."""
        if self._samples:
            start_ns, start = self._samples[0]
            since_ns = stamp_ns - start_ns
            if len(self._samples) == 1:
                if 2 * since_ns >= SPAN_NS:
                    self._samples.append((stamp_ns, tool))
            elif since_ns >= SPAN_NS:
                middle_ns, middle = self._samples[1]
                self._samples = []
                self.now = self._error_at_rest(start_ns, *motion_through(
                    start, middle, tool, (middle_ns - start_ns) / NS_PER_S, since_ns / NS_PER_S))
                self._until_ns = start_ns + self._duration_ns(self.now)
        elif self.now is not None and stamp_ns >= self._until_ns:
            self.now = None
        return self.now

    def since(self, stamp_ns: int) -> int:
        """Return the time (ns) after which an initial error has decayed, or 1 s."""
        return stamp_ns - self.now.since_ns if self.now else 1_000_000_000

    def _error_at_rest(
        self, stamp_ns: int, speed: float, rate: float, acceleration: float, turning: float
    ) -> Unsettled:
        """Return the error of assuming rest below a moving tool."""
        shift, rotation, by_angular = self.modes.compliance
        rotation = rotation * acceleration + by_angular * turning
        return Unsettled(stamp_ns, shift * acceleration, rotation, speed, rate)

    def _duration_ns(self, error: Unsettled) -> int:
        """Return the time (ns) until an error is negligible."""
        swing = 1.0 / self.modes.frequency
        # negligible, m and rad
        ratio = max(1.0, (error.shift + swing * error.speed) / 1e-3,
                    (error.rotation + swing * error.rate) / 5e-3)
        return round(NS_PER_S * math.log(ratio) / self.modes.decay)


@entry
def motion_through(
    start: State, middle: State, end: State, s: float, t: float
) -> tuple[float, float, float, float]:
    """
    Return speed (m/s), rate (rad/s) at the start, and accelerations (m/s^2, rad/s^2).

    They follow from quadratics through three poses, s and t seconds after the start.
    """
    v, a = quadratic(
        t3.subtract(middle[0], start[0]), t3.subtract(end[0], start[0]), s, t)
    w, b = quadratic(
        t3.rotation_between(start[1], middle[1]), t3.rotation_between(start[1], end[1]), s, t)
    return t3.norm(v), t3.norm(w), t3.norm(a), t3.norm(b)


@kernel
def quadratic(x: Vector, y: Vector, s: float, t: float) -> tuple[Vector, Vector]:
    """Return slope at 0 and second derivative of the quadratic from 0 through x at s, y at t."""
    half = t3.scale(1.0 / (t - s), t3.add_scaled(t3.scale(1.0 / t, y), -1.0 / s, x))
    return t3.add_scaled(t3.scale(1.0 / s, x), -s, half), t3.scale(2.0, half)
