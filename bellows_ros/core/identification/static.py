"""
What recordings at rest tell: the cup's nominal length (4.2), and whether its spring is right.

At rest no damper and no acceleration take part: the package hangs where spring and gravity balance
(3.9). The mean of a standstill has little noise, so the spring can be checked pose by pose, and
the length of the cup under several loads, seen without noise, leads to its length under none.
"""

from collections.abc import Sequence
from dataclasses import dataclass

from bellows_ros.core.equilibrium import static_equilibrium
from bellows_ros.core.identification.least_squares import CLUSTER_WINDOWS, Samples
from bellows_ros.core.identification.noise import Noise, noise_of
from bellows_ros.core.lie import (
    exp_so3,
    log_so3,
    quaternion_to_rotation,
    rotation_to_quaternion,
)
from bellows_ros.core.model import Cup, model_tuple, Package
from bellows_ros.core.recording.alignment import BLOCK_SECONDS
from bellows_ros.core.recording.preparation import Recording
from bellows_ros.core.score import relative_coordinates
from bellows_ros.core.simulation import state_row
from bellows_ros.core.trajectory import NS_PER_S, Stamps, Trajectory
from bellows_ros.errors import BellowsError
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

SHORTEST_HOLD = 0.5
"""A standstill lasts at least this long, s."""

STILL_WITHIN = Noise(1.5e-4, 1.5e-3)
"""Means over short blocks of a body at rest differ by at most this, m and rad, beside noise."""

NOISE_DEVIATIONS = 5.0
"""... and by this many standard deviations of the mean's noise."""

FEWEST_IN_BLOCK = 3

UPRIGHT_WITHIN = np.radians(2.0)
"""Nominal length is measured with the cup's axis within this of the vertical, rad."""

SAME_MASS_WITHIN = 1e-3
"""Masses (kg) closer than this are one load."""

POLYNOMIAL = 3
"""Degree of length against load (4.2), where there are loads enough."""

LINEAR_WITHIN = 0.05
"""The range is linear to where the polynomial leaves its tangent by this part of the stretch."""

WANTED_LENGTH_ERROR = 1e-4
"""Standard error of a nominal length (m) above which more loads or longer holds are asked for."""

GOOD_WITHIN = 0.05
"""An equilibrium is met if it is off by less than this part of the deflection, or by noise."""

ERRORS_OF_NOISE = 3.0
"""Standard errors of a mean that count as noise."""


@dataclass(frozen=True, eq=False)
class Hold:
    """
    A standstill of tool and package.

    Parameters
    ----------
    start_ns, duration : int, float
        When it began, and how long it lasted (s).
    tool, package : Trajectory
        One pose each: the means of E and B in the world.
    samples : int
        How many package poses the mean is of.
    error : Noise
        Standard error of the relative pose's mean from measurement noise, m and rad per axis.

    """

    start_ns: int
    duration: float
    tool: Trajectory
    package: Trajectory
    samples: int
    error: Noise

    def lip(self, com: Array) -> Array:
        """Return E_o_S (m) and the rotation vector (rad) of the lip in the tool, (6,)."""
        lip = self.package.position - self.package.rotation @ np.asarray(com, dtype=float)
        moved = Trajectory(self.package.stamps_ns, lip, self.package.rotation)
        at: Array = relative_coordinates(self.tool, moved)[0]
        return at

    @property
    def tilt(self) -> float:
        """Angle between the tool's axis and the vertical, rad."""
        return float(np.arccos(np.clip(self.tool.rotation[0, 2, 2], -1.0, 1.0)))


def holds_of(recording: Recording, shortest: float = SHORTEST_HOLD) -> list[Hold]:
    """
    Return the standstills of a recording, in the order of time.

    The unfiltered poses are averaged over short blocks. From the end of a standstill, where the
    package has come to rest, blocks are taken in backwards for as long as both bodies stay where
    they are, so that the swinging after a move is left out.

    Raises
    ------
    BellowsError
        If there are too few valid poses to tell noise from motion, or no standstill.

    """
    bodies = recording.measured_tool, recording.measured_package
    noise = noise_of(bodies[0]), noise_of(bodies[1])
    found = _still(bodies, noise, _blocks(*bodies), shortest)
    if not found:
        raise BellowsError(
            f'No standstill of {shortest:g} s or more is in the recording: the tool and the '
            'package must both come to rest. Hold each pose until the package has stopped '
            'swinging, some 3 s.'
        )
    return [_hold(*bodies, span, noise) for span in found]


