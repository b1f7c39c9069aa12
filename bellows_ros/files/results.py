"""
The result of a fit as a JSON file, with its provenance.

Numbers keep every digit. NaN and infinity, which JSON lacks, become null, which stands for an
undetermined number. All numbers are in SI units, as docs/formats.md says.
"""

from collections.abc import Iterable, Mapping
from contextlib import suppress
from dataclasses import fields, is_dataclass
import hashlib
from importlib import metadata
import json
import math
import os
from pathlib import Path
import platform
import re
from typing import Any

from bellows_ros.errors import BellowsError
from bellows_ros.files import atomic, File
from bellows_ros.version import __version__


def write_json(path: File, content: Any) -> None:
    """
    Write a result as JSON, whole or not at all.

    Parameters
    ----------
    path : path
        JSON file.
    content : mapping or result
        Content for `plain`.

    Raises
    ------
    BellowsError
        If the content cannot be represented in JSON, or the file cannot be written.

    """
    atomic.write_text(path, format_json(content))


def format_json(content: Any) -> str:
    """Return JSON text with one line per key and per row of a matrix."""
    text = json.dumps(plain(content), indent=2, default=os.fspath)
    return re.sub(r'\[\n[^][{}]*\n *\]', lambda row: re.sub(
        r'\n *', ' ', row[0]).replace('[ ', '[').replace(' ]', ']'), text) + '\n'


def plain(value: Any) -> Any:
    """
    Return a result as plain JSON types.

    A result becomes its `as_json()`, any other dataclass or named tuple its fields; NumPy becomes
    Python, NaN and infinity become None.
    """
    for name in ('as_json', '_asdict', 'tolist'):
        if hasattr(value, name):
            return plain(getattr(value, name)())
    if is_dataclass(value):
        return plain_items({field.name: getattr(value, field.name) for field in fields(value)})
    if isinstance(value, Mapping):
        return plain_items(value)
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def plain_items(content: Mapping[str, Any]) -> dict[str, Any]:
    """Return a mapping with its items as plain JSON types."""
    return {key: plain(item) for key, item in content.items()}


def attributes(result: object, *names: str) -> dict[str, Any]:
    """Return some attributes by name."""
    return {name: getattr(result, name) for name in names}


def digests(path: File) -> list[dict[str, Any]]:
    """
    Return name, size and SHA-256 of a file, or of every file in a folder, in order of names.

    Raises
    ------
    BellowsError
        If a file cannot be read.

    """
    top, found = Path(path), list[dict[str, Any]]()
    try:
        for file in sorted(filter(Path.is_file, top.iterdir())) if top.is_dir() else [top]:
            with file.open('rb') as stream:
                found.append({
                    'name': file.name, 'bytes': file.stat().st_size,
                    'sha256': hashlib.file_digest(stream, 'sha256').hexdigest()})
        return found
    except OSError as error:
        raise BellowsError(f"'{path}' cannot be read for its digest: {error.strerror}.") from None


def recording_digest(files: Iterable[Mapping[str, Any]]) -> str:
    """Return the SHA-256 of the stored messages of a recording with given `digests`."""
    parts = [file['sha256'] for file in files if file['name'] != 'metadata.yaml']
    return hashlib.sha256(' '.join(parts).encode()).hexdigest()


def provenance(recordings: Iterable[File], parameter_files: Iterable[File] = ()) -> dict[str, Any]:
    """
    Return the files and versions that a result depends on; equal files have equal digests.

    Returns
    -------
    dict
        'recordings' and 'parameter_files': a list of path and files, each with name, bytes and
        sha256; 'versions' by name, None for a missing library.

    Raises
    ------
    BellowsError
        If a file cannot be read.

    """
    return {'recordings': listed(recordings), 'parameter_files': listed(parameter_files),
            'versions': versions()}


def listed(paths: Iterable[File]) -> list[dict[str, Any]]:
    """Return paths with the digests of their files."""
    return [{'path': os.fspath(path), 'files': digests(path)} for path in paths]


def of_command(
    result: Any, parameter_files: Iterable[File], asked: Iterable[str]
) -> dict[str, Any]:
    """Return the JSON content of a result, with its files and the printed questions."""
    content = {**result} if isinstance(result, Mapping) else {
        **plain(result), 'version': __version__}
    if inputs := getattr(result, 'inputs', ()):
        content['provenance'] = provenance(inputs)
    if 'provenance' in content:
        content['provenance'] |= {'parameter_files': listed(parameter_files)}
    if 'warnings' in content:
        content['warnings'] = [*asked, *content['warnings']]
    return content


def versions() -> dict[str, str | None]:
    """Return the versions of this package, of Python, and of the numerical libraries."""
    installed: dict[str, str | None] = {
        'bellows_ros': __version__, 'python': platform.python_version()}
    for name in ('numpy', 'scipy', 'numba', 'rosbags'):
        installed[name] = None
        with suppress(metadata.PackageNotFoundError):
            installed[name] = metadata.version(name)
    return installed
