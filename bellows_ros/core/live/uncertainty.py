"""
Covariance of a prediction from the uncertainty of K and P and from noise on the tool's pose.

To first order, with the small motions about the package's rest under the tool as it was at the
start:

- each uncertain entry of K and P drives a sensitivity of the state along the real motion, as the
  wrench is linear in it (4.67);
- noise of the tool's pose, white from sample to sample, gives a constant part: that of a linear
  system driven for a long time;
- while the tool is extrapolated its unknown acceleration is added;
- what a start under a moving tool was off by is followed as it swings out.

Rotation of the axes during the motion is neglected. All in body axes: displacement, rotation,
linear and angular twist. Every part is kept as a root (12, n), whose product with its transpose is
the covariance: positive semidefinite, whatever is rounded. Where the package has no stable rest it
is not known, and says so. The internal strains of a cup that relaxes are 12 states more; noise of
the tool is too quick for them.

A package is started at rest, hanging from its tool. Where the tool moves then, or where its poses
are thrown about later as no arm moves, the prediction is wrong by an amount that dies away with
the package's modes. Until then it is said to settle (`Settling`).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
import math
from typing import Any, NamedTuple

from bellows_ros.core.geometry import tuples as t3
from bellows_ros.core.geometry.arrays import Array
from bellows_ros.core.geometry.jit import kernel
from bellows_ros.core.geometry.lie import hat
from bellows_ros.core.geometry.tuples import rotation_matrix, Vector, ZERO
from bellows_ros.core.live.samples import Prediction, STILL, Unsettled
from bellows_ros.core.model import equilibrium
from bellows_ros.core.model.cup_package import Cup, model_tuple, Package
from bellows_ros.core.model.jacobians import parameter_jacobian
from bellows_ros.core.model.kernels import ModelTuple, ORIGIN, State
from bellows_ros.core.model.perturbed import deviations_of
from bellows_ros.core.model.structure import composition, places_of
from bellows_ros.core.parameters.checks import resolve
from bellows_ros.errors import BellowsError
import numpy as np

STEP_NS = 4_000_000
"""Shortest step (ns) of the sensitivities; the package's modes are slow against it."""

DOUBLINGS = 15
"""Doublings of the horizon for the stationary covariance: 2^15 samples."""

TERMS = 14
"""Of the series of exp, of matrices whose norm is at most a half."""

COASTING = np.tile(np.repeat([5.0, 25.0], 3), 2)
"""Standard deviations (m/s^2, rad/s^2) of what an unobserved arm may do, for pose and twist."""

UNKNOWN_ROOT = 1e3 * np.eye(12)
UNKNOWN = UNKNOWN_ROOT @ UNKNOWN_ROOT.T
"""Stands for an unknown covariance (m^2, rad^2, m^2/s^2, rad^2/s^2)."""

RETRY_NS = 100_000_000
"""Time (ns) until a failed computation, which takes milliseconds, is repeated."""


