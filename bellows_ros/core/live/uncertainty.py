"""
Predictions, and their covariance by the filter of the observer, which runs without a camera too.

The filter starts with a package that has hung at rest, with the priors of cup and package (see
`states`). Noise of the tool's pose is white from sample to sample. While the tool is extrapolated
its unknown acceleration is added.

A package starts at rest below its tool. If the tool moves then, or if its poses jump implausibly
later, the prediction has an error that decays with the package's modes. Until then the prediction
settles (`Settling`).
"""

from collections.abc import Callable
import math
from typing import NamedTuple

from bellows_ros.core.geometry import tuples as t3
from bellows_ros.core.geometry.arrays import Array
from bellows_ros.core.geometry.jit import entry, kernel
from bellows_ros.core.geometry.tuples import Quaternion, rotation_matrix, Vector, ZERO
from bellows_ros.core.model.kernels import ORIGIN, State, Strains
from bellows_ros.core.observer.correction import Correction, Known
from bellows_ros.core.observer.filter import Estimate
from bellows_ros.core.observer.states import STATE
from bellows_ros.core.observer.track import Track
from bellows_ros.core.signals.trajectory import NS_PER_S
from bellows_ros.errors import BellowsError
import numpy as np

COASTING_STD = np.tile(np.repeat([5.0, 25.0], 3), 2)
"""Standard deviations of the acceleration of an arm without poses: m/s^2, rad/s^2."""

UNKNOWN_ROOT = 1e3 * np.eye(12)
"""Factor of an unknown covariance (m, rad, m/s, rad/s)."""

RETRY_NS = 100_000_000
"""Time until a failed computation is repeated, ns, because a computation takes milliseconds."""

STEP_NS = 4_000_000
"""Shortest step of the filter, ns, short for the package's modes."""

HUNG_NS = 1_000_000_000
"""Time at rest before a start, in which the errors of cup and package displace it, ns."""

