"""Where a result comes from: digests of the files that went into it, and versions of the tools."""

from collections.abc import Iterable, Mapping, Sequence
import hashlib
from importlib import metadata
import os
from pathlib import Path
import platform
from typing import Any

from bellows_ros import __version__
from bellows_ros.errors import BellowsError
from bellows_ros.files.bag_folder import listing

CHUNK = 2**20
TOOLS = ('numpy', 'scipy', 'numba', 'rosbags')


def digests(path: str | os.PathLike[str]) -> list[dict[str, Any]]:
    """
    Return name, size and SHA-256 of a file, or of every file in a folder, in order of names.

    Raises
    ------
    BellowsError
        If one cannot be read.

    """
    top = Path(path)
    try:
        files = sorted(p for p in top.iterdir() if p.is_file()) if top.is_dir() else [top]
        return [_digest(file) for file in files]
    except OSError as error:
        raise BellowsError(f"'{path}' cannot be read for its digest: {error.strerror}.") from None


def recording_digest(
    path: str | os.PathLike[str], files: Sequence[Mapping[str, Any]] = ()
) -> str:
    """
    Return the SHA-256 of a recording's messages as stored, the same wherever and however it lies.

    Its `digests` are taken again only where they are not given.

    Raises
    ------
    BellowsError
        If there is no such recording, or it cannot be read.

    """
    known = {file['name']: file['sha256'] for file in files or digests(path)}
    parts = [known[file.name] for file in listing(path).files]
    return hashlib.sha256(' '.join(parts).encode()).hexdigest()


def provenance(
    recordings: Iterable[str | os.PathLike[str]],
    parameter_files: Iterable[str | os.PathLike[str]] = (),
) -> dict[str, Any]:
    """
    Return all that a result depends on beside its settings, the same for the same files.

    Returns
    -------
    dict
        'recordings' and 'parameter_files': a list of path and files, each with name, bytes and
        sha256; 'versions' by name, None for what is not there.

    Raises
    ------
    BellowsError
        If a file cannot be read.

    """
    return {
        'recordings': [{'path': os.fspath(p), 'files': digests(p)} for p in recordings],
        'parameter_files': [{'path': os.fspath(p), 'files': digests(p)} for p in parameter_files],
        'versions': versions(),
    }


def versions() -> dict[str, str | None]:
    """Return the versions of this package, of Python, and of what numbers depend on."""
    found = {name: _version(name) for name in TOOLS}
    return {'bellows_ros': __version__, 'python': platform.python_version(), **found}


def _version(name: str) -> str | None:
    """Return the version of an installed distribution, or None."""
    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:
        return None


def _digest(file: Path) -> dict[str, Any]:
    """Return name, size and SHA-256 of a file."""
    total, size = hashlib.sha256(), 0
    with file.open('rb') as stream:
        while chunk := stream.read(CHUNK):
            total.update(chunk)
            size += len(chunk)
    return {'name': file.name, 'bytes': size, 'sha256': total.hexdigest()}
