"""
Measure the speed of this package.

    python -m benchmarks                # everything, some twenty minutes on an idle machine
    python -m benchmarks --only step    # one section
"""

import argparse
from collections.abc import Callable, Mapping, Sequence
from datetime import datetime, UTC
import os
from pathlib import Path
import platform
import re
import sys
from typing import Any

from bellows_ros.files.results import versions

from . import camera, live, offline, plans, startup, step
from .tables import markdown, tables

SECTIONS: Mapping[str, Callable[[bool], dict[str, Any]]] = {
    'step': step.run, 'node': live.run, 'offline': offline.run, 'startup': startup.run,
    'plans': plans.run, 'camera': camera.run}


def measured(sections: Sequence[str], short: bool = False) -> dict[str, Any]:
    """Return the figures of sections and of the machine; short sections are only a smoke test."""
    results: dict[str, Any] = {'machine': machine()}
    for name in sections:
        print(f'measuring {name}', file=sys.stderr, flush=True)
        results[name] = SECTIONS[name](short)
    return results


def machine() -> dict[str, Any]:
    """Return processor, system and versions of the measurement."""
    installed = versions()
    name = re.search(r'^model name\s*: (.*)$', Path('/proc/cpuinfo').read_text(), re.MULTILINE)
    return {
        'processor': name[1] if name else platform.processor(), 'cores': os.cpu_count(),
        'load': os.getloadavg()[0], 'system': f'{platform.system()} {platform.machine()}',
        'python': installed.pop('python'), 'bellows_ros': installed.pop('bellows_ros'),
        'versions': installed, 'date': datetime.now(UTC).date().isoformat()}


def main() -> None:
    """Measure, print, write."""
    parser = argparse.ArgumentParser(
        prog='python -m benchmarks', description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('--only', choices=SECTIONS, metavar='SECTION', help=', '.join(SECTIONS))
    arguments = parser.parse_args()
    results = measured([arguments.only] if arguments.only else list(SECTIONS))
    for table in tables(results).values():
        print(markdown(table), end='\n\n')


if __name__ == '__main__':
    main()
