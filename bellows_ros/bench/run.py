"""All measurements, section by section, with what they were made on."""

from collections.abc import Callable, Mapping, Sequence
from datetime import datetime, UTC
import importlib.metadata
import os
from pathlib import Path
import platform
from typing import Any

from bellows_ros import __version__
from bellows_ros.errors import BellowsError

from . import batch, live, offline, startup, step

SECTIONS: Mapping[str, Callable[[bool], dict[str, Any]]] = {
    'step': step.run,
    'node': live.run,
    'offline': offline.run,
    'startup': startup.run,
    'batch': batch.run,
}
PACKAGES = ('numpy', 'scipy', 'numba', 'rosbags', 'mujoco', 'drake', 'joblib')


def run(
    only: Sequence[str] = (),
    short: bool = False,
    progress: Callable[[str, float], None] | None = None,
) -> dict[str, Any]:
    """
    Measure.

    Parameters
    ----------
    only : sequence of str
        Names of `SECTIONS`; all where empty.
    short : bool
        Whether to only see that everything works; the figures then mean little.
    progress : callable, optional
        Called with what is being done and the part (0 to 1) that is done.

    Raises
    ------
    BellowsError
        If there is no such section, or a measurement fails.

    """
    unknown = set(only) - set(SECTIONS)
    if unknown:
        raise BellowsError(
            f"There is no section '{min(unknown)}'. There are: {', '.join(SECTIONS)}."
        )
    names = [name for name in SECTIONS if not only or name in only]
    found: dict[str, Any] = {'machine': machine(), 'short': short}
    for number, name in enumerate(names):
        if progress:
            progress(f'measuring {name}', number / len(names))
        found[name] = SECTIONS[name](short)
    return found


def machine() -> dict[str, Any]:
    """Return what the figures were measured on and with."""
    versions = {}
    for name in PACKAGES:
        try:
            versions[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            versions[name] = 'not installed'
    return {
        'processor': _processor(),
        'cores': os.cpu_count(),
        'load': os.getloadavg()[0],
        'system': f'{platform.system()} {platform.machine()}',
        'python': platform.python_version(),
        'bellows_ros': __version__,
        'versions': versions,
        'date': datetime.now(UTC).date().isoformat(),
    }


def _processor() -> str:
    """Return the processor's name."""
    try:
        lines = Path('/proc/cpuinfo').read_text().splitlines()
    except OSError:
        return platform.processor()
    names = [line.partition(':')[2].strip() for line in lines if line.startswith('model name')]
    return names[0] if names else platform.processor()
