"""
Design of the motion with the most information on K and P, within limits of arm, grip and cup.

The motion is a Fourier series in each axis, with ramps at both ends. The coefficients maximise the
determinant of the Fisher information (D-optimal) of small motions, for the guess of K and for a
softer and a stiffer one (`GUESS_FACTORS`). The coefficients are divided by the largest ratio of a
signal to its limit, a p-norm over limits and time, so only the shape of the motion is searched.
After each pass the nonlinear model simulates the motion, and corrects the limits of the loads in
the linear model. The most informative pass is scaled to satisfy all limits.

The information of a motion is the information of an output error fit, computed by the same code:
pose differences are whitened by the noise of both bodies (see `identification.whitening`). For
small motions the linear response gives the information fast enough for a search.
"""

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
import math
from typing import Any, NamedTuple

from bellows_ros.core.geometry import lie
from bellows_ros.core.geometry.arrays import Array
from bellows_ros.core.identification.information import covariance_of
from bellows_ros.core.identification.problem import Problem
from bellows_ros.core.identification.segments import MeasuredSegment, Segment
from bellows_ros.core.model.cup_package import Cup, gripper_of, model_tuple, Package
from bellows_ros.core.model.equilibrium import linearise, pose_error, static_equilibrium
from bellows_ros.core.model.grip import Grip
from bellows_ros.core.model.kernels import ModelTuple, State
from bellows_ros.core.model.simulation import simulate, state_row
from bellows_ros.core.model.structure import Structure
from bellows_ros.core.model.validity_range import TYPICAL_BENDING
from bellows_ros.core.parameters.checks import Settings
from bellows_ros.core.planning.arm import Arm
from bellows_ros.core.planning.limits import largest_rates, read_rates
from bellows_ros.core.planning.plan_prediction import PlanSimulation
from bellows_ros.core.recording.recording import BodyNoise, Noise, TOOL_HALF_WINDOW, TOOL_ORDER
from bellows_ros.core.signals.savgol import weights
from bellows_ros.core.signals.trajectory import Trajectory
from bellows_ros.core.synthetic import motion as moving
from bellows_ros.core.synthetic.motion import Motion, Pose
from bellows_ros.errors import BellowsError
import numpy as np
import scipy  # whose parts are loaded as they are used

CHECK_RATE = 1000.0
"""Rate at which limits are checked, Hz."""
MAX_FREQUENCY = 12.0
"""Default highest frequency of real arms, Hz."""

REST = 2.0
"""Duration of the initial rest, s."""
RAMP = 1.0
"""Duration of each ramp of the amplitude, s."""

GUESS_FACTORS = (1.0, 0.7, 1.3)
"""Ratios of the true K to its guess for which the limits hold."""

STAGES = ((16, 1000), (64, 400), (64, 400))
"""Stages of the search: exponent of the p-norm over the ratios to limits, and largest number of
steps."""

MIN_GAIN = 1e-6
"""Relative gain of a step below which the search ends."""
MARGIN = 1e-3
"""Relative margin to a limit."""

HOLD = 7.0
"""Default duration of the hold for the relaxation of rubber, s."""
SAMPLES_AT_ONCE = 4096
"""Number of samples of a motion that are computed together, which limits the memory."""

DIFFERENCE = 1e-4
"""Step of numerical derivatives by parameters, in units of their scale."""

LOADS = ('bending', 'torsion', 'safety factor (peel)', 'safety factor (slip)')

Progress = Callable[[str, float], None]


class Bound(NamedTuple):
    """
    A limit (above 0) on the length of a linear function of the tool's displacement.

    The displacement (6: m in world axes, rotation vector in rad) is differentiated `order` times
    by time before the rows (d, 6) are applied.
    """

    name: str
    order: int
    rows: Array
    limit: float


