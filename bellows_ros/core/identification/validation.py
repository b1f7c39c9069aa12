"""
Validation of a cup on a recording that it was not identified from.

The model runs freely through the whole recording: it sees the tool's motion and never again the
package. The tool is smoothed lightly, as its noise drives the package, and what the noise of both
bodies does to the comparison is simulated too: an error beyond that is the model's.
"""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

from bellows_ros.core.geometry.arrays import Array, Mask
from bellows_ros.core.identification.search import Search
from bellows_ros.core.identification.segments import measured_segments, Segment
from bellows_ros.core.model.cup_package import Cup, model_tuple
from bellows_ros.core.model.kernels import ModelTuple, State
from bellows_ros.core.model.simulation import lip_wrenches, rest, simulate, state_row, tool_rows
from bellows_ros.core.model.structure import STRUCTURES
from bellows_ros.core.recording.alignment import rest_of
from bellows_ros.core.recording.recording import NOISE_SAMPLES, Recording
from bellows_ros.core.signals import residuals
from bellows_ros.core.signals.resampling import resample
from bellows_ros.core.signals.residuals import AXES, Spectrum, Whiteness
from bellows_ros.core.signals.savgol import bridged, savgol, weights, with_filtered_noise
from bellows_ros.core.signals.trajectory import NS_PER_S, Trajectory, uniform_rate_hz
from bellows_ros.errors import BellowsError
import numpy as np

LIGHT_HALF_WINDOW, LIGHT_ORDER = 1 / 60, 4
"""Half window (s) and order of the light smoothing of the tool, which passes up to 20 Hz."""

MAX_NRMSE = 0.05
"""NRMSE that the thesis asks for."""

NOISE_FACTOR = 3.0
"""RMS error over that due to noise, above which the cup is to blame."""

NOISE_RUNS = 2
"""Simulations with added tool noise that give the error due to noise."""

MAX_BRIDGE_TIME = 0.08
"""Gaps of the tool longer than this (s) are bridged with a warning."""

REST_S = 0.3
"""A recording begins at rest if both bodies stand still for so long."""

DRAW_SEED = 0
"""Seed of the added noise: the same recording gives the same numbers."""

MAX_INNOVATIONS = 3_000
"""Samples whose innovations are tested; each takes 27 kB of memory."""

MIN_CORRELATION = 0.01
"""Correlation from sample to sample below which noise counts as white."""

MIN_NOISE = 1e-7
"""Noise (m, rad) below which rounding dominates the innovations."""


class OneStep(NamedTuple):
    """
    The whitened differences of the output error in the middle of a recording's longest part.

    Chi2: their mean square, 1 where model and noise explain the motion; whiteness; and spectrum,
    scaled to the noise of the package's poses, m and rad.
    """

    chi2: float
    whiteness: Whiteness
    spectrum: Spectrum


