"""The methods of fitting, by the names of the parameter `fit.method`."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

from bellows_ros.core.identification.least_squares import least_squares, Samples
from bellows_ros.core.identification.measured import measured_stretches
from bellows_ros.core.identification.prediction_error import FEWEST_STAGES, prediction_error
from bellows_ros.core.identification.relative_filter import relative_samples
from bellows_ros.core.identification.result import Fit, Iteration
from bellows_ros.core.identification.structure import Structure, structure_named
from bellows_ros.core.model import Cup, Package
from bellows_ros.core.recording.preparation import Recording
from bellows_ros.core.trajectory import uniform_rate_hz

Progress = Callable[[str, float], None]

LARGEST_OFFSET = 0.05
"""Time offsets of the streams are looked for up to this, s."""


def fitted(
    recordings: Sequence[Recording],
    held: Sequence[Package],
    values: Mapping[str, Any],
    progress: Progress | None = None,
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
        Parameters by name: fit.*, cup.length, gravity.
    progress : callable, optional
        Called with what is being done and the part (0 to 1) that is done.

    Raises
    ------
    BellowsError
        If the recordings do not determine the cup.

    """
    length, gravity = values['cup.length'], values['gravity']
    samples = [
        filtered_samples(recording, package, values)
        for recording, package in zip(recordings, held, strict=True)
    ]
    structure = structure_named(values['fit.structure'])
    if values['fit.method'] == 'least_squares':
        return least_squares(samples, length, structure)
    start = _start(samples, length, structure)
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
    """Return what least squares takes, filtered as the parameter filter.relative says."""
    if values['filter.relative']:
        orders = values['filter.tool.order'], values['filter.package.order']
        return relative_samples(recording, held, values['gravity'], orders)
    return samples_of(recording, held, values['gravity'])


def samples_of(recording: Recording, held: Package, gravity: float) -> Samples:
    """Return a prepared recording as least squares takes it."""
    rate_hz = uniform_rate_hz(recording.package.stamps_ns)
    window = recording.package_weights.shape[1] / rate_hz
    return Samples(recording.tool, recording.package, held, gravity, window)


def _start(samples: list[Samples], length: float, structure: Structure) -> Cup:
    """Return the cup that the prediction error starts from: few parameters are found safely."""
    simple = structure if structure.name != 'full' else structure_named('diagonal')
    fit = least_squares(samples, length, simple)
    return Cup(fit.stiffness, fit.damping, length)


def _teller(progress: Progress | None) -> Callable[[Iteration], None] | None:
    """Return what tells an iteration in words."""
    if progress is None:
        return None

    def tell(iteration: Iteration) -> None:
        part = iteration.number / (iteration.number + FEWEST_STAGES)
        progress(
            f'iteration {iteration.number}: chi^2 {iteration.chi2:.4g}, '
            f'K x {iteration.stiffness[0, 0]:.5g} N/m', part)

    return tell
