"""The section on provenance: files, versions and settings."""

from collections.abc import Mapping
from typing import Any

from bellows_ros.core.identification.reduction import SEED as EXCITATION_SEED
from bellows_ros.core.identification.validation import SEED

from .page import folded, table


def origin_content(provenance: Mapping[str, Any], settings: Mapping[str, Any]) -> list[str]:
    """Return tables of digests, versions and settings."""
    files = [
        (kind, entry['path'], file['name'], str(file['bytes']), file['sha256'])
        for kind, key in (('recording', 'recordings'), ('parameters', 'parameter_files'))
        for entry in provenance.get(key, ())
        for file in entry['files']
    ]
    versions = [(name, version or 'not there') for name, version in provenance['versions'].items()]
    seeds = f'{SEED} (validation), {EXCITATION_SEED} (excitation)'
    versions.append(('seeds of made-up noise', seeds))
    rows = [(name, _shown(value)) for name, value in settings.items()]
    return [
        table(('', 'path', 'file', 'bytes', 'SHA-256'), files, (0, 1, 2, 4)),
        table(('', 'version or seed'), versions, (0, 1)),
        folded('All settings', table(('parameter', 'value'), rows, (0, 1))),
    ]


def _shown(value: Any) -> str:
    """Return a setting; of a matrix its rows."""
    if isinstance(value, list | tuple):
        return '[' + ', '.join(_shown(item) for item in value) + ']'
    if isinstance(value, float):
        return f'{value:.8g}'
    return str(value).lower() if isinstance(value, bool) else str(value) or "''"
