"""
What is identifiable: limits, and covariances in which some directions are not known at all.

A parameter that has a part in such a direction has an infinite variance and no covariances; the
information about it is zero.
"""

from bellows_ros.core.arrays import Array, Mask
import numpy as np

LARGEST_CONDITION = 1e6
"""Combinations of parameters with singular values below this part of the largest are not known."""

ROUNDING = 1e-12
"""Eigenvalues of scaled information below this part of the largest are rounding."""

IN_NULL_SPACE = 0.05
"""A parameter with at least this part in a direction that is not known is not identifiable."""

NO_EFFECT = 1e-8
"""A parameter whose column is smaller than this part of those of its kind has no effect."""

LEAST_SIGNAL = 0.05
"""Noise is taken to leave at least this part of the information on a direction."""


def covariance_of(information: Array) -> Array:
    """
    Return the covariance (n, n) of parameters with this information.

    What is not known has inf on the diagonal and 0 beside it; the rest is as if it were left out.
    """
    known = identifiable_by(information)
    covariance = np.diag(np.where(known, 0.0, np.inf))
    index = np.flatnonzero(known)
    if len(index):
        part = information[np.ix_(index, index)]
        scale = np.sqrt(np.diag(part))
        unit = np.outer(scale, scale)
        values, vectors = np.linalg.eigh(part / unit)
        kept = values > ROUNDING * values[-1]
        inverse = (vectors[:, kept] / values[kept]) @ vectors[:, kept].T
        covariance[np.ix_(index, index)] = inverse / unit
    return covariance


def identifiable_by(information: Array) -> Mask:
    """Return which of n parameters an information matrix (n, n) determines."""
    diagonal = np.diag(information)
    seen = diagonal > 0.0
    known: Mask = np.zeros(len(diagonal), dtype=bool)
    index = np.flatnonzero(seen)
    if not len(index):
        return known
    scale = np.sqrt(diagonal[index])
    values, vectors = np.linalg.eigh(information[np.ix_(index, index)] / np.outer(scale, scale))
    null = vectors[:, values <= ROUNDING * values[-1]]
    known[index] = ~np.any(np.abs(null) > IN_NULL_SPACE, axis=1)
    return known


def information_of(covariance: Array) -> Array:
    """Return the information (n, n) of a covariance, zero where that is infinite."""
    index = np.flatnonzero(np.isfinite(np.diag(covariance)))
    information = np.zeros_like(covariance)
    if len(index):
        part = covariance[np.ix_(index, index)]
        scale = np.sqrt(np.diag(part))
        scale = np.where(scale > 0.0, scale, 1.0)
        unit = np.outer(scale, scale)
        information[np.ix_(index, index)] = np.linalg.pinv(part / unit, hermitian=True) / unit
    return information


def without(covariance: Array, unknown: Mask) -> Array:
    """Return a covariance in which some parameters (n,) are made unknown."""
    known = ~unknown
    result = np.where(np.outer(known, known), covariance, 0.0)
    result[np.diag_indices_from(result)] = np.where(known, np.diag(covariance), np.inf)
    return result
