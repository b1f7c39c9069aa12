"""
Measure the speed of this package, and write it into docs/performance.md.

    python -m benchmarks                # everything, some twenty minutes on an idle machine
    python -m benchmarks --only step    # print one section and write nothing
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

from bellows_ros.files.atomic import write_text
from bellows_ros.files.results import versions

from . import camera, live, offline, plans, startup, step
from .tables import markdown, tables

DOCS = Path(__file__).resolve().parents[1] / 'docs'
SECTIONS: Mapping[str, Callable[[bool], dict[str, Any]]] = {
    'step': step.run, 'node': live.run, 'offline': offline.run, 'startup': startup.run,
    'plans': plans.run, 'camera': camera.run}
_MARKED = re.compile(r'(<!-- bench: (\S+) -->\n).*?(<!-- end -->)', re.DOTALL)


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


def renewed(page: str, results: Mapping[str, Any]) -> str:
    """Return a page with new tables between `<!-- bench: NAME -->` and `<!-- end -->`."""
    new = {name: markdown(table) for name, table in tables(results).items()}
    at = results['machine']
    packages = ', '.join(
        f"{name} {version or 'not installed'}" for name, version in at['versions'].items())
    new['machine'] = (
        f'Measured on {at["date"]} with {at["cores"]} cores of {at["processor"]} '
        f'(load {at["load"]:.1f} at the start), {at["system"]}, Python {at["python"]}, '
        f'{packages}.')

    def table(match: re.Match[str]) -> str:
        name = match.group(2)
        return f'{match.group(1)}{new[name]}\n{match.group(3)}' if name in new else match.group()

    return _MARKED.sub(table, page)


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
    if not arguments.only:
        page = DOCS / 'performance.md'
        write_text(page, renewed(page.read_text(), results))


if __name__ == '__main__':
    main()