class ArmLimits(NamedTuple):
    """
    Limits of an arm, SI units.

    Parameters
    ----------
    start : Pose
        Pose of E, at rest and in the middle of the motion.
    lower, upper : array (3,)
        Corners of the workspace in the world, m.
    rotation : array (3,)
        Largest components of the rotation vector from the start, rad.
    rates : mapping of str to float
        Largest speed, acceleration and jerk, and the angular ones, as in `planning.limits.RATES`.
    bending, torsion : float
        Largest bending and torsion of the cup, rad.
    safety : float
        Smallest safety factor of the grip.
    highest_frequency : float
        Highest frequency of the motion, Hz.
    arm : Arm or None
        Arm whose ranges and speeds of joints are limits, too.
    joints : array (M,)
        Positions of the arm's moving joints at the start.

    """

    start: Pose
    lower: Array
    upper: Array
    rotation: Array
    rates: Mapping[str, float]
    bending: float
    torsion: float
    safety: float
    highest_frequency: float
    arm: Arm | None
    joints: Array

    @property
    def axes(self) -> Array:
        """Map (6, 6) from displacements of the tool to its axes at the start."""
        turned = np.eye(6)
        turned[:3, :3] = self.start.rotation.T
        return turned

    def bounds(self) -> list[Bound]:
        """Limits on the tool; limits of joints are linearised about the start."""
        eye, start = np.eye(6), self.start.position
        headroom = np.concatenate(
            [np.minimum(self.upper - start, start - self.lower), self.rotation]).tolist()
        bounds = [Bound('workspace' if i < 3 else 'rotation', 0, eye[i:i + 1], headroom[i])
                  for i in range(6)]
        for i, (name, limit) in enumerate(self.rates.items()):
            part = slice(3) if i < 3 else slice(3, 6)
            bounds.append(Bound(name.replace('_', ' '), 1 + i % 3, eye[part], limit))
        if self.arm is not None:
            rows = np.linalg.pinv(self.arm.jacobian(self.joints[None])[0], rcond=1e-3) @ self.axes
            for joint, row, at in zip(self.arm.moving_joints, rows, self.joints, strict=True):
                ends = min(joint.upper - at, at - joint.lower)
                bounds += [
                    Bound(f'{joint.name} {what}', order, row[None], float(limit))
                    for what, order, limit in (('range', 0, ends), ('speed', 1, joint.speed))
                    if math.isfinite(limit)]
        return bounds

    def ratios(self, motion: Motion) -> dict[str, float]:
        """Return the ratios of a motion to each limit, at `CHECK_RATE`."""
        tool = motion.at_rate(CHECK_RATE)
        o, R = tool.position, tool.rotation
        shift, rotation = o - self.start.position, lie.log_so3(self.start.rotation.T @ R)
        headroom = np.where(shift > 0.0, self.upper - self.start.position,
                            self.start.position - self.lower)
        ratios = {'workspace': np.abs(shift / headroom).max(),
                  'rotation': np.abs(rotation / self.rotation).max()}
        for name, peak in largest_rates(R, np.asarray(tool.twist), 1.0 / CHECK_RATE).items():
            ratios[name.replace('_', ' ')] = peak / self.rates[name]
        if self.arm is not None:
            coarse = slice(None, None, round(CHECK_RATE / 250.0))  # Hz
            joints = self.arm.positions(lie.transform(R[coarse], o[coarse]), self.joints)
            spline = scipy.interpolate.CubicSpline(tool.seconds[coarse], joints)
            q, speed = spline(tool.seconds), spline(tool.seconds, 1)
            for joint, at, position, rate in zip(
                    self.arm.moving_joints, self.joints, q.T, speed.T, strict=True):
                headroom = np.where(position > at, joint.upper - at, at - joint.lower)
                ratios[f'{joint.name} range'] = np.abs((position - at) / headroom).max()
                ratios[f'{joint.name} speed'] = np.abs(rate).max() / joint.speed
        return {name: float(ratio) for name, ratio in ratios.items()}