@dataclass(frozen=True, eq=False)
class Validation(residuals.Comparison):
    """
    A recording compared with the free simulation of it, where the package was measured.

    Parameters
    ----------
    cup : Cup
        That was simulated.
    recording : Recording
        With which it is compared.
    tool, package : Trajectory
        Of E with twists, and of B in the free simulation, at the stamps of the tool.
    state : State
        Of B in the world at the first of them.
    start : str
        'equilibrium' or 'measured': where the simulation begins.
    warnings : tuple of str
        What the user should know.

    """

    cup: Cup
    recording: Recording
    tool: Trajectory
    package: Trajectory
    state: State
    start: str
    warnings: tuple[str, ...]

    @property
    def model(self) -> ModelTuple:
        """The cup with the package of the recording, as the kernels take them."""
        return model_tuple(self.cup, self.recording.payload, self.recording.settings.gravity)

    @cached_property
    def wrench(self) -> Array:
        """Of the cup at the lip in the free simulation, in lip axes, N and N m (N, 6)."""
        return lip_wrenches(self.model, tool_rows(self.tool), tool_rows(self.package))

    @cached_property
    def noise(self) -> Array:
        """RMS error (6,) that measurement noise of package and tool alone makes, m and rad."""
        tool, body = (each.select(slice(NOISE_SAMPLES)) for each in (self.tool, self.package))
        poses, settings = self.recording.aligned_tool, self.recording.settings
        rate_hz, rng = uniform_rate_hz(poses.stamps_ns), np.random.default_rng(DRAW_SEED)
        W, squares = weights(half_window_of(poses), LIGHT_ORDER, rate_hz), []
        sizes, correlations = np.transpose(self.recording.ar1_noise[0])
        correlations = np.where(correlations > MIN_CORRELATION, correlations, 0.0)
        for _ in range(NOISE_RUNS):
            noisy = with_filtered_noise(tool, sizes, correlations, W, 1.0 / rate_hz, rng)
            moved = simulate(
                self.cup, self.recording.payload, noisy, self.state, settings.gravity)
            squares.append(np.mean(np.subtract(*(
                residuals.relative_coordinates(tool, each) for each in (moved, body)))**2, axis=0))
        return np.asarray(np.sqrt(np.mean(squares, axis=0) + self.recording.body_noise[1].std**2))

    @cached_property
    def whiteness(self) -> Whiteness:
        """Of the errors of the free simulation."""
        return residuals.portmanteau(self.error)

    @cached_property
    def spectrum(self) -> Spectrum:
        """Of these errors; lost samples interpolated."""
        return residuals.spectrum(residuals.interpolated(self.error), self._rate_hz)

    @cached_property
    def motion(self) -> Spectrum:
        """Of the measured coordinates; lost samples interpolated."""
        return residuals.spectrum(residuals.interpolated(self.measured), self._rate_hz)

    @property
    def _rate_hz(self) -> float:
        """Mean rate of the measured poses."""
        return NS_PER_S / (float(np.ptp(self.stamps_ns)) / (len(self.stamps_ns) - 1))

    @cached_property
    def one_step(self) -> OneStep | None:
        """The innovations of each measured pose; None without noise, or without a long segment."""
        if np.min(self.recording.measured_noise) < MIN_NOISE:
            return None
        try:
            parts = measured_segments(self.recording)
        except BellowsError:
            return None
        longest = max(parts, key=lambda part: len(part.package))
        stamps = longest.package.stamps_ns
        edge = max(len(stamps) - MAX_INNOVATIONS, 0) // 2
        middle = stamps[[edge, len(stamps) - 1 - edge]]
        segment = Segment(replace(longest, tool=longest.tool.between(*middle),
                                  package=longest.package.between(*middle)))
        search = Search([segment], STRUCTURES['full'], self.cup, {})
        (part,), _, _ = search.system(search.start)
        search.accept([part])  # the path of the tool comes near to the likeliest
        (part,), _, _ = search.system(search.start)
        white = part.innovations.reshape(-1, 6)
        scaled = white * segment.std
        return OneStep(float(np.mean(white**2)), residuals.portmanteau(white),
                       residuals.spectrum(scaled, 1.0 / segment.period))

    @property
    def moves(self) -> Mask:
        """Which axes move enough for noise alone to stay within the limit (6,)."""
        return np.asarray(self.scores.motion * MAX_NRMSE > self.noise)

    @property
    def model_error(self) -> Array:
        """RMS error (6,) beyond that of noise, as part of the motion."""
        excess = np.sqrt(np.maximum(self.scores.rms**2 - self.noise**2, 0.0))
        ratio: Array = np.full(6, np.nan)
        np.divide(excess, self.scores.motion, out=ratio, where=self.scores.motion > 0.0)
        return ratio

    def failing(self, limit: float = MAX_NRMSE) -> tuple[str, ...]:
        """Return the names of the axes that move and whose NRMSE is above a limit."""
        above = self.moves & ~(self.scores.nrmse <= limit)
        return tuple(AXES[i] for i in np.flatnonzero(above))

    @property
    def worse_than_noise(self) -> tuple[str, ...]:
        """Names of the axes that fail, by more than `NOISE_FACTOR` times the noise."""
        beyond = self.scores.rms > NOISE_FACTOR * self.noise
        return tuple(name for name in self.failing() if beyond[AXES.index(name)])

    def verdict(self, limit: float = MAX_NRMSE) -> str:
        """Return in a sentence whether the axes that move are within a limit."""
        part = f'{100.0 * limit:g} % of the motion'
        if failing := self.failing(limit):
            return f'Above {part}: {", ".join(failing)}.'
        if not self.moves.any():
            return 'No axis moves enough for a verdict: record a larger motion.'
        return f'All axes that move are predicted within {part}.'


