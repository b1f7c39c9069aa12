"""
Covariances in which some directions are not known at all, and the information they stand for.

A parameter that has a part in such a direction has an infinite variance and no covariances; the
information about it is zero.
"""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

NOTHING_TOLD = 1e-12
"""Eigenvalues of scaled information below this part of the largest are rounding."""

IN_NULL_SPACE = 0.05
"""A parameter that has at least this part in a direction of which nothing is told is not told."""


def covariance_of(information: Array) -> Array:
    """
    Return the covariance (n, n) of parameters with this information.

    What is not told has inf on the diagonal and 0 beside it; the rest is as if it were left out.
    """
    told = told_by(information)
    covariance = np.diag(np.where(told, 0.0, np.inf))
    index = np.flatnonzero(told)
    if len(index):
        part = information[np.ix_(index, index)]
        scale = np.sqrt(np.diag(part))
        unit = np.outer(scale, scale)
        values, vectors = np.linalg.eigh(part / unit)
        kept = values > NOTHING_TOLD * values[-1]
        inverse = (vectors[:, kept] / values[kept]) @ vectors[:, kept].T
        covariance[np.ix_(index, index)] = inverse / unit
    return covariance


def told_by(information: Array) -> Mask:
    """Return which of n parameters an information matrix (n, n) tells something of, alone."""
    diagonal = np.diag(information)
    seen = diagonal > 0.0
    told: Mask = np.zeros(len(diagonal), dtype=bool)
    index = np.flatnonzero(seen)
    if not len(index):
        return told
    scale = np.sqrt(diagonal[index])
    values, vectors = np.linalg.eigh(information[np.ix_(index, index)] / np.outer(scale, scale))
    null = vectors[:, values <= NOTHING_TOLD * values[-1]]
    told[index] = ~np.any(np.abs(null) > IN_NULL_SPACE, axis=1)
    return told


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


def without(covariance: Array, untold: Mask) -> Array:
    """Return a covariance in which some parameters (n,) are made unknown."""
    known = ~untold
    result = np.where(np.outer(known, known), covariance, 0.0)
    result[np.diag_indices_from(result)] = np.where(known, np.diag(covariance), np.inf)
    return result
