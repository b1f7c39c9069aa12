"""
Summaries of recordings as files, so that any scheduler can make them anywhere.

A file is a NumPy archive (.npz) without pickled objects: a JSON header, and the arrays of
`core.identification.regression.summaries.Summary`.
"""

from collections.abc import Mapping
from dataclasses import dataclass
import io
import json
import os
from pathlib import Path
from typing import Any
import zipfile

from bellows_ros.core.identification.envelope import Envelope, known_envelope
from bellows_ros.core.identification.regression.moments import Moments
from bellows_ros.core.identification.regression.summaries import Summary
from bellows_ros.core.identification.structure import structure_named
from bellows_ros.errors import BellowsError
from bellows_ros.files import atomic
from bellows_ros.files.results import format_json
import numpy as np

FORMAT = 'bellows_ros summary 1'
LARGEST_FILE = 4 * 2**30
LARGEST_HEADER = 64 * 2**20

_ARRAYS = ('triangles', 'samples', 'starts', 'mean', 'scatter', 'header')


@dataclass(frozen=True, eq=False)
class SummaryFile:
    """
    A recording's summary and where it comes from.

    Parameters
    ----------
    summary : Summary
        What the fit needs.
    envelope : Envelope
        What the recording has seen of the cup.
    bag : str
        The recording.
    settings : mapping
        All parameters it was prepared with.
    report : mapping
        What became of the recording, as in the JSON file of a fit.

    """

    summary: Summary
    envelope: Envelope
    bag: str
    settings: Mapping[str, Any]
    report: Mapping[str, Any]


def write_summary(path: str | os.PathLike[str], content: SummaryFile) -> None:
    """Write a summary, whole or not at all; raise BellowsError if it cannot be written."""
    summary = content.summary
    header = {
        'format': FORMAT,
        'bag': content.bag,
        'envelope': content.envelope.parameters(),
        'settings': content.settings,
        'report': content.report,
        'structure': summary.structure.name,
        'cup_length': summary.cup_length,
        'used': summary.used,
        'rejected': summary.rejected,
        'count': summary.moments.count,
    }
    packed = io.BytesIO()
    np.savez_compressed(
        packed, triangles=summary.triangles, samples=summary.samples, starts=summary.starts,
        mean=summary.moments.mean, scatter=summary.moments.scatter,
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
        arrays = _arrays(file)
        header = json.loads(arrays['header'].tobytes())
        if header['format'] != FORMAT:
            raise ValueError(f"its format is '{header['format']:.40}', not '{FORMAT}'")
        known = known_envelope(header['envelope'])
        if known is None:
            raise ValueError('it has no envelope')
        return SummaryFile(
            _summary(header, arrays), known, header['bag'], header['settings'], header['report']
        )
    except OSError as error:
        raise BellowsError(f"Summary '{file}' cannot be read: {error.strerror}.") from None
    except (ValueError, KeyError, TypeError, EOFError, zipfile.BadZipFile) as error:
        raise BellowsError(
            f"'{file}' is no summary that can be used: {error}. Make it with "
            "'bellows summarize BAG --params FILE --out FILE'."
        ) from None


def _arrays(file: Path) -> dict[str, Any]:
    """Return the arrays of a file, after a look at how large they say they are."""
    with zipfile.ZipFile(file) as archive:
        sizes = {item.filename: item.file_size for item in archive.infolist()}
    if sum(sizes.values()) > LARGEST_FILE or sizes['header.npy'] > LARGEST_HEADER:
        raise ValueError(f'it is larger than {LARGEST_FILE} bytes')
    with np.load(file, allow_pickle=False) as archive:
        return {name: archive[name] for name in _ARRAYS}


def _summary(header: Mapping[str, Any], arrays: Mapping[str, Any]) -> Summary:
    """Return the summary that a file holds, or raise ValueError where its parts do not fit."""
    structure = structure_named(header['structure'])
    size, count = 2 * structure.size + 1, int(header['count'])
    shapes = {
        'triangles': (len(arrays['triangles']), 6, size, size),
        'samples': (len(arrays['samples']), 18),
        'starts': (len(arrays['starts']),),
        'mean': (6,),
        'scatter': (6, 6),
    }
    for name, shape in shapes.items():
        array = arrays[name]
        if array.shape != shape or not np.all(np.isfinite(array)):
            raise ValueError(f"its array '{name}' is damaged")
    starts, samples = arrays['starts'], arrays['samples']
    if len(starts) and (np.any(np.diff(starts) <= 0) or not 0 == starts[0] <= len(samples)):
        raise ValueError("its array 'starts' is damaged")
    return Summary(
        structure, float(header['cup_length']), int(header['used']), int(header['rejected']),
        Moments(count, arrays['mean'], arrays['scatter']),
        arrays['triangles'], samples, starts,
    )  # fmt: skip