def unsettled(recording: Recording, shortest: float = SHORTEST_HOLD) -> int:
    """Return how often the tool stood still, but the package did not come to rest in that time."""
    tool, package = recording.measured_tool, recording.measured_package
    noise = noise_of(tool), noise_of(package)
    spans = _blocks(tool, package)
    of_tool = _still((tool,), noise[:1], spans, shortest)
    of_both = _still((tool, package), noise, spans, shortest)
    settled = np.array([span[0] for span in of_both], dtype=np.int64)
    return sum(
        not np.any((settled >= span[0] - len(spans[0])) & (settled <= span[-1]))
        for span in of_tool
    )


def _still(
    bodies: Sequence[Trajectory],
    noise: Sequence[Noise],
    spans: list[NDArray[np.int64]],
    shortest: float,
) -> list[NDArray[np.int64]]:
    """Return the samples of every standstill of all bodies, in the order of time."""
    stamps = bodies[0].stamps_ns
    means = [_block_means(body, spans) for body in bodies]
    limits = [_limits(n, int(np.median([len(span) for span in spans]))) for n in noise]
    ends = stamps[[span[-1] for span in spans]]
    found, last = [], len(spans) - 1
    while last >= 0:
        first = last
        while first > 0 and _joins(means, limits, ends, first, last):
            first -= 1
        # The first and the last block may have a little of the moves before and after in them.
        inner = slice(first + 1, last) if last - first > 3 else slice(first, last + 1)
        span = np.concatenate(spans[inner])
        long_enough = _seconds(stamps, span) >= shortest
        if long_enough:
            found.append(span)
        last = first - 1 if long_enough else last - 1
    return found[::-1]


@dataclass(frozen=True, eq=False)
class NominalLength:
    """
    The cup's length without load (4.2).

    Parameters
    ----------
    length, length_std : float
        l0 and its standard error, m.
    linear_length, linear_length_std : float
        The same from a straight line through the loads in the linear range, m.
    stiffness : float
        Axial stiffness at no load, N/m.
    linear_load : float
        Load up to which the spring is linear, N; at most the largest load that was measured.
    loads, lengths, errors : ndarray (N,)
        Load (N), length (m) and its standard error (m) of every hold that was used.
    coefficients : ndarray
        Of the polynomial, m, m/N, m/N^2, m/N^3.
    warnings : tuple of str
        What the user should know, in sentences.

    """

    length: float
    length_std: float
    linear_length: float
    linear_length_std: float
    stiffness: float
    linear_load: float
    loads: Array
    lengths: Array
    errors: Array
    coefficients: Array
    warnings: tuple[str, ...]


def nominal_length(
    holds: Sequence[tuple[Hold, Package]], gravity: float
) -> NominalLength:
    """
    Return the cup's length without load from holds of several masses (4.2).

    Length against load is fitted by a polynomial of third order, or of lower order where there
    are fewer loads; its value at no load is l0.

    Parameters
    ----------
    holds : sequence of (Hold, Package)
        Standstills and what was held; those with the cup's axis not vertical are left out.
    gravity : float
        m/s^2.

    Raises
    ------
    BellowsError
        If there are fewer than two different masses with the cup's axis vertical.

    """
    upright = [(hold, held) for hold, held in holds if hold.tilt <= UPRIGHT_WITHIN]
    loads = np.array([held.mass * gravity for _, held in upright])
    lengths = np.array([-hold.lip(held.com)[2] for hold, held in upright])
    errors = np.array([max(hold.error.position, 1e-9) for hold, _ in upright])
    different = _different([held.mass for _, held in upright])
    if different < 2:
        raise BellowsError(
            f'The nominal length needs two different masses or more, held with the tool vertical, '
            f'but there {"is" if different == 1 else "are"} {different}. Record standstills with '
            'other known masses, and give each its own --mass.'
        )
    degree = min(POLYNOMIAL, different - 1)
    coefficients, covariance = _polynomial(loads, lengths, errors, degree)
    linear_load = _linear_range(coefficients, float(loads.max()))
    line, line_covariance = _line(loads, lengths, errors, linear_load)
    std = float(np.sqrt(covariance[0, 0]))
    return NominalLength(
        float(coefficients[0]), std, float(line[0]), float(np.sqrt(line_covariance[0, 0])),
        float(1.0 / coefficients[1]), linear_load, loads, lengths, errors, coefficients,
        tuple(_length_warnings(different, std, float(coefficients[1]), loads)),
    )  # fmt: skip


