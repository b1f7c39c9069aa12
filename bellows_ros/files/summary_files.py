"""
Sufficient statistics of recordings as files.

A file is a NumPy archive (.npz) without pickled objects: a JSON header with the names of fields,
and all numbers of a `core.identification.reduction.Reduced` as arrays.
"""

from collections.abc import Mapping
from dataclasses import dataclass, fields, is_dataclass
import io
import json
import os
from pathlib import Path
from types import UnionType
from typing import Any, get_args, get_origin, get_type_hints
import zipfile
import zlib

from bellows_ros.core.identification.reduction import Reduced
from bellows_ros.core.model.structure import Structure, structure_named
from bellows_ros.core.parameters.checks import resolve
from bellows_ros.errors import BellowsError
from bellows_ros.files import atomic
from bellows_ros.files.results import format_json
import numpy as np

FORMAT = 'bellows_ros summary 7'
LARGEST_HEADER = 64 * 2**20

LARGEST_RATIO = 30
"""Of unpacked to stored bytes, beyond 64 MiB; the numbers of a motion stay far below."""

LARGEST_NUMBER = 1e30
"""No recording gives a larger one; its square is still finite."""


@dataclass(frozen=True, eq=False)
class Summary:
    """
    The content of a file.

    Parameters
    ----------
    part : Reduced
        What a recording was reduced to.
    settings : mapping
        All parameters it was prepared with.
    assumed : tuple of str
        What was not given and taken from the thesis, in sentences.
    parameter_files : tuple of mapping
        Path and digests of files that the parameters are from.

    """

    part: Reduced
    settings: Mapping[str, Any]
    assumed: tuple[str, ...]
    parameter_files: tuple[Mapping[str, Any], ...]


def write_summary(path: str | os.PathLike[str], content: Summary) -> None:
    """Write a summary, whole or not at all; raise BellowsError if it cannot be written."""
    arrays: dict[str, Any] = {}
    header = {'format': FORMAT, 'content': _packed(content, 'content', arrays)}
    packed = io.BytesIO()
    np.savez_compressed(
        packed, header=np.frombuffer(format_json(header).encode(), np.uint8), **arrays)
    atomic.write_bytes(path, packed.getvalue())


def read_summary(path: str | os.PathLike[str]) -> Summary:
    """
    Read a summary.

    Raises
    ------
    BellowsError
        If the file cannot be read, or is none or damaged.

    """
    file = Path(path)
    try:
        content, arrays = _content(file)
        summary: Summary = _unpacked(Summary, content, arrays)
        resolve(summary.settings)
        _require_whole(summary.part)
        return summary
    except OSError as error:
        raise BellowsError(f"Summary '{file}' cannot be read: {error.strerror}.") from None
    except (ArithmeticError, BellowsError, EOFError, LookupError, RuntimeError, SyntaxError,
            TypeError, ValueError, zipfile.BadZipFile, zlib.error) as error:
        raise BellowsError(
            f"'{file}' is no summary that can be used: {str(error)[:300]}. Make it with "
            "'bellows identify BAG --params FILE --summary-out FILE'."
        ) from None


def _content(file: Path) -> tuple[Any, dict[str, Any]]:
    """Return header and arrays of a file, after checking the sizes that it states."""
    with zipfile.ZipFile(file) as archive:
        items = {item.filename.removesuffix('.npy'): item for item in archive.infolist()}
        size = sum(item.file_size for item in items.values())
        if (size > max(LARGEST_HEADER, LARGEST_RATIO * file.stat().st_size)
                or items['header'].file_size > LARGEST_HEADER):
            raise ValueError(f'it says that it holds {size} bytes, too many for its size')
        header = json.loads(_array(archive.read(items.pop('header'))).tobytes())
        if header['format'] != FORMAT:
            raise ValueError(f"its format is '{header['format']:.40}', not '{FORMAT}'")
        return header['content'], {
            name: _array(archive.read(item)) for name, item in items.items()}


