"""
Noise of poses in the frequency domain, through the linearised cup.

Noise n of the tool's poses moves the simulated package by G n, so that differences have the
spectrum C(f) = R + G Q G^H, with spectra R of the package's poses and Q of the tool's. G follows
from small motions d of the package,

    d'' = A_p d + A_v d' + B_p S0 n + B_v (S0 n)',

with the response S0 of the filter of the tool's path. Its slopes follow S1, but the cubic curves
between the rows of a path have the slopes of its poses on average. With
exact poses of the tool, this is output error; with noisy ones, the sum of squares is the minimum
over all paths of the tool (total least squares).
"""

from typing import Any, NamedTuple

from bellows_ros.core.geometry.arrays import Array
from bellows_ros.core.model.equilibrium import linearise
from bellows_ros.core.model.kernels import ModelTuple, State
from bellows_ros.core.recording.recording import BodyNoise
import numpy as np

PADDING = 1.0
"""Length of zeros behind a series, s: a swing decays before the series begins again."""


def spectrum(noise: BodyNoise, period: float, frequency: Array) -> Array:
    """Return spectra (F, 6) of noise of poses, m^2/Hz and rad^2/Hz, at frequencies (F,)."""
    memory = noise.correlation
    turn = np.abs(1.0 - memory * np.exp(-2j * np.pi * period * frequency)[:, None]) ** 2
    return np.asarray(period * noise.std**2 * (1.0 - memory**2) / turn)


class Response(NamedTuple):
    """Responses to noise of the tool: of the package (F, 6, 6), and of the path (2, F)."""

    package: Array
    path: Array

    @classmethod
    def of(
        cls, model: ModelTuple, tool: State, body: State, weights: Array, period: float,
        frequency: Array,
    ) -> 'Response':
        """
        Return the responses of a linear model.

        Parameters
        ----------
        model, tool, body : tuples
            Model and the state at rest about which it is linear.
        weights : ndarray (3, 2n+1)
            Weights of the filter of the tool's path.
        period : float
            Time between poses of the tool, s.
        frequency : ndarray (F,)
            Frequencies, Hz.

        """
        lags = np.arange(weights.shape[1]) - weights.shape[1] // 2
        iw = 2j * np.pi * frequency
        path: Any = weights[:2] @ np.exp(period * np.outer(lags, iw))
        path[:, frequency > 0.5 / period] = 0.0
        by = linearise(model, tool, body)
        left = iw[:, None, None] ** 2 * np.eye(6) - iw[:, None, None] * by.body_twist - (
            by.body_pose)
        right = path[0, :, None, None] * (by.tool_pose + iw[:, None, None] * by.tool_twist)
        return cls(np.asarray(np.linalg.solve(left, right)), np.asarray(path))


class Whitening(NamedTuple):
    """
    Filter that whitens series (N, 6) of differences.

    Spectrum (F, 6, 6) of the differences times their rate, inverse root (F, 6, 6), spectrum (F, 6)
    of the tool's noise times the rate of the differences, and the responses to it.
    """

    total: Array
    inverse: Array
    of_tool: Array
    response: Response

    @classmethod
    def of(cls, package: Array, tool: Array, rate: float, response: Response) -> 'Whitening':
        """Return the filter for spectra (F, 6) of both bodies, and the rate of differences, Hz."""
        G = response.package
        C = rate * ((G * tool[:, None]) @ _adjoint(G) + (
            package[:, :, None] * np.eye(6)))
        return cls(C, np.linalg.inv(np.linalg.cholesky(C)), rate * tool, response)

    @property
    def logs(self) -> float:
        """Sum of the logarithms of all variances, of a padded series."""
        return -4.0 * float(np.sum(np.log(np.abs(np.einsum('fii->fi', self.inverse)))))

    def whitened(self, series: Array) -> Array:
        """Return series (N, 6, q) as white noise of variance 1."""
        return filtered(self.inverse, series)

    def likeliest(self, white: Array) -> Array:
        """Return the likeliest noise (N, 6) of the tool, m and rad, by white noise (N, 6)."""
        gain = -self.of_tool[:, :, None] * _adjoint(self.response.package) @ _adjoint(self.inverse)
        return filtered(gain, white[..., None])[..., 0]


def _adjoint(matrices: Array) -> Array:
    """Return conjugate transposes of matrices (F, 6, 6)."""
    return np.conj(np.swapaxes(matrices, 1, 2))


def padded(count: int, period: float) -> int:
    """Return the length of a padded series."""
    return 2 * ((count + round(PADDING / period) + 1) // 2)


def frequencies(count: int, period: float) -> Array:
    """Return those (F,) of a padded series, Hz."""
    return np.asarray(np.fft.rfftfreq(padded(count, period), period))


def filtered(response: Array, series: Array) -> Array:
    """Return the series (N, 6, q) behind a filter of a response (F, 6, 6)."""
    count, size = len(series), 2 * (len(response) - 1)
    spectra = np.fft.rfft(series, size, axis=0)
    return np.asarray(np.fft.irfft(response @ spectra, size, axis=0)[:count])