@dataclass(frozen=True, eq=False)
class PoseCheck:
    """
    Predicted and measured equilibrium in one pose of the tool.

    Parameters
    ----------
    hold : Hold
        The standstill.
    measured, predicted : ndarray (6,)
        The lip in the tool: deflection from nominal, m and rad; predicted is nan where the cup
        cannot carry the package.
    verdict : str
        'within noise', 'good', 'off' or 'falls'.
    sentence : str
        The verdict in words.

    """

    hold: Hold
    measured: Array
    predicted: Array
    verdict: str
    sentence: str


@dataclass(frozen=True, eq=False)
class SpringCheck:
    """
    The spring model in several poses of the tool.

    Parameters
    ----------
    poses : tuple of PoseCheck
        Every standstill.
    passed : bool
        Whether none is off.
    sentence : str
        The verdict in words.

    """

    poses: tuple[PoseCheck, ...]
    passed: bool
    sentence: str


def check_spring(
    cup: Cup, holds: Sequence[tuple[Hold, Package]], gravity: float
) -> SpringCheck:
    """
    Compare where the package hangs with where the spring model puts it (3.9).

    Parameters
    ----------
    cup : Cup
        Its damping takes no part.
    holds : sequence of (Hold, Package)
        Standstills and what was held.
    gravity : float
        m/s^2 along -z of the world.

    """
    poses = tuple(_check(cup, hold, held, gravity) for hold, held in holds)
    off = [pose for pose in poses if pose.verdict in ('off', 'falls')]
    if not off:
        sentence = f'The spring holds in all {len(poses)} poses.'
    else:
        sentence = (
            f'The spring is off in {len(off)} of {len(poses)} poses. If it is off in all of them '
            'alike, check cup.length, package.mass and package.com; if only in some directions, '
            'the stiffness of those, or alignment.'
        )
    return SpringCheck(poses, not off, sentence)


def static_samples(
    holds: Sequence[Hold], held: Package, gravity: float, weight: float = 1.0
) -> Samples:
    """
    Return standstills as samples at rest, to be fitted together with those of a motion.

    Every mean counts as many times as it has poses, times the weight; its twist and acceleration
    are zero. All samples of a hold are one cluster, as they are one measurement.

    Parameters
    ----------
    holds : sequence of Hold
        Standstills of one package.
    held : Package
        What was held.
    gravity : float
        m/s^2 along -z of the world.
    weight : float
        Of a static pose, relative to a sample of the motion.

    Raises
    ------
    BellowsError
        If there is no hold, or the weight is not positive.

    """
    if not holds or not (np.isfinite(weight) and weight > 0.0):
        raise BellowsError(
            f'Static samples need standstills and a weight above 0, got {len(holds)} standstills '
            f'and {weight:g}.'
        )
    counts = [max(round(weight * hold.samples), 1) for hold in holds]
    window = max(max(hold.duration for hold in holds), 1e-9 * max(counts))
    cluster_ns = int(CLUSTER_WINDOWS * window * NS_PER_S)
    stamps = np.concatenate(
        [number * cluster_ns + np.arange(count) for number, count in enumerate(counts)]
    )
    which = np.repeat(np.arange(len(holds)), counts)
    bodies = []
    for body in ('tool', 'package'):
        poses: list[Trajectory] = [getattr(hold, body) for hold in holds]
        still = np.zeros((len(stamps), 6))
        bodies.append(Trajectory(
            stamps,
            np.concatenate([pose.position for pose in poses])[which],
            np.concatenate([pose.rotation for pose in poses])[which],
            still, still,
        ))  # fmt: skip
    return Samples(bodies[0], bodies[1], held, gravity, window)


