"""Central differences on SO(3) x R^3 (appendix F), to compare the Savitzky-Golay filter with."""

from bellows_ros.core.lie import apply, Array, log_so3
from bellows_ros.core.trajectory import (
    Filtered,
    NS_PER_S,
    Trajectory,
    uniform_rate_hz,
    valid_windows,
)
from bellows_ros.errors import BellowsError
import numpy as np

# A velocity needs a neighbour on each side, an acceleration the velocities of both neighbours.
HALF_WINDOW = 2


def central_differences(trajectory: Trajectory) -> Filtered:
    """
    Estimate twists and accelerations by central differences (F.49-F.54).

    The poses stay as they are.

    Parameters
    ----------
    trajectory : Trajectory
        Poses at a uniform rate, N samples. Its own twists are not used.

    Returns
    -------
    Filtered
        The N - 4 samples with two neighbours on each side; valid where all five samples are.

    Raises
    ------
    BellowsError
        If there are fewer than five samples, or their rate is not uniform.

    """
    if len(trajectory) < 2 * HALF_WINDOW + 1:
        raise BellowsError(
            f'Central differences need at least {2 * HALF_WINDOW + 1} samples, not '
            f'{len(trajectory)}. Take a longer recording.'
        )
    rate_hz = uniform_rate_hz(trajectory.stamps_ns)
    inner = slice(HALF_WINDOW, len(trajectory) - HALF_WINDOW)
    span = ((trajectory.stamps_ns[2:] - trajectory.stamps_ns[:-2]) / NS_PER_S)[:, None]
    twist = _twists(trajectory, span)
    return Filtered(
        trajectory.stamps_ns[inner],
        trajectory.position[inner],
        trajectory.rotation[inner],
        twist[1:-1],
        (twist[2:] - twist[:-2]) / span[1:-1],
        valid_windows(trajectory.valid, HALF_WINDOW),
        weights=_weights(rate_hz),
    )


def _twists(trajectory: Trajectory, span: Array) -> Array:
    """Return body twists of all samples but the first and last (F.49, F.50, F.52, F.53)."""
    R, o = trajectory.rotation, trajectory.position
    R_inverse = np.swapaxes(R[1:-1], -1, -2)
    spatial_rate = (log_so3(R[2:] @ R_inverse) - log_so3(R[:-2] @ R_inverse)) / span
    v = apply(R_inverse, (o[2:] - o[:-2]) / span)
    return np.concatenate([v, apply(R_inverse, spatial_rate)], axis=-1)


def _weights(rate_hz: float) -> Array:
    """Return how the derivatives weigh five samples; the second is the first done twice."""
    value = np.array([0.0, 0.0, 1.0, 0.0, 0.0])
    first = 0.5 * rate_hz * np.array([0.0, -1.0, 0.0, 1.0, 0.0])
    second = 0.25 * rate_hz**2 * np.array([1.0, 0.0, -2.0, 0.0, 1.0])
    return np.stack([value, first, second])