def limits_from(
    content: Mapping[str, Any], safety: float, arm: Arm | None = None
) -> tuple[ArmLimits, Settings]:
    """
    Return the limits in a file, and the tracking of both bodies, for a separate reader.

    Parameters
    ----------
    content : mapping
        Content as explained in config/limits_example.yaml.
    safety : float
        Default of the smallest safety factor of the grip.
    arm : Arm, optional
        Arm whose `joints` at the start are given instead of `start`.

    Raises
    ------
    BellowsError
        If a setting is missing, unknown or not allowed, or the start is outside of the limits.

    """
    settings = Settings(content)
    joints = np.zeros(0)
    if arm is None:
        start = moving.pose_from(settings.block('start'))
    else:
        block = settings.block('joints')
        joints = np.array([block.number(name, unit='rad or m') for name in arm.moving])
        for joint, at in zip(arm.moving_joints, joints.tolist(), strict=True):
            if not joint.lower < at < joint.upper:
                raise block.refuse(joint.name, f'in its range, {joint.lower:g} to '
                                   f'{joint.upper:g}', at)
        T = arm.tool(joints[None])[0][0]
        start = Pose(T[:3, 3], T[:3, :3])
    space = settings.block('workspace')
    rotation, box = space.vector('rotation', 3, unit='rad'), settings.block('excitation')
    lower, upper = (
        box.vector(name, 3, tuple(space.vector(name, 3, unit='m')), 'm')
        for name in ('lower', 'upper'))
    if not ((lower < start.position) & (start.position < upper)).all() or rotation.min() <= 0.0:
        raise settings.error(
            'workspace', f"The start {start.position.tolist()} m is not inside of 'workspace' or "
            f"'excitation' ({lower.tolist()} to {upper.tolist()} m), or 'workspace.rotation' is "
            'not above 0. Move the start or widen the box.')
    limits = ArmLimits(
        start, lower, upper, rotation, read_rates(settings),
        settings.number('bending', TYPICAL_BENDING, 'rad', above=0.0, maximum=0.5 * math.pi),
        settings.number('torsion', math.radians(30.0), 'rad', above=0.0, maximum=0.5 * math.pi),
        settings.number('safety_factor', safety, minimum=0.0),
        settings.number('highest_frequency', MAX_FREQUENCY, 'Hz', above=0.0, maximum=50.0),
        arm, joints)
    tracking = settings.block('tracking')
    settings.done(ignored=('tracking', 'joint_acceleration'))
    return limits, tracking


class Tracking(NamedTuple):
    """Periods of the poses (s) and their white noise, of tool and package."""

    tool_period: float
    tool: Noise
    package_period: float
    package: Noise


def motion_information(
    cup: Cup, package: Package, gravity: Array | float, tool: Trajectory, tracking: Tracking,
    structure: Structure,
) -> Array:
    """
    Return the information (2 n, 2 n) of a motion on the n parameters of K and n of P.

    Parameters
    ----------
    cup, package, gravity
        Model, as `simulate` takes it.
    tool : Trajectory
        Motion of E with body twists from rest, at the stamps of the tracked package.
    tracking : Tracking
        Tracking of both bodies.
    structure : Structure
        Structure of K and P.

    """
    body = simulate(gripper_of(cup, structure.places), package, tool, gravity=gravity)
    density = np.sqrt(tracking.tool_period / tracking.package_period)
    of_tool, of_package = (BodyNoise(np.repeat(std, 3)) for std in (
        density * np.array(tracking.tool), tracking.package))
    measured = MeasuredSegment(tool, body, package, gravity, of_tool, of_package)
    segment = Segment.of(measured)
    problem = Problem.of([segment], structure, cup, {})
    J = problem.whitened(problem.start, segment, segment.first).jacobian / problem.units
    return J.T @ J


def standard_errors(information: Array) -> Array:
    """Return the standard errors (n,) of unbiased estimates; infinite without information."""
    return np.asarray(np.sqrt(np.diag(covariance_of(information))))


class Response(NamedTuple):
    """
    Frequency response of the package about its rest to small motions of the tool.

    Parameters
    ----------
    package : ndarray (F, 6, 6)
        Transfer matrix from displacements of E to displacements of B (m, rad, body axes).
    changes : ndarray (n, F, 6, 6)
        Derivatives of the transfer matrix by parameters, over the standard deviations of the
        innovation.
    constant : ndarray (n, n)
        Information per pose from the package's pose at rest.

    """

    package: Array
    changes: Array
    constant: Array