class Uncertainty:
    """
    Follow predictions and compute their covariance.

    Parameters
    ----------
    model : tuple
        As the kernels take it.
    values : mapping
        Parameters by name: cup.stiffness_std, cup.damping_std, tool_noise.*.

    Attributes
    ----------
    known : bool
        False where the last covariance was `UNKNOWN`.

    """

    def __init__(self, model: ModelTuple, values: Mapping[str, Any]) -> None:
        """Set the uncertainties; the model is linearised at the first prediction."""
        self.known = True
        self._model = model
        self._noise = np.repeat([values['tool_noise.position'], values['tool_noise.rotation']], 3)
        std = deviations_of(values)[:42]  # of the upper triangles of K and of P of one cup
        of_gripper = np.kron(np.eye(2), composition(places_of(values)))
        self._factor = (of_gripper * std)[:, std > 0.0]
        self._sensitivity: Array | None = None
        self._left: Array = np.eye(12)
        self._left_since_ns = -1
        self._last_ns = self._measured_ns = self._tried_ns = -1
        self._period_ns = STEP_NS

    def covariance(self, prediction: Prediction) -> Array:
        """
        Return how sure a prediction is (12, 12): pose, then twist, in body axes.

        Of displacement (m), rotation (rad), linear and angular twist (m/s, rad/s); `UNKNOWN` where
        it is not known. Predictions are to be given in the order of their stamps.
        """
        root = self.root(prediction)
        return np.asarray(root @ root.T)

    def root(self, prediction: Prediction) -> Array:
        """Return a factor (12, n) of the covariance, see above."""
        if not prediction.coasting:
            between = prediction.stamp_ns - self._measured_ns
            if self._measured_ns >= 0 and 0 < between < 100_000_000:  # in powers of two of 1 us
                self._period_ns = 1000 * 2 ** round(math.log2(max(between, 1000) / 1000))
            self._measured_ns = prediction.stamp_ns
        observed = prediction.covariance and prediction.covariance()
        if observed is not None:
            try:
                root = np.asarray(np.linalg.cholesky(observed))
                self.known = True
            except np.linalg.LinAlgError:  # of numbers that differ by as much as doubles can
                root, self.known = UNKNOWN_ROOT, False
            return root
        if not self.known and abs(prediction.stamp_ns - self._tried_ns) < RETRY_NS:
            return UNKNOWN_ROOT
        try:
            root = self._root(prediction)
            self.known = bool(np.isfinite(root).all())
        except (BellowsError, ArithmeticError, ValueError):  # no rest, or none in finite numbers
            self.known = False
        if self.known:
            return root
        self._sensitivity, self._tried_ns = None, prediction.stamp_ns
        return UNKNOWN_ROOT

    def _root(self, prediction: Prediction) -> Array:
        """Return the root of all parts, whether its numbers are finite or not."""
        sensitivity, period_ns = self._sensitivity_at(prediction), self._period_ns
        if period_ns not in self._noise_of:
            self._noise_of[period_ns] = self._driven_by_noise(period_ns * 1e-9)
        parts = [sensitivity[:12], self._noise_of[period_ns][:12]]
        if prediction.coasting:
            seconds = (prediction.stamp_ns - self._measured_ns) * 1e-9
            parts.append(np.diag([0.5 * seconds ** 2] * 6 + [seconds] * 6) * COASTING)
        if prediction.unsettled is not None:
            parts.append(self._left_of(prediction.unsettled, prediction.stamp_ns))
        turn = np.eye(12)  # a twist's error follows the error phi of its axes: v x phi
        turn[6:9, 3:6], turn[9:, 3:6] = hat(prediction.linear), hat(prediction.angular)
        return np.asarray(turn @ np.hstack(parts))

    def _left_of(self, start: Unsettled, stamp_ns: int) -> Array:
        """Return the remainder (12, 12) of earlier errors of a state, one column each."""
        if start.since_ns != self._left_since_ns:
            seconds = max(0.0, (stamp_ns - start.since_ns) * 1e-9)
            self._left, self._left_since_ns = expm(self._A * seconds)[:, :12], start.since_ns
        return np.asarray(self._left[:12] * np.repeat(start[1:], 3))

    def _linearise(self, tool: State) -> None:
        """Take the small motions about the package's rest under a tool."""
        still = ZERO, tool[1], ZERO, ZERO
        rest = equilibrium.static_equilibrium(self._model, still)
        jacobian = equilibrium.linearise(self._model, still, rest)
        self._A = equilibrium.system_matrix(self._model, still, rest)
        self._tool_pose, self._tool_twist = jacobian.tool_pose, jacobian.tool_twist
        self._steps: dict[int, tuple[Array, Array]] = {}
        self._noise_of: dict[int, Array] = {}
        self._left_since_ns = -1

    def _sensitivity_at(self, prediction: Prediction) -> Array:
        """Return d state / d parameter times the parameters' standard deviations, by column."""
        duration_ns = prediction.stamp_ns - self._last_ns
        S = self._sensitivity
        if S is not None and 0 <= duration_ns < STEP_NS:
            return S
        pushes = self._pushes(prediction)
        if S is None or not 0 <= duration_ns < 500_000_000:
            self._linearise(prediction.tool)
            S = np.asarray(np.linalg.solve(self._A, -pushes))  # at rest
        else:
            transition, gain = self._step(duration_ns)
            S = transition @ S + gain @ pushes
            if prediction.unsettled is not None:
                self._left = transition @ self._left
        self._sensitivity, self._last_ns = S, prediction.stamp_ns
        return S

    def _pushes(self, prediction: Prediction) -> Array:
        """Return the slopes of the state due to one standard deviation of each parameter."""
        count = len(self._factor)
        pushes = np.zeros((12 + 6 * len(self._model[0][4:]), count))
        parameter_jacobian(
            self._model, prediction.tool, prediction.body, 0, count, pushes[6:12])
        return np.asarray(pushes @ self._factor)

    def _step(self, duration_ns: int) -> tuple[Array, Array]:
        """Return exp(A h) and its integral, for a duration rounded to 0.1 ms."""
        key = max(1, round(duration_ns / 100_000))
        if key not in self._steps:
            self._steps[key] = self._over(1e-4 * key)
        return self._steps[key]

    def _over(self, seconds: float) -> tuple[Array, Array]:
        """Return exp(A h) and its integral."""
        n = len(self._A)
        both = expm(np.block([[self._A, np.eye(n)], [np.zeros((n, 2 * n))]]) * seconds)
        return both[:n, :n], both[:n, n:]

    def _driven_by_noise(self, period: float) -> Array:
        """
        Return the root after many samples e of noise, each held for a period.

        The tool's twist is the derivative of e. Integrated by parts, its slope B_v acts like the
        slope A B_v of e, and B_v e remains. Of L and T L together a triangle (12, 12) is kept.
        """
        direct, by_pose = np.zeros((2, len(self._A), 6))
        direct[6:12], by_pose[6:12] = self._tool_twist, self._tool_pose
        drive = by_pose + self._A @ direct
        transition, gain = self._over(period)
        root: Array = gain @ drive * self._noise
        for _ in range(DOUBLINGS):
            _, R = np.linalg.qr(np.hstack([root, transition @ root]).T)
            root = R.T
            transition = transition @ transition
        return np.asarray(np.hstack([root, direct * self._noise]))


