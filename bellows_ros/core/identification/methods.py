"""The methods of fitting, by the names of the parameter `fit.method`."""

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import replace
import math
from typing import Any

from bellows_ros.core.identification.advice.added_noise import FilterNoise
from bellows_ros.core.identification.advice.time_offset import LARGEST_OFFSET
from bellows_ros.core.identification.prediction.measured import measured_stretches
from bellows_ros.core.identification.prediction.pace import in_words, TYPICAL_STEPS
from bellows_ros.core.identification.prediction.prediction_error import prediction_error
from bellows_ros.core.identification.regression.least_squares import least_squares, Samples
from bellows_ros.core.identification.regression.noise_products import noise_products
from bellows_ros.core.identification.regression.relative_filter import relative_samples
from bellows_ros.core.identification.result import Fit, Iteration
from bellows_ros.core.identification.statics.static_rows import Holds, joined_with_rest, Length
from bellows_ros.core.identification.structure import Structure, structure_named
from bellows_ros.core.lie import exp_so3
from bellows_ros.core.model import Cup, cup_of, Package
from bellows_ros.core.recording.preparation import Recording, Report, TimeOffset
from bellows_ros.core.score import relative_coordinates
from bellows_ros.core.trajectory import uniform_rate_hz
from bellows_ros.errors import BellowsError
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Progress = Callable[[str, float], None]

LOOKED_AT_EVERY = 20
"""So many samples are stepped over where only the arrangement is looked at."""

LENGTH_STEP = 1e-5
"""Change of cup.length (m) for derivatives."""


def fitted(
    recordings: Sequence[Recording],
    held: Sequence[Package],
    values: Mapping[str, Any],
    progress: Progress | None = None,
    untold: Collection[str] = (),
    holds: Holds = (),
    length_std: float = 0.0,
) -> Fit:
    """
    Fit a cup to prepared recordings as the parameters say.

    Parameters
    ----------
    recordings : sequence of Recording
        All of one cup.
    held : sequence of Package
        The package in each of them.
    values : mapping
        Parameters by name: fit.*, cup.*, gravity.
    progress : callable, optional
        Called with what is being done and the part (0 to 1) that is done.
    untold : collection of str
        Labels of parameters that nothing but noise tells.
    holds : sequence of (Hold, Package)
        Standstills of the same cup, whose balance counts, too.
    length_std : float
        Standard error of cup.length, m.

    Raises
    ------
    BellowsError
        If the recordings do not determine the cup.

    """
    moving = _of_motion(recordings, held, values, progress).without(untold)
    if values['fit.time_offset']:
        moving = with_offsets(moving, [recording.report for recording in recordings])
    if not holds:
        return moving
    slopes = np.zeros(len(moving.labels))
    if length_std > 0.0:
        slopes = _length_slopes(recordings, held, values)
    length = Length(values['cup.length'], length_std, slopes)
    return joined_with_rest(moving, holds, length, values['gravity'], cup_of(values).stiffness)


def with_offsets(fit: Fit, reports: Sequence[Report]) -> Fit:
    """Return a fit with all that the tool's stamps are behind: what was taken off, and its own."""
    taken = [report.time_offset or TimeOffset(0.0, math.inf) for report in reports]
    if not fit.delays:
        values, errors = zip(*taken, strict=True)
        return replace(fit, delays=values, delays_std=errors)
    delays = tuple(own + offset.value for own, offset in zip(fit.delays, taken, strict=True))
    return replace(fit, delays=delays)


def _length_slopes(
    recordings: Sequence[Recording], held: Sequence[Package], values: Mapping[str, Any]
) -> Array:
    """Return the derivatives (2 n,) of the parameters that least squares finds by cup.length."""
    structure = structure_named(values['fit.structure'])
    samples = [filtered_samples(r, p, values) for r, p in zip(recordings, held, strict=True)]
    ends = [
        least_squares(samples, values['cup.length'] + side, structure)
        for side in (LENGTH_STEP, -LENGTH_STEP)
    ]
    first, second = (structure.parameters(fit.stiffness, fit.damping) for fit in ends)
    return np.asarray((first - second) / (2.0 * LENGTH_STEP))