def response(
    model_of: Callable[[Array], ModelTuple], parameters: Array, scale: Array, tool: State,
    omega: Array, tracking: Tracking,
) -> Response:
    """
    Return the linear response and its information on the parameters.

    Parameters
    ----------
    model_of : callable
        Function of parameters (n,) that returns cup, package and gravity.
    parameters, scale : ndarray (n,)
        Parameters, and the units of the derivatives.
    tool : State
        Tool at rest.
    omega : ndarray (F,)
        Angular frequencies, rad/s.
    tracking : Tracking
        Tracking of both bodies.

    """
    changes, rests = [], []
    for step in DIFFERENCE * np.diag(scale):
        up, down = (_linear(model_of(parameters + s), tool, omega) for s in (step, -step))
        changes.append((up[0] - down[0]) / (2.0 * DIFFERENCE))
        rests.append(np.ravel(pose_error(down[2], *up[2][:2])) / (2.0 * DIFFERENCE))
    package, noise, _ = _linear(model_of(parameters), tool, omega, tracking)
    root = np.linalg.inv(np.linalg.cholesky(noise))
    at_rest = np.array(rests) @ root[0].T
    return Response(package, np.array([root @ change for change in changes]),
                    np.real(at_rest.conj() @ at_rest.T))


def _linear(
    model: ModelTuple, tool: State, omega: Array, tracking: Tracking | None = None
) -> tuple[Any, Any, State]:
    """Return transfer (F, 6, 6), spectrum of the measured noise (F, 6, 6), and rest pose."""
    rest = static_equilibrium(model, tool)
    J, s = linearise(model, tool, rest), 1j * omega.reshape(-1, 1, 1)
    dynamics: Any = s**2 * np.eye(6) - s * J.body_twist - J.body_pose
    package = np.linalg.solve(dynamics, J.tool_pose + s * J.tool_twist)
    if tracking is None:
        return package, package, rest
    period = tracking.package_period
    value, slope, _ = weights(TOOL_HALF_WINDOW, TOOL_ORDER, 1.0 / period)
    lags: Any = np.arange(-TOOL_HALF_WINDOW, TOOL_HALF_WINDOW + 1) * period
    wave = np.exp(s[:, :, 0] * lags)
    driven = np.linalg.solve(
        dynamics, (wave @ value)[:, None, None] * J.tool_pose
        + (wave @ slope)[:, None, None] * J.tool_twist)
    variances = [np.repeat(noise, 3) ** 2 for noise in (tracking.tool, tracking.package)]
    density = variances[0] * tracking.tool_period / period
    noise = np.diag(variances[1]) + (driven * density) @ np.conj(np.swapaxes(driven, 1, 2))
    return package, noise, rest


def septic_step(s: Array) -> Array:
    """Return the septic from 0 to 1, with zero jerk at both ends, and three derivatives (4, N)."""
    s = np.clip(s, 0.0, 1.0)
    u = s - s**2
    return np.array([
        s**4 * (35.0 - 84.0 * s + 70.0 * s**2 - 20.0 * s**3), 140.0 * u**3,
        420.0 * u**2 * (1.0 - 2.0 * s), 840.0 * u * (1.0 - 5.0 * u)])


def window(t: Array, period: float) -> Array:
    """Return a window with ramps up and down over a period (s), and three derivatives (4, N)."""
    per_s = (1.0 / RAMP) ** np.arange(4)[:, None]
    up, down = septic_step(t / RAMP) * per_s, septic_step((period - t) / RAMP) * per_s
    return np.array([
        sum(math.comb(n, m) * up[m] * (-1.0) ** (n - m) * down[n - m] for m in range(n + 1))
        for n in range(4)])