def expm(M: Array) -> Array:
    """Return exp(M) by its series after halving, to rounding; SciPy's takes 0.3 s to load."""
    halvings = max(0, math.frexp(float(np.abs(M).sum(axis=1).max()))[1] + 1)
    term = result = np.eye(len(M))
    for k in range(1, TERMS):
        term = term @ M / (k * 2.0 ** halvings)
        result = result + term
    return np.asarray(np.linalg.matrix_power(result, 2 ** halvings))


def warm_up_uncertainty(relaxation: tuple[float, float] = (0.0, 0.0)) -> None:
    """Compile all that a covariance needs, with a model that has one."""
    package = Package(1.0, 0.01 * np.eye(3), np.array([0.0, 0.0, -0.03]))
    model = model_tuple(replace(Cup.thesis(), relaxation=relaxation), package, 9.81)
    values = resolve({
        'cup.stiffness_std': (1.0,) * 36, 'cup.damping_std': (1.0,) * 36,
        'tool_noise.position': 1.0, 'tool_noise.rotation': 1.0})
    strains = equilibrium.adapted(model, ORIGIN, ORIGIN)[4:]
    Uncertainty(model, values).covariance(STILL._replace(strains=strains))


def in_world_axes(root: Array, quaternion_xyzw: tuple[float, float, float, float]) -> Array:
    """Return the covariance (6, 6) about fixed world axes (REP-103) of a root in body axes."""
    R = np.reshape(rotation_matrix(quaternion_xyzw), (3, 3))
    turned = np.concatenate([R @ root[:3], R @ root[3:]])
    return np.asarray(turned @ turned.T)


SPAN_NS = 100_000_000
"""Time (ns) after a start, in two halves, in which the tool's motion becomes known."""

UNSEEN = 0.5, 1.0, 5.0, 25.0
"""What a tool may do before it is observed: m/s, rad/s, m/s^2, rad/s^2."""

SMALL, SMALL_TURN = 1e-3, 5e-3
"""Errors (m, rad) below this are negligible."""

SLOWEST_DECAY, SLOWEST_MODE = 0.1, 1.0
"""Smallest decay rate (1/s) and frequency (rad/s) assumed of any package."""


class Modes(NamedTuple):
    """How a package moves a little about its rest."""

    decay: float
    """Of the mode that dies away slowest, 1/s."""
    frequency: float
    """Of the slowest mode, rad/s."""
    compliance: tuple[float, float, float]
    """Shift (m) and turn (rad) by 1 m/s^2 of the tool, and turn by 1 rad/s^2 of it."""


def modes_of(system: Array) -> Modes:
    """Return the modes of the small motions with a system matrix (12, 12), without relaxation."""
    eigenvalues = np.linalg.eigvals(system)
    compliance = np.linalg.inv(system[6:, :6])
    by_shift, by_turn, turn_by_turn = (float(np.linalg.norm(part, 2)) for part in (
        compliance[:3, :3], compliance[3:, :3], compliance[3:, 3:]))
    return Modes(
        max(SLOWEST_DECAY, -float(eigenvalues.real.max())),
        max(SLOWEST_MODE, float(np.abs(eigenvalues).min())),
        (by_shift, by_turn, turn_by_turn))


