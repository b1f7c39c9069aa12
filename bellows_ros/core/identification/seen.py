"""The envelope of recordings: what a fit to them has seen of the cup."""

from collections.abc import Sequence
from dataclasses import replace

from bellows_ros.core.identification.advice.evidence import displacement
from bellows_ros.core.identification.envelope import Envelope
from bellows_ros.core.identification.judgement.whiteness import (
    interpolated,
    Spectrum,
    spectrum,
)
from bellows_ros.core.identification.regression.least_squares import Samples
from bellows_ros.core.identification.statics.standstills import Hold
from bellows_ros.core.model import Package
from bellows_ros.core.trajectory import uniform_rate_hz
from bellows_ros.errors import BellowsError
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

BAND = 0.95
"""Part of the deflection's power that the frequency bands hold."""


def envelope(recordings: Sequence[Samples], cup_length: float) -> Envelope:
    """
    Return the envelope of the recordings of a fit.

    Parameters
    ----------
    recordings : sequence of Samples
        As they went into the fit; samples that are not valid are left out.
    cup_length : float
        Nominal length l0, m.

    Raises
    ------
    BellowsError
        Without a recording, or without valid samples in one.

    """
    if not recordings:
        raise BellowsError('An envelope needs at least one recording.')
    seen = [_seen(samples, cup_length) for samples in recordings]
    low, high, rates, bands = (np.array(part) for part in zip(*seen, strict=True))
    masses = [samples.held.mass for samples in recordings]
    return Envelope(
        deflection_low=low.min(axis=0),
        deflection_high=high.max(axis=0),
        rates=rates.max(axis=0),
        frequencies=np.column_stack([bands[:, :, 0].min(axis=0), bands[:, :, 1].max(axis=0)]),
        mass=np.array([min(masses), max(masses)]),
    )


def with_rest(
    known: Envelope, holds: Sequence[tuple[Hold, Package]], cup_length: float
) -> Envelope:
    """Return an envelope with the deflections of standstills in it; rest has no rates."""
    nominal = np.array([0.0, 0.0, -cup_length, 0.0, 0.0, 0.0])
    deflections = np.array([hold.lip(held.com) - nominal for hold, held in holds])
    return replace(
        known,
        deflection_low=np.minimum(known.deflection_low, deflections.min(axis=0)),
        deflection_high=np.maximum(known.deflection_high, deflections.max(axis=0)),
    )


def _seen(samples: Samples, cup_length: float) -> tuple[Array, Array, Array, Array]:
    """Return least and largest deflections, largest rates (6,), and bands (2, 2)."""
    valid = samples.tool.valid & samples.package.valid
    if not valid.any():
        raise BellowsError('A recording without valid samples has no envelope.')
    deflection, twist = displacement(samples, cup_length)
    deflection[~valid] = np.nan
    rate_hz = uniform_rate_hz(samples.package.stamps_ns)
    rates = np.abs(twist, out=twist)[valid].max(axis=0)
    low, high = np.nanmin(deflection, axis=0), np.nanmax(deflection, axis=0)
    return low, high, rates, _bands(deflection, rate_hz)


def _bands(deflection: Array, rate_hz: float) -> Array:
    """Return the frequency bands (2, 2) of shift and rotation."""
    densities = spectrum(interpolated(deflection), rate_hz)
    both = np.column_stack([densities.density[:, i:i + 3].sum(axis=1) for i in (0, 3)])
    low, high = Spectrum(densities.frequency, both).band(BAND)
    return np.nan_to_num(np.column_stack([low, high]))
