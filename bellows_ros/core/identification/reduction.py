"""
The sufficient statistics of a recording for least squares, and its motion for findings.

The weight W of (4.66) depends on the wrenches of all recordings, and is unknown when one recording
is reduced; stored statistics can be weighted later. For a fit the sufficient statistics are, by
cluster, the rows [L c] of each wrench component, reduced by QR to an R factor with equal inner
products. If W couples the components, six R factors do not suffice, and R factors of all products
would be larger than the samples, which are stored instead. Also stored are the mean contribution
of noise to the products, estimated by adding noise once more; and the motion of the lip, hence the
validity range of the fit. All statistics are additive over recordings.
"""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

from bellows_ros.core.geometry.arrays import Array
from bellows_ros.core.identification import samples as sampling
from bellows_ros.core.identification.samples import Equations, LipMotion, Moments, Samples
from bellows_ros.core.model.cup_package import Package
from bellows_ros.core.model.structure import Structure
from bellows_ros.core.model.validity_range import Envelope
from bellows_ros.core.recording import recording as measured
from bellows_ros.core.recording.recording import FilterNoise, NOISE_SAMPLES, Recording
from bellows_ros.core.signals.residuals import Spectrum
from bellows_ros.errors import BellowsError
import numpy as np
from scipy.linalg import block_diag

ENVELOPE_BAND = 0.95
"""Fraction of the deflection's power inside the frequency bands."""

BAND = 0.9
"""Fraction of a velocity's power inside its frequency band."""


def noise_products(
    recording: Samples, noise: FilterNoise, cup_length: float, structure: Structure,
    seed: int = sampling.NOISE_SEED,
) -> Array:
    """
    Return the expected contribution of noise to the products of [L c] (6, q, 6, q), q = p + 1.

    They are sums over all valid samples, for each two components of the wrench, by adding noise of
    equal distribution once more. Contributions of several recordings can be added.
    """
    size = 2 * structure.size + 1
    products = np.zeros((6 * size, 6 * size))
    draw = np.random.default_rng(seed)
    thinned = recording.thinned(NOISE_SAMPLES)
    rows = thinned.lip.equations(cup_length, structure)
    for block, (clean, _) in zip(thinned.blocks(), rows, strict=False):
        noisy, _ = next(sampling.with_noise(block, noise, draw).lip.equations(
            cup_length, structure))
        added = (noisy - clean).reshape(-1, 6 * size)
        products += added.T @ added
    part = max(thinned.count, 1) / max(recording.count, 1)
    return products.reshape(6, size, 6, size) / part


class Statistics(NamedTuple):
    """
    Sufficient statistics of one recording for any weight.

    Parameters
    ----------
    structure : Structure
        Structure of K and P.
    cup_length : float
        Cup length l0, m.
    used, rejected : int
        Numbers of valid and of invalid samples.
    moments : Moments
        Moments of the required wrenches.
    r_factors : ndarray (C, 6, q, q)
        R factor of the rows [L c] for each of C clusters and each component, q = p + 1; empty if
        the structure couples the components.
    lip : LipMotion or None
        Motion of the lip, if the structure couples the components.
    noise : ndarray (6, q, 6, q) or None
        Bias of the products of the rows by noise (see `noise_products`), None without given noise.

    """

    structure: Structure
    cup_length: float
    used: int
    rejected: int
    moments: Moments
    r_factors: Array
    lip: LipMotion | None
    noise: Array | None

    def head(self) -> 'Statistics':
        """Return the statistics without rows."""
        return self._replace(r_factors=self.r_factors[:0], lip=None)

    def of(self, structure: Structure) -> 'Statistics':
        """Return the statistics in a simpler structure; otherwise unchanged."""
        if structure == self.structure or not self.structure.contains(structure):
            return self
        T = block_diag(structure.within(self.structure), np.eye(1))
        noise = None if self.noise is None else np.einsum(
            'ipjq,pa,qb->iajb', self.noise, T, T, optimize=True)
        return self._replace(structure=structure, r_factors=self.r_factors @ T, noise=noise)

    def rows(self) -> Iterator[Equations]:
        """Yield rows [L c], or rows with equal inner products, cluster by cluster."""
        if self.lip is not None:
            yield from self.lip.equations(self.cup_length, self.structure)
        elif len(self.r_factors):
            count, _, size, columns = self.r_factors.shape
            rows = self.r_factors.transpose(0, 2, 1, 3).reshape(count * size, 6, columns)
            clusters = [slice(k * size, (k + 1) * size) for k in range(count)]
            yield rows, clusters


def statistics(
    samples: Samples, cup_length: float, structure: Structure, noise: FilterNoise | None = None
) -> Statistics:
    """
    Return the sufficient statistics of a recording, possibly without valid samples.

    Parameters
    ----------
    samples : Samples
        Samples of the recording.
    cup_length : float
        Cup length l0, m.
    structure : Structure
        Structure of K and P: their free entries.
    noise : FilterNoise, optional
        Noise of the recording; without noise its bias is not estimated.

    """
    size = 2 * structure.size + 1
    r_factors = [np.empty((0, 6, size, size))]
    if not structure.couples:
        for rows, clusters in samples.lip.equations(cup_length, structure):
            for part in clusters:
                few = np.zeros((max(size - len(rows[part]), 0), 6, size))
                of_components = np.concatenate([rows[part], few]).swapaxes(0, 1)
                r_factors.append(np.asarray(np.linalg.qr(of_components, mode='r'))[None])
    return Statistics(
        structure, cup_length, samples.count, len(samples.tool) - samples.count,
        Moments.of(samples.lip.wrench), np.concatenate(r_factors),
        samples.lip if structure.couples else None,
        None if noise is None else noise_products(samples, noise, cup_length, structure))


