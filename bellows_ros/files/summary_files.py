"""
Summaries of recordings as files, so that any scheduler can make them anywhere.

A file is a NumPy archive (.npz) without pickled objects: a JSON header, and the arrays of
`core.identification.regression.summaries.Summary` and
`core.identification.advice.evidence.Evidence`.
"""

from collections.abc import Mapping
from dataclasses import asdict, dataclass
import io
import json
import os
from pathlib import Path
from typing import Any
import zipfile

from bellows_ros.core.identification.advice.evidence import DRAWS, Evidence
from bellows_ros.core.identification.advice.package_check import (
    CentreOfMass,
    Checked,
    CupLength,
)
from bellows_ros.core.identification.envelope import Envelope, known_envelope
from bellows_ros.core.identification.regression.moments import Moments
from bellows_ros.core.identification.regression.summaries import couples, Summary
from bellows_ros.core.identification.structure import Structure, structure_named
from bellows_ros.errors import BellowsError
from bellows_ros.files import atomic
from bellows_ros.files.results import format_json
import numpy as np

FORMAT = 'bellows_ros summary 2'
LARGEST_FILE = 4 * 2**30
LARGEST_HEADER = 64 * 2**20

_MOMENTS = ('wrench', 'strain', 'twist', 'strain_noise', 'twist_noise')
_ARRAYS = (
    'triangles', 'samples', 'starts', 'noise', 'rows', 'added', 'bands_hz', 'means', 'scatters')


@dataclass(frozen=True, eq=False)
class SummaryFile:
    """
    A recording's summary and where it comes from.

    Parameters
    ----------
    summary : Summary
        What the fit needs.
    evidence : Evidence
        What the recording tells.
    envelope : Envelope
        What it has seen of the cup.
    checked : Checked
        What it says of the cup's length and of the centre of mass.
    bag : str
        The recording.
    digest : str
        Of its messages as stored.
    settings : mapping
        All parameters it was prepared with.
    report : mapping
        What became of the recording, as in the JSON file of a fit.

    """

    summary: Summary
    evidence: Evidence
    envelope: Envelope
    checked: Checked
    bag: str
    digest: str
    settings: Mapping[str, Any]
    report: Mapping[str, Any]


def write_summary(path: str | os.PathLike[str], content: SummaryFile) -> None:
    """Write a summary, whole or not at all; raise BellowsError if it cannot be written."""
    summary, evidence = content.summary, content.evidence
    moments = [summary.moments, *(getattr(evidence, kind) for kind in _MOMENTS)]
    header = {
        'format': FORMAT,
        'bag': content.bag,
        'digest': content.digest,
        'envelope': content.envelope.parameters(),
        'settings': content.settings,
        'report': content.report,
        'structure': summary.structure.name,
        'cup_length': summary.cup_length,
        'used': summary.used,
        'rejected': summary.rejected,
        'counts': [part.count for part in moments],
        'centre': content.checked.centre and asdict(content.checked.centre),
        'length': content.checked.length and asdict(content.checked.length),
    }
    packed = io.BytesIO()
    np.savez_compressed(
        packed, triangles=summary.triangles, samples=summary.samples, starts=summary.starts,
        noise=summary.noise, rows=evidence.rows, added=evidence.added, bands_hz=evidence.bands_hz,
        means=[part.mean for part in moments], scatters=[part.scatter for part in moments],
        header=np.frombuffer(format_json(header).encode(), np.uint8),
    )  # fmt: skip
    atomic.write_bytes(path, packed.getvalue())


def read_summary(path: str | os.PathLike[str]) -> SummaryFile:
    """
    Read a summary.

    Raises
    ------
    BellowsError
        If the file cannot be read, or is none or damaged.

    """
    file = Path(path)
    try:
        header, arrays = _content(file)
        known = known_envelope(header['envelope'])
        if known is None:
            raise ValueError('it has no envelope')
        summary, evidence = _parts(header, arrays)
        return SummaryFile(
            summary, evidence, known,
            Checked(_length(header['length']), _centre(header['centre'])), header['bag'],
            header['digest'], header['settings'], header['report'],
        )  # fmt: skip
    except OSError as error:
        raise BellowsError(f"Summary '{file}' cannot be read: {error.strerror}.") from None
    except (ValueError, KeyError, TypeError, EOFError, zipfile.BadZipFile) as error:
        raise BellowsError(
            f"'{file}' is no summary that can be used: {error}. Make it with "
            "'bellows summarize BAG --params FILE --out FILE'."
        ) from None