MAX_GAP_NS = 500_000_000
"""Longest interval between two predictions of one motion, ns."""


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
    correction : Correction
        Filter with the stated errors of cup, package and tool.

    Attributes
    ----------
    available : bool
        Whether the last factor was not `UNKNOWN_ROOT`.

    """

    def __init__(self, correction: Correction) -> None:
        """Set the filter, which starts at the first prediction."""
        self.available = True
        self._correction, self._track = correction, Track()
        self._now: Estimate | None = None
        self._since: Estimate  # at the begin of the present error of the start
        self._unsettled: Unsettled | None = None

    def covariance(self, prediction: Prediction) -> Array:
        """
        Return the covariance of a prediction (12, 12): pose, then twist, in body axes.

        The state is displacement (m), rotation (rad), linear and angular twist (m/s, rad/s).
        Predictions must be given in the order of their stamps.
        """
        root = self.root(prediction)
        return np.asarray(root @ root.T)

    def root(self, prediction: Prediction) -> Array:
        """Return a factor (12, 12) of the covariance, `UNKNOWN_ROOT` for an undefined one."""
        try:
            observed = prediction.covariance and prediction.covariance()
            return self._rooted(
                self._followed(prediction) if observed is None else observed)
        except (BellowsError, ArithmeticError, ValueError):  # indefinite by rounding
            self.available, self._now = False, None
        return UNKNOWN_ROOT

    def _rooted(self, covariance: Array) -> Array:
        """Return the factor of a covariance, or raise ArithmeticError if it is not finite."""
        root = np.linalg.cholesky(covariance)
        if not np.isfinite(root).all():
            raise ArithmeticError
        self.available = True
        return np.asarray(root)

    def _followed(self, prediction: Prediction) -> Array:
        """Return the covariance (12, 12) of a prediction, with the filter advanced to it."""
        now, stamp_ns = self._now, prediction.stamp_ns
        if now is None or not 0 <= stamp_ns - now.stamp_ns < MAX_GAP_NS:
            self._begin(self._correction.after_hanging(self._begun(prediction), HUNG_NS))
        elif stamp_ns > self._track.newest_ns and not prediction.coasting:
            self._advance(prediction)
        if prediction.unsettled != self._unsettled:
            self._unsettle(prediction.unsettled)
        assert self._now
        P = self._correction.with_noise_of_sample(self._now).covariance[:STATE, :STATE]
        return P + coasting(self._now.stamp_ns, prediction)

    def _begun(self, prediction: Prediction) -> Estimate:
        """Return the estimate of a package with an exact state."""
        theta, P, memory = self._correction.initial
        P = P.copy()
        P[:STATE, :STATE] = 0.0
        return self._correction.start(
            prediction.stamp_ns, prediction.tool, prediction.body, Known(theta, P, memory))

    def _begin(self, estimate: Estimate) -> None:
        """Follow a motion from an estimate on."""
        self._now = self._since = estimate
        self._unsettled = None
        self._track.begin(estimate.stamp_ns)
        self._tool = estimate.tool

    def _advance(self, prediction: Prediction) -> None:
        """Store a prediction, and advance the filter to it if a step has passed."""
        now, track, stamp_ns = self._now, self._track, prediction.stamp_ns
        assert now
        track.discard_before(self._since.stamp_ns)
        track.add(stamp_ns, self._tool, prediction.tool, prediction.body)
        self._tool = prediction.tool
        if stamp_ns - now.stamp_ns < STEP_NS:
            return
        self._now = self._correction.propagated(now, track, stamp_ns)
        if prediction.unsettled is None:
            self._since = self._now
            track.begin(stamp_ns)

    def _unsettle(self, error: Unsettled | None) -> None:
        """Include another error of the start, or of a jump since the last prediction."""
        now, self._unsettled = self._now, error
        assert now
        if error is None:
            return
        if error.since_ns > self._since.stamp_ns:
            self._since = now
        P = self._since.covariance.copy()
        P[:STATE, :STATE] += np.diag(np.square(np.repeat(error[1:], 3)))
        self._now = self._since._replace(covariance=P)
        if now.stamp_ns > self._since.stamp_ns:
            self._now = self._correction.propagated(self._now, self._track, now.stamp_ns)


def coasting(since_ns: int, prediction: Prediction) -> Array:
    """Return the covariance (12, 12) by the acceleration of an extrapolated tool since a stamp."""
    seconds = (prediction.stamp_ns - since_ns) / NS_PER_S if prediction.coasting else 0.0
    return np.diag(np.square(
        np.repeat([0.5 * seconds ** 2, seconds], 6) * COASTING_STD))


def in_world_axes(root: Array, quaternion_xyzw: tuple[float, float, float, float]) -> Array:
    """Return the covariance (6, 6) about fixed world axes (REP-103) of a root in body axes."""
    R = np.reshape(rotation_matrix(quaternion_xyzw), (3, 3))
    turned = np.concatenate([R @ root[:3], R @ root[3:]])
    return np.asarray(turned @ turned.T)


SPAN_NS = 100_000_000
"""Time after a start in which the tool's motion is estimated from three poses, ns."""

MIN_DECAY_RATE = 0.1
"""Smallest assumed decay rate of a package, 1/s."""

MIN_FREQUENCY = 1.0
"""Smallest assumed frequency of a package, rad/s."""


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
        """Set the error to zero."""
        self.now: Unsettled | None = None
        self._samples: list[tuple[int, State]] = []  # after a start, until its motion is estimated
        self._until_ns = 0

    def begin(self, stamp_ns: int, tool: State) -> None:
        """Start at rest below a tool whose motion is not yet estimated."""
        self._samples = [(stamp_ns, tool)]
        # m/s, rad/s, m/s^2, rad/s^2
        self.now = self._error_at_rest(stamp_ns, 0.5, 1.0, 5.0, 25.0)

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
        """Return the time (ns) after which an initial error has decayed, at least 1 s."""
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

    Speed, rate and accelerations follow from quadratics through three poses, s and t seconds after
    the start.
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
