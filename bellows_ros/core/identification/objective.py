"""
How well a cup explains a recording, as a function of what was given with it.

The wrench that the motion needs is linear in K and P (4.67), so that these are eliminated: the
residual is a function of the few quantities that were given (variable projection). Means over
short times lose hardly any motion and most of the noise of accelerations. What noise adds on
average is estimated by adding noise of the same kind once more, and is subtracted: of noise alone
nothing remains.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import NamedTuple

from bellows_ros.core.geometry.arrays import Array, Stamps
from bellows_ros.core.geometry.lie import exp_so3, log_so3
from bellows_ros.core.identification import result
from bellows_ros.core.identification.samples import (
    draws,
    lip_relative,
    Moments,
    regularised,
    Samples,
    samples_of,
    sizes,
)
from bellows_ros.core.identification.variations import Given, Hypothesis, Variation
from bellows_ros.core.model.structure import Structure, THESIS_DAMPING, THESIS_STIFFNESS
from bellows_ros.core.recording.recording import Recording
from bellows_ros.core.signals.resampling import cubic
from bellows_ros.core.signals.savgol import displaced, filtered, weights
from bellows_ros.core.signals.trajectory import NS_PER_S
import numpy as np

RATE_HZ = 60.0
"""Samples per second in use, approximately."""

AVERAGING_TIME = 0.08
"""Time (s) over which equations are averaged."""

MAX_AVERAGES = 300
"""Averages needed for a decision; longer recordings are thinned out."""

STRETCHES, MAX_SECONDS = 12, 60.0
"""Stretches of long recordings that are used, evenly spread, and how long all are together, s."""

MODEL_ERROR = 0.01
"""Fraction of the wrench that no model of rubber explains."""

DRAWS = 2
"""Number of noise draws."""

CLUSTER_AVERAGES = 8
"""Correlated averages per cluster, for standard errors."""

MAX_CUP_FACTOR = 3.0
"""Multiple of the thesis' K and P up to which they enter the first weights."""

FILTER_ORDER = 6
"""Order of the filter of accelerations by default."""

SLIPS = (0.06, 0.4)
"""Fractions of the largest displacement at which the sliders of the friction model slip."""

MIN_SIGNAL_SHARE = 0.05
"""Smallest share of the information on a direction that is taken to be signal."""

MIN_SINGULAR_VALUE = 1e-7
"""Singular values below this fraction of the largest count as zero."""


UNWEIGHTED = np.ones(6)


class Ensemble(NamedTuple):
    """
    Recordings, and the same with noise once more.

    Parameters
    ----------
    given : tuple of Given
        Of each recording.
    noise_draws : tuple of tuple of Given
        For each draw the same with noise added.
    weight : ndarray (6,)
        One over the standard deviation of each component of a mean's residual.

    """

    given: tuple[Given, ...]
    noise_draws: tuple[tuple[Given, ...], ...]
    weight: Array = UNWEIGHTED

    def varied(self, variation: Variation, theta: Array) -> 'Ensemble':
        """Return them with what was given varied by some numbers."""
        given, *draws = (tuple(variation(recording, theta) for recording in run)
                         for run in (self.given, *self.noise_draws))
        return Ensemble(given, tuple(draws), self.weight)

    def weighted(self, sound: bool = False) -> 'Ensemble':
        """
        Return them with weights that come from noise, and a small part of the wrench.

        Noise in the cup's wrench grows with K and P. These may be absurd where what was given is
        wrong; unless it is sound, they count up to a multiple of those of the thesis' cup.
        """
        parts = [equations(given) for given in self.given]
        wrench = np.concatenate([clean[:, :, -1] for clean in parts])
        structure = self.given[0].structure
        spread = np.diag(regularised(Moments.of(wrench).covariance(structure)))
        x = self._replace(weight=1.0 / np.sqrt(spread)).solved().x
        if not sound:
            limit = MAX_CUP_FACTOR * structure.parameters(
                np.diag(THESIS_STIFFNESS), np.diag(THESIS_DAMPING))
            x = np.clip(x[:len(limit)], -limit, limit)
        noise = np.zeros(6)
        for draw in self.noise_draws:
            added = np.concatenate(
                [equations(n) - clean for n, clean in zip(draw, parts, strict=True)])
            noise += np.mean((added @ np.append(x, -1.0)) ** 2, axis=0) / len(self.noise_draws)
        return self._replace(weight=1.0 / np.sqrt(noise + MODEL_ERROR**2 * spread))

    def _rows(self, given: Sequence[Given]) -> Array:
        """Return the weighted rows [A b] (N, p + 1) of recordings."""
        rows = np.concatenate([equations(recording) for recording in given]) * self.weight[:, None]
        return rows.reshape(-1, rows.shape[2])

    def solved(self) -> 'Solved':
        """
        Return the compensated least-squares solution, and its residual.

        That is what noise does not explain, in wrenches weighted by what is expected of them.
        """
        rows = self._rows(self.given)
        scale = np.linalg.norm(rows, axis=0)
        scale = np.where(scale > 0.0, scale, 1.0)
        full = rows / scale
        noise = np.zeros((full.shape[1],) * 2)
        for draw in self.noise_draws:
            added = self._rows(draw) / scale - full
            noise += added.T @ added / len(self.noise_draws)
        U, s, Vt = np.linalg.svd(full[:, :-1], full_matrices=False)
        determined = s > MIN_SINGULAR_VALUE * s[0]
        root = Vt[determined].T / s[determined]
        share, V = np.linalg.eigh(root.T @ noise[:-1, :-1] @ root)
        root = root @ V / np.sqrt(np.maximum(1.0 - share, MIN_SIGNAL_SHARE))
        slope = root.T @ (full[:, :-1].T @ full[:, -1] - noise[:-1, -1])
        remaining = float(full[:, -1] @ full[:, -1] - noise[-1, -1] - slope @ slope)
        x = root @ slope / scale[:-1] * scale[-1]
        root = root / scale[:-1, None]
        excess = remaining * scale[-1] ** 2 / len(rows)
        return Solved(rows, x, excess, U[:, determined], root @ root.T)


