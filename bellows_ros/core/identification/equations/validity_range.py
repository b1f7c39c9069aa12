"""The validity range of recordings: what a fit to them has seen of the cup, as an `Envelope`."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

from bellows_ros.core.arrays import Array
from bellows_ros.core.envelope import Envelope
from bellows_ros.core.identification.equations.samples import Samples
from bellows_ros.core.recording.standstills import Standstill
from bellows_ros.core.spectra import interpolated, Spectrum, spectrum
from bellows_ros.core.trajectory import uniform_rate_hz
from bellows_ros.errors import BellowsError
import numpy as np

BAND = 0.95
"""Part of the deflection's power that the frequency bands hold."""


@dataclass(frozen=True, eq=False)
class Spectra:
    """
    Spectra of one recording's relative motion, six channels each.

    Parameters
    ----------
    strain, twist : Spectrum
        Of the lip's displacement from nominal (m, rad) and of its twist (m/s, rad/s), in the tool.

    """

    strain: Spectrum
    twist: Spectrum


def relative_spectra(samples: Samples, cup_length: float) -> Spectra:
    """
    Return the spectra of a recording's relative motion.

    Raises
    ------
    BellowsError
        Without valid samples.

    """
    rate_hz = uniform_rate_hz(samples.package.stamps_ns)
    found = []
    for values in (samples.lip.displacement(cup_length), samples.lip.twist):
        every = np.full((len(samples.tool), 6), np.nan)
        every[samples.lip.index] = values
        found.append(spectrum(interpolated(every), rate_hz))
    return Spectra(*found)


def envelope(samples: Samples, cup_length: float, spectra: Spectra | None = None) -> Envelope:
    """
    Return the validity range of a recording.

    Parameters
    ----------
    samples : Samples
        As they go into the fit; samples that are not valid are left out.
    cup_length : float
        Nominal length l0, m.
    spectra : Spectra, optional
        Those of `relative_spectra`, where they are known already.

    Raises
    ------
    BellowsError
        Without valid samples.

    """
    if not samples.count:
        raise BellowsError('A recording without valid samples has no validity range.')
    strain = (spectra or relative_spectra(samples, cup_length)).strain
    deflection, mass = samples.lip.displacement(cup_length), samples.payload.mass
    return Envelope(
        deflection.min(axis=0), deflection.max(axis=0), np.abs(samples.lip.twist).max(axis=0),
        _bands(strain), np.array([mass, mass]))


def _bands(densities: Spectrum) -> Array:
    """Return the frequency bands (2, 2) of shift and rotation."""
    both = np.column_stack([densities.density[:, i:i + 3].sum(axis=1) for i in (0, 3)])
    low, high = Spectrum(densities.frequency, both).band(BAND)
    return np.nan_to_num(np.column_stack([low, high]))


def with_standstills(
    known: Envelope, standstills: Sequence[Standstill], cup_length: float
) -> Envelope:
    """Return a validity range with the deflections of standstills in it; these have no rates."""
    nominal = np.array([0.0, 0.0, -cup_length, 0.0, 0.0, 0.0])
    deflections = np.array([still.lip - nominal for still in standstills])
    return replace(
        known,
        deflection_low=np.minimum(known.deflection_low, deflections.min(axis=0)),
        deflection_high=np.maximum(known.deflection_high, deflections.max(axis=0)),
    )
