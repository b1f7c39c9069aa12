"""A recording reduced to what fits and findings need of it, small enough for a file."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from bellows_ros.core.envelope import Envelope
from bellows_ros.core.identification.advice.information import Information, information_of
from bellows_ros.core.identification.equations.samples import filtered_samples, samples_of
from bellows_ros.core.identification.equations.validity_range import (
    envelope,
    relative_spectra,
    Spectra,
)
from bellows_ros.core.identification.regression.sufficient import Statistics, statistics
from bellows_ros.core.model import Package
from bellows_ros.core.recording.package_world import PackageWorld
from bellows_ros.core.recording.recording import Recording, TimeOffset
from bellows_ros.core.structure import Structure, structure_named


@dataclass(frozen=True, eq=False)
class Reduced:
    """
    What remains of a recording where only sums over recordings are wanted.

    Parameters
    ----------
    report : mapping
        What became of the recording, as in the JSON file of a fit.
    digest : str
        Of its messages as stored.
    files : tuple of mapping
        Name, bytes and sha256 of each of its files.
    payload : Package
        The package in it.
    time_offset : TimeOffset or None
        What was taken from the tool's stamps, where that was wanted and could be found.
    package_world : PackageWorld or None
        The transform between two worlds, where it was to be found.
    statistics : Statistics
        What least squares needs.
    information : Information
        What is identifiable.
    envelope : Envelope
        Its validity range.

    """

    report: Mapping[str, Any]
    digest: str
    files: tuple[Mapping[str, Any], ...]
    payload: Package
    time_offset: TimeOffset | None
    package_world: PackageWorld | None
    statistics: Statistics
    information: Information
    envelope: Envelope

    @property
    def name(self) -> str:
        """What the user calls the recording."""
        return str(self.report['bag'])


def reduced(recording: Recording, values: Mapping[str, Any]) -> Reduced:
    """
    Return a recording reduced with the structure and the cup length that parameters name.

    Raises
    ------
    BellowsError
        If it has no valid samples, or the package is not below the tool.

    """
    length, structure = values['cup.length'], structure_named(values['fit.structure'])
    with_bias = values['fit.method'] == 'least_squares'
    return recording.once(
        ('reduced', length, structure.name, with_bias),
        lambda: _reduced(recording, length, structure, with_bias))


def spectra_of(recording: Recording, cup_length: float) -> Spectra:
    """Return the spectra of a recording's relative motion."""
    return recording.once(
        ('spectra', cup_length), lambda: relative_spectra(samples_of(recording), cup_length))


def envelope_of(recording: Recording, cup_length: float) -> Envelope:
    """Return the validity range of a recording."""
    filtered = filtered_samples(recording)
    spectra = None if recording.settings.relative else spectra_of(recording, cup_length)
    return recording.once(
        ('envelope', cup_length), lambda: envelope(filtered, cup_length, spectra))


def _reduced(
    recording: Recording, length: float, structure: Structure, with_bias: bool
) -> Reduced:
    """Return a recording reduced."""
    samples, noise = samples_of(recording), recording.noise
    seen = envelope_of(recording, length)
    return Reduced(
        recording.as_json(), recording.digest, recording.files, recording.payload,
        recording.report.time_offset, recording.report.package_world,
        statistics(samples, length, structure, noise if with_bias else None),
        information_of(samples, length, structure, noise, spectra_of(recording, length)), seen,
    )