class Settling:
    """
    Track the error of the state after a start or after doubtful poses.

    Attributes
    ----------
    now : Unsettled or None
        None where nothing of it is left.
    modes : Modes
        Of the package, to be set first; with those of another one a running decay keeps its end.

    """

    def __init__(self) -> None:
        """Know of no package."""
        self.modes: Modes
        self.forget()

    def forget(self) -> None:
        """Know of no package."""
        self.now: Unsettled | None = None
        self._seen: list[tuple[int, State]] = []  # after a start, until it shows how it moves
        self._until_ns = 0

    def begin(self, stamp_ns: int, tool: State) -> None:
        """Note a start at rest below a tool whose motion is not yet known."""
        self._seen = [(stamp_ns, tool)]
        self.now = self._left_by(stamp_ns, *UNSEEN)

    def inflate(self, stamp_ns: int, shift: float, turn: float) -> None:
        """Note that the tool was shifted (m) and turned (rad) as no arm moves."""
        before = self.now or Unsettled(stamp_ns, 0.0, 0.0, 0.0, 0.0)
        self.now = before._replace(
            since_ns=stamp_ns, shift=max(shift, before.shift), turn=max(turn, before.turn))
        self._seen = []
        self._until_ns = stamp_ns + self._duration_ns(self.now)

    def follow(self, stamp_ns: int, tool: State) -> Unsettled | None:
        """Return the remaining error at a sample of the tool."""
        if self.now is None:
            return None
        if self._seen:
            self._watch(stamp_ns, tool)
        elif stamp_ns >= self._until_ns:
            self.now = None
        return self.now

    def _watch(self, stamp_ns: int, tool: State) -> None:
        """Measure the tool's motion after a start, from three poses."""
        start_ns, start = self._seen[0]
        since_ns = stamp_ns - start_ns
        if len(self._seen) == 1:
            if 2 * since_ns >= SPAN_NS:
                self._seen.append((stamp_ns, tool))
        elif since_ns >= SPAN_NS:
            middle_ns, middle = self._seen[1]
            self._seen = []
            self.now = left = self._left_by(start_ns, *motion_through(
                start, middle, tool, (middle_ns - start_ns) * 1e-9, since_ns * 1e-9))
            self._until_ns = start_ns + self._duration_ns(left)

    def _left_by(
        self, stamp_ns: int, speed: float, rate: float, acceleration: float, turning: float
    ) -> Unsettled:
        """Return the error of assuming rest below a moving tool."""
        by_shift, by_turn, turn_by_turn = self.modes.compliance
        turn = by_turn * acceleration + turn_by_turn * turning
        return Unsettled(stamp_ns, by_shift * acceleration, turn, speed, rate)

    def _duration_ns(self, left: Unsettled) -> int:
        """Return how long (ns) it takes until an error counts no more."""
        swing = 1.0 / self.modes.frequency
        parts = (
            (left.shift + swing * left.speed) / SMALL,
            (left.turn + swing * left.rate) / SMALL_TURN,
        )
        return round(1e9 * math.log(max(1.0, *parts)) / self.modes.decay)


@kernel
def motion_through(
    start: State, middle: State, end: State, s: float, t: float
) -> tuple[float, float, float, float]:
    """
    Return speed (m/s), rate (rad/s) at the start, and accelerations (m/s^2, rad/s^2).

    Of quadratics through three poses, s and t seconds after the start.
    """
    v, a = quadratic(
        t3.subtract(middle[0], start[0]), t3.subtract(end[0], start[0]), s, t)
    w, b = quadratic(
        t3.turn_between(start[1], middle[1]), t3.turn_between(start[1], end[1]), s, t)
    return t3.norm(v), t3.norm(w), t3.norm(a), t3.norm(b)


@kernel
def quadratic(x: Vector, y: Vector, s: float, t: float) -> tuple[Vector, Vector]:
    """Return slope at 0 and second derivative of the quadratic from 0 through x at s, y at t."""
    half = t3.scale(1.0 / (t - s), t3.add_scaled(t3.scale(1.0 / t, y), -1.0 / s, x))
    return t3.add_scaled(t3.scale(1.0 / s, x), -s, half), t3.scale(2.0, half)