@dataclass(frozen=True, eq=False)
class FourierMotion(moving.Vibration):
    """
    A rest, a Fourier series in each axis under an envelope, and a hold of a tilt.

    Parameters
    ----------
    start : Pose
    period : float
        Period of the fundamental, and of the whole series, s.
    coefficients : complex array (K, 6)
        Coefficients of the harmonics, m and rad: real part of c exp(i omega t), of displacement in
        world axes and of the rotation vector in the tool's axes at the start.
    rest_duration : float
        Duration of the rest before the series, s.
    tilt : array (3,)
        Rotation vector of the hold after the series, rad, in the tool's axes at the start.
    move, hold : float
        Durations of the rotation to the tilt (and back), and of the hold, s.

    """

    start: Pose
    period: float
    coefficients: Any
    rest_duration: float = REST
    tilt: Any = (0.0, 0.0, 0.0)
    move: float = 0.0
    hold: float = 0.0

    @property
    def duration(self) -> float:  # type: ignore[override]
        """Duration with rest and hold, s."""
        return self.rest_duration + self.period + 2.0 * self.move + self.hold

    @property
    def highest_frequency(self) -> float:
        """Frequency of the last harmonic, Hz."""
        return len(self.coefficients) / self.period

    def displacement(self, t: Array) -> Array:
        """Return displacement and rotation vector since the start, and their rates (2, N, 6)."""
        tau = np.asarray(t) - self.rest_duration
        harmonics = np.arange(1, len(self.coefficients) + 1)[:, None]
        both = np.hstack([self.coefficients,
                          2j * np.pi / self.period * harmonics * self.coefficients])
        out = np.empty((2, len(tau), 6))
        for part in (slice(i, i + SAMPLES_AT_ONCE) for i in range(0, len(tau), SAMPLES_AT_ONCE)):
            first = np.exp(2j * np.pi / self.period * tau[part])
            wave = np.cumprod(np.broadcast_to(first, (len(harmonics), len(first))), axis=0)
            value, rate = np.split((wave.T @ both).real, 2, axis=1)
            envelope = window(tau[part], self.period)[:, :, None]
            out[0, part] = envelope[0] * value
            out[1, part] = envelope[1] * value + envelope[0] * rate
        if self.move:
            after = (tau - self.period) / self.move
            tilted = septic_step(after) - septic_step(after - 1.0 - self.hold / self.move)
            out[0, :, 3:] += tilted[0, :, None] * self.tilt
            out[1, :, 3:] += tilted[1, :, None] / self.move * self.tilt
        return out


class Checks(NamedTuple):
    """Limits of a motion, the possible models, and the grip, if any."""

    limits: ArmLimits
    models: Sequence[ModelTuple]
    grip: Grip | None

    def ratios(self, motion: Motion) -> dict[str, float]:
        """Return the largest ratio to every limit over all models."""
        worst = self.loads(motion).max(axis=0).tolist()
        return self.limits.ratios(motion) | dict(zip(LOADS, worst, strict=False))

    def loads(self, motion: Motion) -> Array:
        """Return the largest ratios (M, 4) to limits `LOADS` for M models; (M, 2) without grip."""
        tool, limits = motion.at_rate(CHECK_RATE), self.limits
        predictions = [PlanSimulation(model, self.grip, tool).predict() for model in self.models]
        return np.array([
            [each.peaks[2, 0] / limits.bending, np.abs(each.deflection[5]).max() / limits.torsion,
             *(limits.safety * each.peaks[:2, 0] if self.grip else ())] for each in predictions])


