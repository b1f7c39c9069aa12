"""Results of a recording that are kept without its poses: motion and validity range."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from bellows_ros.core.identification import samples as sampling
from bellows_ros.core.identification.samples import Samples
from bellows_ros.core.model.cup_package import Package
from bellows_ros.core.model.validity_range import Envelope
from bellows_ros.core.recording import recording as measured
from bellows_ros.core.recording.alignment import Remark
from bellows_ros.core.recording.recording import Recording
from bellows_ros.core.signals.residuals import Spectrum
from bellows_ros.errors import BellowsError
import numpy as np

ENVELOPE_BAND = 0.95
"""Fraction of the deflection's power inside the frequency bands."""


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
        If there are no valid samples.

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
        Cup length l0 of the validity range, m.
    envelope : Envelope
        Its validity range.
    remarks : tuple of Remark
        Findings of the preparation and of the checks.

    """

    report: Mapping[str, Any]
    digest: str
    files: tuple[Mapping[str, Any], ...]
    payload: Package
    time_offset: measured.TimeOffset | None
    package_world: measured.PackageWorld | None
    rate_hz: float
    cup_length: float
    envelope: Envelope
    remarks: tuple[Remark, ...] = ()

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
        If the recording has no valid samples, or the package is not below the tool.

    """
    if isinstance(recording, ReducedRecording):
        return recording
    whole = recording
    return whole.cached(('reduced', cup_length), lambda: _reduced(whole, cup_length))


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
        seen, recording.report.remarks)