def ensemble_of(
    recordings: Sequence[Recording], length: float, structure: Structure
) -> Ensemble:
    """Return recordings and the same with noise once more, thinned."""
    def given(recording: Recording, draw: np.random.Generator | None = None) -> Given:
        settings, samples = recording.settings, samples_of(recording)
        rate = 1e9 / float(np.median(np.diff(samples.package.stamps_ns)))
        thinned = samples.thinned(max(int(RATE_HZ / rate * len(samples.tool)), 1))
        thinned = _selected_stretches(thinned, MAX_SECONDS / len(recordings))
        if draw is not None:
            thinned = _with_noise(recording, thinned, draw)
        bins = _averaging_bins(thinned.package.stamps_ns)
        every = -(-len(np.unique(bins)) * len(recordings) // MAX_AVERAGES)
        body = replace(thinned.package, valid=thinned.package.valid & (bins % every == 0))
        return Given(replace(thinned, package=body), length, structure,
                     settings.package_frame == 'lip', settings.align_at_rest)

    return Ensemble(
        tuple(map(given, recordings)),
        tuple(tuple(given(recording, draw) for recording in recordings) for draw in draws(DRAWS)))


def _selected_stretches(samples: Samples, max_duration: float) -> Samples:
    """Return stretches of samples, at most so many seconds, whose ends are not valid."""
    stamps = samples.tool.stamps_ns
    duration = (stamps[-1] - stamps[0]) / NS_PER_S
    if duration <= max_duration:
        return samples
    used = np.linspace(0.0, STRETCHES, len(stamps), endpoint=False) % 1.0 < max_duration / duration
    inner = used & np.append(used[1:], False) & np.append(False, used[:-1])
    selected = samples.select(used)
    return replace(selected, tool=replace(selected.tool, valid=selected.tool.valid & inner[used]))


def _with_noise(recording: Recording, samples: Samples, draw: np.random.Generator) -> Samples:
    """Return samples of a recording with as much noise once more, through the same filters."""
    stamps, of_tool = samples.package.stamps_ns, recording.aligned_tool.stamps_ns
    tool_noise, package_noise = (
        np.hstack([part.drawn(len(body), draw) for part in noise])
        for body, noise in zip((recording.aligned_tool, recording.aligned_package),
                               recording.ar1_noise, strict=True))
    package = filtered(package_noise, recording.filters[1].weights,
                       np.searchsorted(recording.aligned_package.stamps_ns, stamps))
    # As the tool itself, on the cubic polynomial between two filtered samples.
    half = recording.filters[0].half_window
    before = np.clip(np.searchsorted(of_tool, stamps, side='right') - 1,
                     half, len(of_tool) - half - 2)
    step_ns = (of_tool[before + 1] - of_tool[before])[:, None]
    s, h = (stamps - of_tool[before])[:, None] / step_ns, step_ns / NS_PER_S
    (a, a_rate, _), (b, b_rate, _) = (
        filtered(tool_noise, recording.filters[0].weights, before + k) for k in (0, 1))
    value, rate = cubic(s, h * a_rate, b - a, h * b_rate)
    moved = np.array([a + value, rate / h])
    return replace(samples, tool=displaced(samples.tool, *np.split(moved, 2, axis=2)),
                   package=displaced(samples.package, *np.split(package, 2, axis=2)))


def _averaging_bins(stamps_ns: Stamps) -> Stamps:
    """Return which mean each stamp belongs to, whatever the first one is."""
    return stamps_ns // int(AVERAGING_TIME * NS_PER_S)


def equations(given: Given) -> Array:
    """Return means (N, 6, p + 1) of the rows [L c]."""
    lip = given.samples.lip
    L = np.concatenate([block.A for block in lip.equations(given.length, given.structure)])
    rows = np.dstack([L, *_extra_columns(given, L), lip.wrench])
    bins = _averaging_bins(lip.stamps_ns)
    starts = np.unique(bins, return_index=True)[1]
    counts = np.diff([*starts, len(bins)])
    full = counts >= 0.7 * np.median(counts)
    return np.asarray(np.add.reduceat(rows, starts, axis=0)[full] / counts[full, None, None])


def extra_entries(structure: Structure, name: str) -> list[int]:
    """Return the entries of K that have a column more each."""
    return [i for i, (row, column) in enumerate(structure.leads)
            if row == column or name == 'drift']


def _extra_columns(given: Given, L: Array) -> list[Array]:
    """Return columns of a cup that drifts, is not linear, or has friction."""
    lip, entries = given.samples.lip, extra_entries(given.structure, given.extra)
    if given.extra == 'drift':
        since = (lip.stamps_ns - lip.stamps_ns[0]) / NS_PER_S
        return [(since / since[-1] - 0.5)[:, None, None] * L[:, :, entries]]
    if given.extra == 'cubic':
        size = sizes(lip.displacement(given.length))
        leads = [given.structure.leads[i][0] for i in entries]
        square = (size[:, leads] / size[:, leads].max(axis=0)) ** 2
        return [part[:, None, :] * L[:, :, entries] for part in (square, square**2)]
    if given.extra == 'friction':
        columns = []
        for z in _slider_displacements(given):
            slider = replace(
                lip, position=z[lip.index, :3] - [0.0, 0.0, given.length],
                rotation=exp_so3(z[lip.index, 3:]))
            parts = slider.equations(given.length, given.structure)
            columns.append(np.concatenate([part.A[:, :, entries] for part in parts]))
        return columns
    return []


def _slider_displacements(given: Given) -> Array:
    """Return the displacements (2, N, 6) of two sliders that the lip drags along (Dahl, 1968)."""
    samples = given.samples
    position, rotation, _ = lip_relative(samples.tool, samples.package, samples.payload.com)
    displacement = np.hstack([position + [0.0, 0.0, given.length], log_so3(rotation)])
    steps = np.nan_to_num(np.diff(displacement, axis=0, prepend=displacement[:1]))
    valid = displacement[samples.valid]
    amplitude = np.maximum(sizes(valid - valid.mean(axis=0)).max(axis=0), 1e-12)
    retained = 1.0 / (1.0 + sizes(steps) / np.multiply.outer(SLIPS, amplitude)[:, None])
    z, dragged = np.zeros((len(SLIPS), 6)), np.empty_like(retained)
    for k, step in enumerate(steps):
        z = dragged[:, k] = (z + step) * retained[:, k]
    # Seen through a filter, as accelerations are.
    rate_hz = NS_PER_S / float(np.median(np.diff(samples.tool.stamps_ns)))
    half_window = max(round(0.5 * samples.window * rate_hz), 1)
    W = weights(half_window, min(FILTER_ORDER, 2 * half_window), rate_hz)[:1]
    ends = np.pad(dragged, ((0, 0), (half_window, half_window), (0, 0)), mode='edge')
    index = np.arange(half_window, half_window + len(displacement))
    return np.concatenate([filtered(z, W, index) for z in ends])


class Solved(NamedTuple):
    """
    The rows [A b], the cup x (p,), mean squared residual beyond noise, a basis of A.

    And the inverse (p, p) of the information on x that is of motion, not of noise.
    """

    rows: Array
    x: Array
    excess: float
    basis: Array
    inverse: Array

    @property
    def residuals(self) -> int:
        """How many there are."""
        return len(self.rows)

    @property
    def covariance(self) -> Array:
        """Covariance (p, p) of x, that of what is not identifiable finite: 0 times it is 0."""
        return np.nan_to_num(
            self.covariance_of(self.rows[:, :-1], self.inverse), posinf=UNIDENTIFIABLE_VARIANCE)

    def covariance_of(self, D: Array, inverse: Array) -> Array:
        """
        Return the covariance that allows for residuals that hang together in clusters.

        Of columns D that have noise, with the inverse of the information that is of motion alone.
        """
        unknown = np.isinf(np.diag(result.covariance_of(D.T @ D)))
        scores = np.add.reduceat(
            D * (self.rows @ np.append(self.x, -1.0))[:, None],
            range(0, len(D), 6 * CLUSTER_AVERAGES))
        return result.with_unidentifiable(inverse @ scores.T @ scores @ inverse, unknown)


UNIDENTIFIABLE_VARIANCE = 1e200
"""Variance of what is not identifiable."""

ROUNDS, HALVINGS = 12, 5

CONVERGED = 0.05
"""Converged when a step is shorter than this fraction of the standard error."""


def refine(
    ensemble: Ensemble, hypothesis: Hypothesis, start: Array | None, rounds: int
) -> tuple[Array, Array, Solved]:
    """
    Return the numbers (n,) of a hypothesis with which noise explains most, and what is left.

    With their covariance (n, n), infinite where not identifiable. The search begins at a start.
    Without one it begins at 0 and at the best of its starts, and the better minimum is returned.
    Where K is far too small, steps are too long: they are halved as long as less is left.
    """
    steps = np.array(hypothesis.steps)

    def at(theta: Array) -> Solved:
        """Return the residuals at given unknowns."""
        return ensemble.varied(hypothesis.variation, theta).solved()

    if start is None:
        quiet = ensemble._replace(noise_draws=())
        near = min([np.zeros(len(steps)), *hypothesis.starts(ensemble.given[0])],
                   key=lambda theta: quiet.varied(hypothesis.variation, theta).solved().excess)
        starts = [near, np.zeros_like(near)] if near.any() else [near]
        return min((refine(ensemble, hypothesis, begin, rounds) for begin in starts),
                   key=lambda refined: refined[2].excess)
    theta, current = start, at(start)
    for _ in range(rounds):
        gradient, D = _derivatives(at, theta, current, steps)
        inverse = result.inverse_of(D.T @ D, np.full(D.shape[1], True))
        step = -inverse @ gradient
        largest = hypothesis.furthest * steps
        step *= min(1.0, float(np.min(largest / np.maximum(np.abs(step), 1e-300))))
        best, accepted = current, np.zeros_like(step)
        for shorter in np.outer(0.5 ** np.arange(HALVINGS), step):
            further = at(theta + shorter)
            if further.excess < best.excess:
                best, accepted = further, shorter
            elif best is not current:
                break
        theta, current, covariance = theta + accepted, best, best.covariance_of(D, inverse)
        if np.all(np.abs(accepted) <= CONVERGED * np.sqrt(np.diag(covariance))):
            break
    return theta, covariance, current


def _derivatives(
    at: Callable[[Array], Solved], theta: Array, solved: Solved, steps: Array
) -> tuple[Array, Array]:
    """Return half the gradient (n,) of the sum of squares, and the residuals' Jacobian (N, n)."""
    gradient, columns = [], []
    for step, change in zip(steps, np.diag(steps), strict=True):
        after, before = at(theta + change), at(theta - change)
        gradient.append(0.25 * solved.residuals * (after.excess - before.excess) / step)
        columns.append((after.rows - before.rows) @ np.append(solved.x, -1.0) / (2.0 * step))
    D = np.column_stack(columns)
    D -= solved.basis @ (solved.basis.T @ D)  # what the cup explains as well
    return np.array(gradient), D