def validate(cup: Cup, recording: Recording, max_samples: int | None = None) -> Validation:
    """
    Simulate a recording from start to end, and compare it, at the rate of the tool.

    Parameters
    ----------
    cup : Cup
        What is tried.
    recording : Recording
        Not one that the cup was identified from.
    max_samples : int, optional
        Samples from the first valid one on; all where left out.

    Raises
    ------
    BellowsError
        If the recording is too short, the cup cannot carry the package, or the simulation does
        not stay finite.

    """
    poses, gravity = recording.aligned_tool, recording.settings.gravity
    first, last = recording.measured_tool.stamps_ns[[0, -1]]
    poses = poses.select(slice(max(int(np.searchsorted(poses.stamps_ns, first, 'right')) - 1, 0),
                               int(np.searchsorted(poses.stamps_ns, last)) + 1))
    if max_samples is not None:
        poses = poses.select(slice(int(np.argmax(poses.valid)) + max_samples))
    tool, gaps = recording.cached(('smoothed', len(poses)), lambda: smoothed_tool(
        poses, half_window_of(poses)))
    state, begin, start = _start(model_tuple(cup, recording.payload, gravity), tool, recording)
    tool = resample(tool, np.append(begin, tool.stamps_ns[tool.stamps_ns > begin]))
    moved = simulate(cup, recording.payload, tool, state, gravity)
    measured = recording.tracked_package.between(
        max(tool.stamps_ns[0], first), min(tool.stamps_ns[-1], last))
    compared = residuals.compare(
        resample(moved, measured.stamps_ns),
        resample(recording.aligned_tool, measured.stamps_ns,
                 recording.report.tool.timing.longest_step_ns), measured)
    return Validation(
        **vars(compared), cup=cup, recording=recording, tool=tool, package=moved, state=state,
        start=start, warnings=tuple(
            f'The tool is unknown for {duration:.2f} s from {since:.2f} s on. The simulation '
            'bridges this gap by interpolation, and its error is larger for a while afterwards.'
            for since, duration in gaps.tolist() if duration > MAX_BRIDGE_TIME))


def smoothed_tool(measured: Trajectory, half_window: int) -> tuple[Trajectory, Array]:
    """
    Return the tool with twists at every usable stamp, and the bridged gaps (G, 2).

    Parameters
    ----------
    measured : Trajectory
        Poses of E at a uniform rate, not smoothed.
    half_window : int
        Of the filter, samples.

    Returns
    -------
    Trajectory
        Bridged (see `bridged`), and filtered with a short window.
    ndarray (G, 2)
        Start (s, from the first sample) and duration (s) of each gap.

    Raises
    ------
    BellowsError
        If the poses do not fill one window.

    """
    filtered = savgol(bridged(measured), half_window, LIGHT_ORDER)
    usable = np.flatnonzero(filtered.valid)
    if len(usable) < 2:
        raise BellowsError(
            f'The tool has fewer than {2 * half_window + 1} usable poses in a row, so nothing '
            'can be simulated.')
    span = slice(int(usable[0]), int(usable[-1]) + 1)
    tool = replace(filtered.select(span), acceleration=None)
    is_measured = measured.valid[half_window:][span]
    gaps = np.flatnonzero(np.diff(np.flatnonzero(is_measured)) > 1)
    edges = (tool.stamps_ns[is_measured] - measured.stamps_ns[0]) / NS_PER_S
    return tool, np.column_stack([edges[gaps], edges[gaps + 1] - edges[gaps]])


def half_window_of(tool: Trajectory) -> int:
    """Return the half window of the light smoothing, in samples."""
    rate_hz = uniform_rate_hz(tool.stamps_ns)
    return max(round(LIGHT_HALF_WINDOW * rate_hz), LIGHT_ORDER // 2 + 1)


def _start(model: ModelTuple, tool: Trajectory, recording: Recording) -> tuple[State, int, str]:
    """Return the package's first state, its stamp (ns), and its origin."""
    if rest_of(recording.measured_tool, recording.measured_package).seconds < REST_S:
        package = recording.package
        usable = package.valid & (package.stamps_ns >= tool.stamps_ns[0])
        first = int(np.argmax(usable))
        if usable[first]:
            (row,) = tool_rows(package.select(slice(first, first + 1)))
            return state_row(*np.split(row, [3, 7])), int(package.stamps_ns[first]), 'measured'
    state = rest(model, tool_rows(tool.select(slice(0, 1)))[0])
    return state, int(tool.stamps_ns[0]), 'equilibrium'
