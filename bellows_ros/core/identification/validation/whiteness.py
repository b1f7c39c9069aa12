"""
Whether a residual is white: the portmanteau test.

Residuals with samples missing (NaN) are taken as they are: pairs of the samples there.
"""

from dataclasses import dataclass

from bellows_ros.core.arrays import Array, Mask
from bellows_ros.errors import BellowsError
import numpy as np
from scipy.special import chdtrc

LAGS = 20
"""Lags of the portmanteau test."""

CONFIDENT = 0.01
"""Probability below which a residual is not called white."""

SMALL = 0.1
"""Autocorrelation below which a colour does not matter: it explains 1 % of the next residual."""


@dataclass(frozen=True, eq=False)
class Whiteness:
    """
    The portmanteau test of Ljung and Box on C channels.

    Parameters
    ----------
    samples : int
        Samples of each channel.
    autocorrelation : ndarray (L, C)
        At lags 1 to L, without unit.
    statistic : ndarray (C,)
        Q = n (n + 2) sum of r_k^2 / n_k over the lags k, with n_k pairs of samples k apart; for a
        white channel distributed as chi^2 with L degrees of freedom. NaN for a constant channel.
    p_value : ndarray (C,)
        Probability of at least this Q for a white channel.

    """

    samples: int
    autocorrelation: Array
    statistic: Array
    p_value: Array

    @property
    def lags(self) -> int:
        """Number of lags."""
        return len(self.autocorrelation)

    @property
    def words(self) -> tuple[str, ...]:
        """'white', 'nearly white' or 'coloured' for each channel."""
        small = self.largest < SMALL
        return tuple(
            'white' if white else 'nearly white' if little else 'coloured'
            for white, little in zip(self.white.tolist(), small.tolist(), strict=True)
        )

    @property
    def white(self) -> Mask:
        """Where nothing speaks against whiteness (C,)."""
        return ~(self.p_value < CONFIDENT)

    @property
    def largest(self) -> Array:
        """Largest autocorrelation of any lag (C,): how coloured, however many the samples are."""
        return np.asarray(np.abs(self.autocorrelation).max(axis=0))


def portmanteau(residuals: Array, lags: int = LAGS) -> Whiteness:
    """
    Test whether residuals are white.

    Parameters
    ----------
    residuals : ndarray (N, C)
        At a uniform rate, about zero; NaN where a sample is missing.
    lags : int
        How many lags count.

    Raises
    ------
    BellowsError
        If there are too few samples for the lags.

    """
    there = np.asarray(np.isfinite(residuals).all(axis=1))
    count = int(np.count_nonzero(there))
    pairs = np.array([np.count_nonzero(there[k:] & there[:-k]) for k in range(1, lags + 1)])
    if count <= lags or len(residuals) <= lags or pairs.min() == 0:
        raise BellowsError(
            f'{count} residuals are too few to test whether they are white over {lags} lags.'
        )
    e = np.where(there[:, None], residuals, 0.0)
    power = np.sum(e**2, axis=0)
    products = np.array([np.sum(e[k:] * e[:-k], axis=0) for k in range(1, lags + 1)])
    r = np.full_like(products, np.nan)
    np.divide(products, power, out=r, where=power > 0.0)
    Q = count * (count + 2) * np.sum(r**2 / pairs[:, None], axis=0)
    return Whiteness(count, r, Q, chdtrc(lags, Q))