def _content(file: Path) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return header and arrays of a file, after a look at how large they say they are."""
    with zipfile.ZipFile(file) as archive:
        sizes = {item.filename: item.file_size for item in archive.infolist()}
    if sum(sizes.values()) > LARGEST_FILE or sizes['header.npy'] > LARGEST_HEADER:
        raise ValueError(f'it is larger than {LARGEST_FILE} bytes')
    with np.load(file, allow_pickle=False) as archive:
        header = json.loads(archive['header'].tobytes())
        if header['format'] != FORMAT:
            raise ValueError(f"its format is '{header['format']:.40}', not '{FORMAT}'")
        return header, {name: archive[name] for name in _ARRAYS}


def _parts(header: Mapping[str, Any], arrays: Mapping[str, Any]) -> tuple[Summary, Evidence]:
    """Return what a file holds, or raise ValueError where its parts do not fit."""
    structure = structure_named(header['structure'])
    _require_whole(arrays, structure)
    moments = [
        Moments(int(count), mean, scatter) for count, mean, scatter in zip(
            header['counts'], arrays['means'], arrays['scatters'], strict=True)
    ]  # fmt: skip
    summary = Summary(
        structure, float(header['cup_length']), int(header['used']), int(header['rejected']),
        moments[0], arrays['triangles'], arrays['samples'], arrays['starts'], arrays['noise'],
    )  # fmt: skip
    evidence = Evidence(
        **dict(zip(_MOMENTS, moments[1:], strict=True)),
        bands_hz=arrays['bands_hz'], rows=arrays['rows'], added=arrays['added'],
    )  # fmt: skip
    return summary, evidence


def _require_whole(arrays: Mapping[str, Any], structure: Structure) -> None:
    """Raise ValueError where an array is not as the structure wants it."""
    size, kinds = 2 * structure.size + 1, 1 + len(_MOMENTS)
    few = (6 if couples(structure) else 1) * size
    shapes = {
        'triangles': (len(arrays['triangles']), 6, size, size),
        'samples': (len(arrays['samples']), 18),
        'starts': (len(arrays['starts']),),
        'rows': (1 + DRAWS, few, 6, size),
        'added': (size - 1, 6, 6),
        'bands_hz': (2, 6),
        'means': (kinds, 6),
        'scatters': (kinds, 6, 6),
        'noise': (6, size, 6, size),
    }
    for name, shape in shapes.items():
        array = arrays[name]
        unknown = name == 'bands_hz' and np.isnan(array)
        if array.shape != shape or not np.all(np.isfinite(array) | unknown):
            raise ValueError(f"its array '{name}' is damaged")
    starts, samples = arrays['starts'], arrays['samples']
    if len(starts) and (np.any(np.diff(starts) <= 0) or not 0 == starts[0] <= len(samples)):
        raise ValueError("its array 'starts' is damaged")


def _centre(values: Mapping[str, Any] | None) -> CentreOfMass | None:
    """Return where a recording wants the centre of mass; what is null there is infinite."""
    if values is None:
        return None
    shift, error, noise = (
        np.array([_finite_or_not(value) for value in values[name]])
        for name in ('shift', 'shift_std', 'noise_shift')
    )
    return CentreOfMass(shift, error, noise, float(values['residual']))


def _length(values: Mapping[str, Any] | None) -> CupLength | None:
    """Return by how much a recording wants the cup longer; what is null there is infinite."""
    if values is None:
        return None
    return CupLength(**{name: _finite_or_not(value) for name, value in values.items()})


def _finite_or_not(value: float | None) -> float:
    """Return a number; what is null stands for infinity."""
    return np.inf if value is None else float(value)