def _blocks(tool: Trajectory, package: Trajectory) -> list[NDArray[np.int64]]:
    """Return the indices of valid samples, block by block of time."""
    valid = np.flatnonzero(tool.valid & package.valid)
    if not len(valid):
        raise BellowsError('No valid sample is left in which to look for standstills.')
    number = (tool.stamps_ns[valid] - tool.stamps_ns[0]) // int(BLOCK_SECONDS * NS_PER_S)
    parts = np.split(valid, np.flatnonzero(np.diff(number)) + 1)
    return [part for part in parts if len(part) >= FEWEST_IN_BLOCK] or [valid]


def _limits(noise: Noise, samples: int) -> Noise:
    """Return by how much the means of so many samples of a body at rest may differ."""
    factor = NOISE_DEVIATIONS / float(np.sqrt(samples))
    return Noise(*(w + factor * n for w, n in zip(STILL_WITHIN, noise, strict=True)))


def _block_means(body: Trajectory, spans: list[NDArray[np.int64]]) -> Trajectory:
    """Return the mean pose of every block, at its first stamp."""
    means = [_mean(body, span) for span in spans]
    return Trajectory(
        body.stamps_ns[[span[0] for span in spans]],
        np.array([position for position, _ in means]),
        np.array([rotation for _, rotation in means]),
    )


def _joins(
    means: list[Trajectory], limits: list[Noise], ends: Stamps, first: int, last: int
) -> bool:
    """Tell whether the block before the first is where blocks first to last are, and near them."""
    if means[0].stamps_ns[first] - ends[first - 1] > BLOCK_SECONDS * NS_PER_S:
        return False
    for body, limit in zip(means, limits, strict=True):
        position, rotation = _mean(body, np.arange(first, last + 1))
        moved = float(np.linalg.norm(body.position[first - 1] - position))
        turned = float(np.linalg.norm(log_so3(rotation.T @ body.rotation[first - 1])))
        if moved > limit.position or turned > limit.rotation:
            return False
    return True


