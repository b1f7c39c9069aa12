"""How much two clocks are apart, by when two bodies turn alike."""

from bellows_ros.core.geometry.arrays import Array
from bellows_ros.core.geometry.lie import log_so3
from bellows_ros.core.signals.resampling import resample
from bellows_ros.core.signals.trajectory import NS_PER_S, Trajectory
from bellows_ros.errors import BellowsError
import numpy as np

COMPARED_HZ, OVER = 50.0, 15
"""Rate at which turns of the bodies are compared, and over how many samples they go."""

ALIKE = 0.3
"""Correlation of these turns at which two clocks are aligned: of others it is below 0.2."""

TURNING = 0.01
"""Standard deviation of these turns (rad) below which bodies hardly turn."""


def turn_correlation(tool: Trajectory, package: Trajectory) -> tuple[Array, Array]:
    """
    Return lags (K,), s, of the tool's stamps behind the package's, and how alike turns are (K,).

    Empty where a body hardly turns, or is seen too shortly.
    """
    turns = []
    for body in (tool, package):
        count = int((body.stamps_ns[-1] - body.stamps_ns[0]) / NS_PER_S * COMPARED_HZ)
        stamps = body.stamps_ns[0] + np.rint(
            np.arange(count) * (NS_PER_S / COMPARED_HZ)).astype(np.int64)
        if count <= OVER:
            return np.empty(0), np.empty(0)
        R = resample(body, stamps).rotation
        turn = np.linalg.norm(log_so3(np.swapaxes(R[:-OVER], 1, 2) @ R[OVER:]), axis=1)
        if np.std(turn) < TURNING:
            return np.empty(0), np.empty(0)
        turns.append((turn - turn.mean()) / np.linalg.norm(turn - turn.mean()))
    size = sum(map(len, turns)) - 1
    spectra = [np.fft.rfft(own, size) for own in turns]
    product = np.roll(np.fft.irfft(spectra[0] * np.conj(spectra[1]), size), len(turns[1]) - 1)
    lags = (np.arange(len(product)) - len(turns[1]) + 1) / COMPARED_HZ
    return lags + float(tool.stamps_ns[0] - package.stamps_ns[0]) / NS_PER_S, product


def rough_offset(tool: Trajectory, package: Trajectory) -> float:
    """
    Return about how much the tool's stamps are behind the package's (s): where both turn alike.

    Raises
    ------
    BellowsError
        If they do not turn alike at any offset; where they hardly turn they must overlap.

    """
    lags, alike = turn_correlation(tool, package)
    best = int(np.argmax(alike)) if len(lags) else 0
    if len(lags) and alike[best] >= ALIKE:
        return float(lags[best])
    overlap = min(tool.stamps_ns[-1], package.stamps_ns[-1]) - max(
        tool.stamps_ns[0], package.stamps_ns[0])
    if overlap > 0 and not len(lags):
        return 0.0
    raise BellowsError(
        'The stamps of tool and package cannot be aligned: the two do not turn alike at any '
        f'offset (correlation {alike[best] if len(lags) else 0.0:.2f}). Check the topics, or turn '
        'the tool more.')