def _of_motion(
    recordings: Sequence[Recording],
    held: Sequence[Package],
    values: Mapping[str, Any],
    progress: Progress | None,
) -> Fit:
    """Return the fit to recordings of motions."""
    length, gravity = values['cup.length'], values['gravity']
    samples = [
        filtered_samples(recording, package, values)
        for recording, package in zip(recordings, held, strict=True)
    ]
    structure = structure_named(values['fit.structure'])
    if values['fit.method'] == 'least_squares':
        noise = np.sum([
            noise_products(part, FilterNoise.of(recording), length, structure)
            for part, recording in zip(samples, recordings, strict=True)
        ], axis=0)
        return least_squares(samples, length, structure, noise)
    start = start_cup(samples, structure, cup_of(values))
    margin = LARGEST_OFFSET if values['fit.time_offset'] else 0.0
    stretches = [
        stretch
        for number, (recording, package) in enumerate(zip(recordings, held, strict=True))
        for stretch in measured_stretches(
            recording.aligned_tool, recording.aligned_package, package, gravity, margin, number
        )
    ]
    return prediction_error(
        stretches, length, structure, start, _teller(progress), values['fit.time_offset']
    )


def filtered_samples(recording: Recording, held: Package, values: Mapping[str, Any]) -> Samples:
    """
    Return what least squares takes, filtered as the parameter filter.relative says.

    Raises
    ------
    BellowsError
        If the package is not on that side of the tool where the cup is.

    """
    _require_below(recording, held)
    if values['filter.relative']:
        orders = values['filter.tool.order'], values['filter.package.order']
        return relative_samples(recording, held, values['gravity'], orders)
    return samples_of(recording, held, values['gravity'])


def _require_below(recording: Recording, held: Package) -> None:
    """Refuse a recording whose package is mostly not below the tool, along its z axis."""
    some = np.flatnonzero(recording.valid)[::LOOKED_AT_EVERY]
    package = recording.measured_package.select(some)
    relative = relative_coordinates(recording.measured_tool.select(some), package)
    lip = relative[:, :3] - exp_so3(relative[:, 3:]) @ held.com
    above = float(np.median(lip[:, 2])) if len(some) else 0.0
    if above > 0.0:
        raise BellowsError(
            f'The lip of the cup is {1e3 * above:.0f} mm above the tool tip in axes of the tool, '
            'but the cup hangs below it. Are topics.tool_pose and topics.package_pose exchanged? '
            'Does z of the tool point from the cup back into the arm? Are recording.world and '
            'package.com right?'
        )


def samples_of(recording: Recording, held: Package, gravity: float) -> Samples:
    """Return a prepared recording as least squares takes it."""
    rate_hz = uniform_rate_hz(recording.package.stamps_ns)
    window = recording.package_weights.shape[1] / rate_hz
    return Samples(recording.tool, recording.package, held, gravity, window)


def start_cup(samples: list[Samples], structure: Structure, known: Cup) -> Cup:
    """
    Return the cup that the prediction error starts from: few parameters are found safely.

    What the samples do not tell, or tell to be below zero, is that of a known cup.
    """
    simple = structure if structure.name != 'full' else structure_named('diagonal')
    fit = least_squares(samples, known.length, simple)
    stiffness, damping = (
        np.where(np.isfinite(error) & (found >= 0.0), found, instead)
        for found, error, instead in (
            (fit.stiffness, fit.stiffness_std, known.stiffness),
            (fit.damping, fit.damping_std, known.damping),
        )
    )
    return Cup(stiffness, damping, known.length)


def _teller(progress: Progress | None) -> Callable[[Iteration], None] | None:
    """Return what tells an iteration in words."""
    if progress is None:
        return None
    iterations: list[Iteration] = []

    def tell(iteration: Iteration) -> None:
        """Tell it with those before, which say how long it takes."""
        iterations.append(iteration)
        done = len(iterations)
        progress(in_words(iterations), done / (done + TYPICAL_STEPS))

    return tell