def envelope(samples: Samples, cup_length: float) -> Envelope:
    """
    Return the validity range of a recording.

    Parameters
    ----------
    samples : Samples
        Samples of the fit; invalid samples are omitted.
    cup_length : float
        Cup length l0, m.

    Raises
    ------
    BellowsError
        Without valid samples.

    """
    if not samples.count:
        raise BellowsError('The recording has no valid samples, hence no validity range.')
    deflection, mass = samples.lip.displacement(cup_length), samples.payload.mass
    strain = samples.spectrum_of(deflection)
    shift_and_rotation = np.column_stack([strain.density[:, i:i + 3].sum(axis=1) for i in (0, 3)])
    bands = np.column_stack(Spectrum(strain.frequency, shift_and_rotation).band(ENVELOPE_BAND))
    return Envelope(
        deflection.min(axis=0), deflection.max(axis=0), np.abs(samples.lip.twist).max(axis=0),
        np.nan_to_num(bands), np.array([mass, mass]))


class Movement(NamedTuple):
    """
    Motion of the lip in the tool frame during one recording.

    Parameters
    ----------
    strain, twist : Moments
        Moments of the lip's displacement from nominal (m, rad) and of its twist (m/s, rad/s).
    strain_noise, twist_noise : Moments
        Moments of the noise in strain and twist.
    bands_hz : ndarray (2, 6)
        Frequency bands with most of the twist's power; nan without motion.

    """

    strain: Moments
    twist: Moments
    strain_noise: Moments
    twist_noise: Moments
    bands_hz: Array


def movement_of(samples: Samples, cup_length: float, noise: FilterNoise) -> Movement:
    """
    Return the motion of the lip in a recording.

    Parameters
    ----------
    samples : Samples
        Samples of the recording.
    cup_length : float
        Cup length l0, m.
    noise : FilterNoise
        Noise of the recording.

    Raises
    ------
    BellowsError
        Without valid samples.

    """
    thinned = samples.thinned(NOISE_SAMPLES)
    noisy = sampling.with_noise(thinned, noise, np.random.default_rng(sampling.NOISE_SEED)).lip
    motion, moved = (np.array([lip.displacement(cup_length), lip.twist])
                     for lip in (thinned.lip, noisy))
    added = moved - motion
    return Movement(
        Moments.of(motion[0]), Moments.of(motion[1]), Moments.of(added[0]), Moments.of(added[1]),
        np.array(samples.twist_spectrum.band(BAND)))


class ReducedRecording(NamedTuple):
    """
    Facts on a recording, without its rows and poses.

    Parameters
    ----------
    report : mapping
        Report on the recording, as in the JSON file of a fit.
    digest : str
        Digest of its stored messages.
    files : tuple of mapping
        Name, bytes and sha256 of each of its files.
    payload : Package
        The package in it.
    time_offset : TimeOffset or None
        Offset subtracted from the tool's stamps, None if not requested or not identifiable.
    package_world : PackageWorld or None
        Transform between two worlds, if estimated.
    rate_hz : float
        Rate of the package's poses.
    cup_length : float
        Cup length l0 of motion and validity range, m.
    movement : Movement
        Motion of the lip.
    envelope : Envelope
        Its validity range.
    facts : tuple of Finding
        Faults that are seen without a fit.

    """

    report: Mapping[str, Any]
    digest: str
    files: tuple[Mapping[str, Any], ...]
    payload: Package
    time_offset: measured.TimeOffset | None
    package_world: measured.PackageWorld | None
    rate_hz: float
    cup_length: float
    movement: Movement
    envelope: Envelope
    facts: tuple[Any, ...] = ()

    @property
    def name(self) -> str:
        """Name of the recording as the user gave it."""
        return str(self.report['bag'])


AnyRecording = Recording | ReducedRecording


def whole_recordings(recordings: Sequence[AnyRecording]) -> list[Recording]:
    """Return the recordings that are not reduced."""
    return [recording for recording in recordings if isinstance(recording, Recording)]


def reduced(recording: AnyRecording, cup_length: float) -> ReducedRecording:
    """
    Return a recording reduced, if it is not.

    Raises
    ------
    BellowsError
        If it has no valid samples, or the package is not below the tool.

    """
    if isinstance(recording, ReducedRecording):
        return recording
    whole = recording
    return whole.cached(('reduced', cup_length), lambda: _reduced(whole, cup_length))


def statistics_of(
    recording: Recording, cup_length: float, structure: Structure, with_noise: bool
) -> Statistics:
    """Return the statistics of a recording, if requested with the bias by its noise."""
    samples, key = sampling.samples_of(recording), (cup_length, structure)
    plain = recording.cached(('statistics', *key), lambda: statistics(samples, *key))
    return plain._replace(noise=recording.cached(('noise', *key), lambda: noise_products(
        samples, recording.noise, *key))) if with_noise else plain


def envelope_of(recording: Recording, cup_length: float) -> Envelope:
    """Return the validity range of a recording."""
    return recording.cached(('envelope', cup_length), lambda: envelope(
        sampling.samples_of(recording), cup_length))


def _reduced(recording: Recording, length: float) -> ReducedRecording:
    """Return a recording reduced."""
    samples = sampling.samples_of(recording)
    seen = recording.cached(  # raises without valid samples
        ('envelope', length), lambda: envelope(samples, length))
    return ReducedRecording(
        recording.as_json(), recording.digest, recording.files, recording.payload,
        recording.report.time_offset, recording.report.package_world,
        recording.report.package.timing.rate_hz, length,
        movement_of(samples, length, recording.noise), seen)