def _array(data: bytes) -> Any:
    """Return the array of a .npy file, allocating no more than the file holds."""
    stream = io.BytesIO(data)
    if np.lib.format.read_magic(stream) != (1, 0):
        raise ValueError('an array has an unknown version')
    shape, fortran, dtype = np.lib.format.read_array_header_1_0(stream)
    numbers = np.frombuffer(data, dtype, offset=stream.tell())
    return numbers.reshape(shape, order='F' if fortran else 'C')


def _packed(value: Any, name: str, arrays: dict[str, Any]) -> Any:
    """Return a value as JSON, its numbers put into arrays under its name."""
    if isinstance(value, Structure):
        return value.name
    names = [own.name for own in fields(value) if own.init] if is_dataclass(value) else getattr(
        value, '_fields', None)
    if names is not None:
        return {own: _packed(getattr(value, own), f'{name}.{own}', arrays) for own in names}
    if isinstance(value, float | np.ndarray):
        arrays[name] = value
        return name
    return value


def _unpacked(kind: Any, value: Any, arrays: Mapping[str, Any]) -> Any:
    """Return a packed value of a type; raise TypeError for another type."""
    if isinstance(kind, UnionType):
        if value is None:
            return None
        kind = get_args(kind)[0]
    if kind is Structure:
        return structure_named(value)
    if is_dataclass(kind) or hasattr(kind, '_fields'):
        kinds = get_type_hints(kind)
        return kind(**{
            own: _unpacked(kinds[own], part, arrays) for own, part in _is(value, dict).items()})
    origin, inner = get_origin(kind), get_args(kind)
    if origin is np.ndarray:
        return _numbers(arrays[value], get_args(inner[1])[0])
    if kind is float:
        return float(_numbers(arrays[value], float).reshape(()))
    if origin is tuple:
        return tuple(_unpacked(inner[0], part, arrays) for part in _is(value, list))
    return _is(value, dict if origin is Mapping else kind)


def _numbers(array: Any, kind: type) -> Any:
    """Return an array of a type; raise TypeError if it is of another or of too large numbers."""
    if array.dtype != kind or (np.abs(array[np.isfinite(array)]) > LARGEST_NUMBER).any():
        raise TypeError('one of its arrays is damaged')
    return array


def _is(value: Any, kind: type) -> Any:
    """Return a value of a type, or raise TypeError."""
    if type(value) is not kind:
        raise TypeError(f'{str(value)[:40]} stands for {kind.__name__}')
    return value


def _require_whole(part: Reduced) -> None:
    """Raise ValueError if an array does not fit the structure."""
    sums, seen, world = part.statistics, part.movement, part.package_world
    size = 2 * sums.structure.size + 1
    moments = (sums.moments, seen.strain, seen.twist, seen.strain_noise, seen.twist_noise)
    wanted: list[tuple[Any, tuple[int, ...]]] = [
        (sums.r_factors, (len(sums.r_factors), 6, size, size)),
        (np.nan_to_num(seen.bands_hz), (2, 6)),
        *((own.mean, (6,)) for own in moments),
        *((own.scatter, (6, 6)) for own in moments),
    ]
    if seen.passed is not None:
        wanted += [(seen.passed.lost, (6,)), (seen.passed.least, (6,)),
                   (np.array(seen.passed.end_hz), ())]
    if world is not None:
        wanted += [(world.pose, (7,)), (world.std, (6,))]
    if sums.noise is not None:
        wanted.append((sums.noise, (6, size, 6, size)))
    if sums.lip is not None:
        count = len(sums.lip.index)
        wanted += [(sums.lip.position, (count, 3)), (sums.lip.rotation, (count, 3, 3)),
                   (sums.lip.twist, (count, 6)), (sums.lip.wrench, (count, 6)),
                   (sums.lip.stamps_ns, (count,)), (np.array(sums.lip.window), ())]
    if any(array.shape != shape or not np.isfinite(array).all() for array, shape in wanted):
        raise ValueError('one of its arrays is damaged')
    texts = (part.report['bag'], *_is(part.report['warnings'], list))
    if not all(isinstance(text, str) for text in texts) or not (
            sums.used > 0 and 0.0 < sums.cup_length < np.inf
            and (len(sums.r_factors) or sums.lip is not None and sums.lip.window > 0.0)):
        raise ValueError('its report is damaged')