def _mean(body: Trajectory, index: NDArray[np.int64]) -> tuple[Array, Array]:
    """Return the mean position and rotation of poses that are near each other."""
    rotation: Array = body.rotation[index[len(index) // 2]]
    for _ in range(2):  # the mean in the logarithm converges cubically near itself
        rotation = rotation @ exp_so3(np.mean(log_so3(rotation.T @ body.rotation[index]), axis=0))
    return body.position[index].mean(axis=0), rotation


def _seconds(stamps_ns: Stamps, span: NDArray[np.int64]) -> float:
    """Return the time from the first to the last of some samples, s."""
    return float(stamps_ns[span[-1]] - stamps_ns[span[0]]) / NS_PER_S


def _hold(
    tool: Trajectory,
    package: Trajectory,
    span: NDArray[np.int64],
    noise: tuple[Noise, Noise],
) -> Hold:
    """Return the standstill of some samples."""
    start = package.stamps_ns[span[:1]]
    means = []
    for body in (tool, package):
        position, rotation = _mean(body, span)
        means.append(Trajectory(start, position[None], rotation[None]))
    root = np.sqrt(len(span))
    return Hold(
        int(start[0]), _seconds(package.stamps_ns, span), means[0], means[1], len(span),
        Noise(*(float(np.hypot(a, b) / root) for a, b in zip(*noise, strict=True))),
    )  # fmt: skip


def _different(masses: Sequence[float]) -> int:
    """Return how many different masses there are."""
    ordered = np.sort(np.asarray(masses, dtype=float))
    return int(np.count_nonzero(np.diff(ordered) > SAME_MASS_WITHIN) + 1) if len(ordered) else 0


def _polynomial(
    loads: Array, lengths: Array, errors: Array, degree: int
) -> tuple[Array, Array]:
    """
    Return a weighted polynomial's coefficients, lowest first, and their covariance.

    The scatter about the polynomial counts where it is larger than the errors explain.
    """
    largest = float(loads.max())
    powers = np.vander(loads / largest, degree + 1, increasing=True) / errors[:, None]
    scale = 1.0 / largest ** np.arange(degree + 1)
    found, *_ = np.linalg.lstsq(powers, lengths / errors, rcond=None)
    spare = len(loads) - degree - 1
    chi2 = float(np.sum((lengths / errors - powers @ found) ** 2)) / spare if spare > 0 else 1.0
    covariance = max(chi2, 1.0) * np.linalg.inv(powers.T @ powers)
    return found * scale, np.asarray(covariance * np.outer(scale, scale))


def _linear_range(coefficients: Array, largest: float) -> float:
    """Return the load (N) up to which a polynomial stays near its tangent at no load."""
    loads = np.linspace(0.0, largest, 1001)[1:]
    powers = np.vander(loads, len(coefficients), increasing=True)
    tangent = coefficients[1] * loads
    bent = np.abs(powers[:, 2:] @ coefficients[2:]) > LINEAR_WITHIN * np.abs(tangent)
    return float(loads[int(np.argmax(bent))]) if bent.any() else largest


def _line(
    loads: Array, lengths: Array, errors: Array, linear_load: float
) -> tuple[Array, Array]:
    """Return the straight line through the loads in the linear range, or the lowest two."""
    inside = loads <= linear_load * (1.0 + 1e-9)
    if _different(list(loads[inside] / 10.0)) < 2:
        second = np.unique(loads)[1]
        inside = loads <= second
    return _polynomial(loads[inside], lengths[inside], errors[inside], 1)


def _length_warnings(different: int, std: float, slope: float, loads: Array) -> list[str]:
    """Return what the user should know about a nominal length."""
    found = []
    if different <= POLYNOMIAL:
        found.append(
            f'With {different} different masses length against load is fitted by a polynomial of '
            f'order {different - 1}; {POLYNOMIAL + 1} or more show where the cup stops being '
            'linear.'
        )
    if std > WANTED_LENGTH_ERROR:
        found.append(
            f'The nominal length is only known to {std * 1e3:.2f} mm. Add lighter masses than '
            f'{loads.min():.3g} N, or hold each for longer.'
        )
    if not slope > 0.0:
        found.append(
            'The cup gets shorter under load: check the masses, and that the poses are of E and S.'
        )
    return found


def _check(cup: Cup, hold: Hold, held: Package, gravity: float) -> PoseCheck:
    """Return predicted and measured equilibrium of one standstill."""
    nominal = np.array([0.0, 0.0, -cup.length, 0.0, 0.0, 0.0])
    measured = hold.lip(held.com) - nominal
    quaternion = rotation_to_quaternion(hold.tool.rotation[0])
    tool = state_row(hold.tool.position[0], quaternion, np.zeros(6))
    try:
        position, q, _, _ = static_equilibrium(model_tuple(cup, held, gravity), tool)
    except BellowsError as error:
        return PoseCheck(hold, measured, np.full(6, np.nan), 'falls', str(error))
    there = Trajectory(
        hold.package.stamps_ns, np.array([position]), quaternion_to_rotation(np.array([q]))
    )
    equilibrium = Hold(hold.start_ns, hold.duration, hold.tool, there, hold.samples, hold.error)
    predicted = equilibrium.lip(held.com) - nominal
    return PoseCheck(hold, measured, predicted, *_verdict(measured, predicted, hold.error))


def _verdict(measured: Array, predicted: Array, error: Noise) -> tuple[str, str]:
    """Return the verdict on a predicted deflection, and the words for it."""
    worst, words = 'within noise', []
    for part, unit, noise in (
        (slice(0, 3), 'mm', error.position), (slice(3, 6), 'mrad', error.rotation),
    ):  # fmt: skip
        off = float(np.linalg.norm(predicted[part] - measured[part]))
        size = float(np.linalg.norm(measured[part]))
        within = off <= ERRORS_OF_NOISE * noise * np.sqrt(3.0)
        if not within:
            good = off <= GOOD_WITHIN * size
            worst = 'off' if not good or worst == 'off' else 'good'
        words.append(f'{off * 1e3:.2g} {unit} off a deflection of {size * 1e3:.3g} {unit}')
    return worst, f'{", ".join(words)}: {worst}'