class MotionObjective:
    """
    The negative mean log determinant as a function of the coefficients' shape, with slopes.

    Further arguments are the power of the norm, and the shares of the cup's limits allowed to
    linear loads.
    """

    def __init__(
        self, checks: Checks, period: float, responses_at: Callable[[Array], list[Response]],
        rate_hz: float,
    ) -> None:
        """Set the limits, and the package's response at frequencies (rad/s)."""
        limits, models, grip = checks
        self.count = max(2, math.floor(limits.highest_frequency * period))
        wide = self.count + math.ceil(2.0 * period / RAMP)  # the ramps widen the lines
        self.points = 2 ** math.ceil(math.log2(8 * self.count))
        omega = 2.0 * np.pi / period * np.arange(1, wide + 1, dtype=np.float64)
        self._powers = (1j * omega[:self.count]) ** np.arange(4)[:, None, None]
        W = window(np.arange(self.points) * period / self.points, period)
        self._envelope = {
            (n, m): math.comb(n, m) * W[n - m] for n in range(4) for m in range(n + 1)}
        responses = responses_at(omega)
        self._models = len(responses)
        self._poses = rate_hz * period
        changes = np.array([r.changes for r in responses]) @ limits.axes
        self._changes = changes.transpose(2, 0, 1, 3, 4).reshape(wide, -1, 6)
        self._constant = self._poses * np.array([r.constant for r in responses])
        rows = [load_rows(r, model, limits, grip, omega)
                for r, model in zip(responses, models, strict=True)]
        self._loads = np.concatenate(rows) @ limits.axes
        self._bounds, self.load_count = limits.bounds(), len(self._loads)
        self._names = [b.name for b in self._bounds] + [*LOADS[:len(rows[0])]] * self._models
        headroom = np.array([b.limit for b in self._bounds[:6]])
        self.size = 0.3 * headroom[:, None] / (1.0 + (omega[:self.count] / 6.0) ** 2)

    def _signals(self, spectrum: Any) -> Array:
        """Return the real part (..., N) of a series of lines (..., F)."""
        full = np.zeros((*spectrum.shape[:-1], self.points // 2 + 1), dtype=complex)
        full[..., 1:spectrum.shape[-1] + 1] = spectrum
        return np.asarray(np.fft.irfft(full, self.points) * (self.points / 2.0))

    def _lines(self, signals: Array, count: int) -> Any:
        """Return the adjoint of `_signals`: lines (..., F) of signals (..., N)."""
        return np.fft.rfft(signals)[..., 1:count + 1]

    def __call__(self, shape: Array, power: int, allowed: Array) -> tuple[float, Array]:
        """Return the value and its derivatives by the shape, a flat array of 2 6 K numbers."""
        value, slope, _ = self._value(self._coefficients(shape), power, allowed)
        return value, np.ravel([(slope * self.size).real, (slope * self.size).imag])

    def _coefficients(self, shape: Array) -> Any:
        """Return the coefficients (6, K) of a shape."""
        real, imaginary = shape.reshape(2, 6, self.count)
        return self.size * (real + 1j * imaginary)

    def within(
        self, shape: Array, power: int, allowed: Array
    ) -> tuple[Any, Mapping[str, float]]:
        """Return the coefficients (K, 6) within limits, and each limit's share in the bound."""
        c = self._coefficients(shape)
        _, _, (largest, shares) = self._value(c, power, allowed)
        return c.T / largest, shares

    def criterion(self, coefficients: Any) -> float:
        """Return the criterion of unscaled coefficients (K, 6)."""
        waves = self._envelope[0, 0] * self._signals(coefficients.T)
        lines = self._lines(waves, self._loads.shape[1]).T * (2.0 / self.points)
        return self._information(lines)[0]

    def _value(
        self, c: Any, power: int, allowed: Array
    ) -> tuple[float, Any, tuple[float, Mapping[str, float]]]:
        """Return value, slope by the coefficients, and largest ratio with the limits' shares."""
        rates = self._signals(self._powers * c)
        u = np.array([
            sum(self._envelope[n, m] * rates[m] for m in range(n + 1)) for n in range(4)])
        first, wide = len(self._bounds), self._loads.shape[1]
        lines = self._lines(u[0], wide).T * (2.0 / self.points)
        loads = self._loads / allowed[:, None, None, None]
        # The norm of three components plus a fourth is bounded.
        signals = np.zeros((first + len(loads), 4, self.points))
        for signal, b in zip(signals, self._bounds, strict=False):
            signal[:len(b.rows)] = b.rows @ u[b.order] / b.limit
        signals[first:] = self._signals(np.swapaxes((loads @ lines[:, :, None])[..., 0], 1, 2))
        lengths = np.sqrt(np.einsum('ijk,ijk->ik', signals[:, :3], signals[:, :3]))
        ratios = np.maximum(lengths + signals[:, 3], 0.0)
        top = float(ratios.max())
        parts = (ratios / top) ** power
        total = float(np.sum(parts))
        norm = top * (total / self.points) ** (1.0 / power)
        weights = parts / np.maximum(ratios, 1e-6 * top) / total
        by_signals = signals * (weights / np.maximum(lengths, 1e-6 * top))[:, None]
        by_signals[:, 3] = weights
        by_u = np.zeros_like(u)
        for by_signal, b in zip(by_signals, self._bounds, strict=False):
            by_u[b.order] += b.rows.T @ by_signal[:len(b.rows)] / b.limit
        by_loads = np.swapaxes(self._lines(by_signals[first:], wide), 1, 2)[..., None]
        by_lines = np.sum(np.swapaxes(loads, 2, 3).conj() @ by_loads, axis=0)[:, :, 0]
        value, gained = self._information(lines / norm)
        inner = float(np.real(np.sum(gained.conj() * lines))) / norm
        by_u *= -inner
        by_u[0] += self._signals((gained / norm - inner * by_lines).T) * (2.0 / self.points)
        by_rates = np.array([sum(self._envelope[n, m] * by_u[n] for n in range(m, 4))
                             for m in range(4)])
        slope = np.sum(np.conj(self._powers) * self._lines(by_rates, self.count), axis=0)
        shares = Counter[str]()
        for name, part in zip(self._names, parts.sum(axis=1).tolist(), strict=True):
            shares[name] += part / total
        return -value, -slope, (top, shares)

    def _information(self, lines: Any) -> tuple[float, Any]:
        """Return the criterion of the information in lines (F, 6), and its slope."""
        y = (self._changes @ lines[:, :, None]).reshape(len(lines), self._models, -1, 6)
        flat = y.transpose(1, 2, 0, 3).reshape(self._models, y.shape[2], -1)
        M = self._constant + 0.5 * self._poses * np.real(flat.conj() @ np.swapaxes(flat, 1, 2))
        M = M + np.eye(M.shape[1])  # prior of each parameter within a factor of about 2
        value, by_M = float(np.mean(np.linalg.slogdet(M)[1])), np.linalg.inv(M) / len(M)
        weighted = (by_M @ flat).reshape(self._models, -1, len(lines), 6)
        weighted_gradient = weighted.transpose(2, 0, 1, 3).reshape(len(lines), -1, 1)
        slope = (np.swapaxes(self._changes, 1, 2) @ weighted_gradient.conj())[:, :, 0].conj()
        return value, self._poses * slope


class Design(NamedTuple):
    """
    A designed motion and its properties.

    Parameters
    ----------
    motion : FourierMotion
    ratios : mapping of str to float
        Largest ratio of the motion to each limit; for bending and safety with the worst K.
    shares : mapping of str to float
        Relative gain in log determinant by relaxing each limit.
    information : array (2 n, 2 n)
        Information of the whole model on the parameters of K and P.

    """

    motion: FourierMotion
    ratios: Mapping[str, float]
    shares: Mapping[str, float]
    information: Array


def design(
    cup: Cup, package: Package, gravity: Array | float, structure: Structure, checks: Checks,
    tracking: Tracking, duration: float, seed: int, progress: Progress, hold: float = 0.0,
) -> Design:
    """
    Return the motion with the most information on K and P, followed by the hold of a tilt.

    Parameters
    ----------
    cup, package, gravity
        Initial guess of the cup, and the package.
    structure : Structure
        Structure of K and P, which defines their free entries.
    checks : Checks
        Limits of the arm, the cup and the grip, with the models of `cups_near` the guess.
    tracking : Tracking
        Tracking of both bodies.
    duration : float
        Duration of rest and motion, s; the motion takes three ramps or more.
    seed : int
        Seed of the initial shape of the search.
    progress : callable
        Callback with the current step and its completed fraction (0 to 1).
    hold : float
        Duration of a tilt, s, after `duration`, for the relaxation of rubber. None without tilt.

    Raises
    ------
    BellowsError
        If the cup cannot hold the package, or no motion is within the limits.

    """
    minimise: Any = scipy.optimize.minimize
    period = duration - REST
    start = checks.limits.start
    at = state_row(start.position, lie.rotation_to_quaternion(start.rotation))

    def model_of(x: Array) -> ModelTuple:
        K, P = structure.matrices(x)
        one = replace(cup, stiffness=K, damping=P, relaxation=(0.0, 0.0))
        return model_tuple(gripper_of(one, structure.places), package, gravity)

    def responses_at(omega: Array) -> list[Response]:
        return [response(
            model_of, structure.parameters(each.stiffness, each.damping),
            structure.sizes(each.stiffness, each.damping), at, omega, tracking)
            for each in cups_near(cup)]

    search = MotionObjective(checks, period, responses_at, 1.0 / tracking.package_period)
    rng = np.random.default_rng(seed)
    best = -math.inf
    shares: Mapping[str, float] = {}
    motion = still = _held(checks, period, hold)
    shape, allowed = rng.standard_normal(2 * search.size.size), np.ones(search.load_count)
    for number, (power, max_iterations) in enumerate(STAGES):
        progress('designing the motion', number / len(STAGES))
        shape = minimise(search, shape, (power, allowed), 'L-BFGS-B', True, options={
            'maxiter': max_iterations, 'maxfun': 2 * max_iterations, 'maxcor': 20,
            'ftol': MIN_GAIN}).x
        coefficients, now = search.within(shape, power, allowed)
        moved = replace(still, coefficients=coefficients)
        worst = checks.loads(moved).ravel()
        reached = search.criterion(coefficients / max(1.0, float(worst.max())))
        if reached > best:
            best, motion, shares = reached, moved, now
        # a part of a load is independent of the amplitude
        allowed = np.minimum(allowed / np.maximum(worst, 0.1) ** 1.4, 1.0)
    motion, ratios = _within(motion, checks)
    progress('computing the expected errors', 1.0)
    tool = motion.at_rate(1.0 / tracking.package_period)
    return Design(motion, ratios, shares, motion_information(
        cup, package, gravity, tool, tracking, structure))


def _held(checks: Checks, period: float, hold: float) -> FourierMotion:
    """Return a hold with the largest tilt about x and y within the limits; None without tilt."""
    limits = checks.limits
    still = FourierMotion(limits.start, period, np.zeros((1, 6)))
    tilt = 0.9 * np.array([*limits.rotation[:2], 0.0])
    for _ in range(20 if hold and tilt.any() else 0):
        angle, angular_limits = float(np.linalg.norm(tilt)), list(limits.rates.values())[3:]
        move = max(
            (peak * angle / (0.9 * limit)) ** (1.0 / order) for order, peak, limit in zip(
                # peaks of speed, acceleration and jerk of the septic step
                (1, 2, 3), (2.1875, 7.5132, 52.5), angular_limits, strict=True))
        held = replace(still, tilt=tilt, move=max(move, RAMP), hold=hold)
        if max(checks.ratios(held).values()) <= 1.0 - 2.0 * MARGIN:
            return held
        tilt = 0.85 * tilt
    return still


def cups_near(cup: Cup) -> list[Cup]:
    """Return the guessed cup, a softer one and a stiffer one."""
    return [replace(cup, stiffness=factor * cup.stiffness) for factor in GUESS_FACTORS]


def load_rows(
    response: Response, model: ModelTuple, limits: ArmLimits, grip: Grip | None, omega: Array
) -> Array:
    """
    Return the map (4, F, 4, 6) from lines of the tool to the `LOADS`, relative to their limits.

    Each load is the norm of three components plus a fourth. Without a grip model there are two
    loads.
    """
    mass, com, inertia, _ = model[1]
    c, g = lie.hat(com), lie.hat(limits.start.rotation.T @ model[2])
    inert = np.block([
        [mass * np.eye(3), np.zeros((3, 3))], [mass * c, np.reshape(inertia, (3, 3))]])
    turned = mass * np.vstack([-g, -c @ g])
    wrench = -omega[:, None, None]**2 * (inert @ response.package)  # at S, in excess of rest
    wrench += turned @ response.package[:, 3:]
    tilt = (response.package - np.eye(6))[:, 3:]
    rows = np.zeros((4 if grip else 2, len(omega), 4, 6), dtype=complex)
    rows[0, :, :2], rows[1, :, 0] = tilt[:, :2] / limits.bending, tilt[:, 2] / limits.torsion
    if grip is None:
        return rows
    suction, radius, friction = grip[:3]  # of one cup; scaling covers all cups
    pressed = max(suction / limits.safety - mass * float(np.linalg.norm(model[2])), 0.1 * suction)
    f, m = wrench[:, :3] / pressed, wrench[:, 3:] / pressed
    rows[2, :, :2], rows[3, :, :2] = 2.0 / radius * m[:, :2], f[:, :2] / friction
    rows[3, :, 2], rows[2:, :, 3] = m[:, 2] / (radius * friction), f[:, 2]
    return rows


def _within(motion: FourierMotion, checks: Checks) -> tuple[FourierMotion, dict[str, float]]:
    """Return a motion scaled to the limits, and its ratios to them."""
    for attempt in range(20):
        ratios = checks.ratios(motion)
        worst = max(ratios.values())
        if worst <= 1.0 and (attempt > 3 or worst > 1.0 - 2.0 * MARGIN):
            return motion, ratios
        factor = (1.0 - MARGIN) / min(worst, 4.0)
        motion = replace(motion, coefficients=factor * motion.coefficients)
    name = max(ratios, key=lambda name: ratios[name])
    raise BellowsError(
        f'No motion meets the limits: {name} is {ratios[name]:.3g} times its limit, even at rest. '
        'Raise the limit, or start in another pose.')
