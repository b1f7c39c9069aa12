"""The documentation's page on speed: its tables come from a file of measurements."""

from collections.abc import Mapping
import re
from typing import Any

from bellows_ros.errors import BellowsError

from .tables import markdown, tables

_MARKED = re.compile(r'(<!-- bench: (\S+) -->\n).*?(<!-- end -->)', re.DOTALL)


def renewed(page: str, found: Mapping[str, Any]) -> str:
    """
    Return a page whose tables, between `<!-- bench: NAME -->` and `<!-- end -->`, are made anew.

    A table that was not measured stays as it is.

    Raises
    ------
    BellowsError
        If the page has no place for any table.

    """
    new = {name: markdown(table) for name, table in tables(found).items()}
    new['machine'] = _machine(found['machine'])

    def table(match: re.Match[str]) -> str:
        name = match.group(2)
        return f'{match.group(1)}{new[name]}\n{match.group(3)}' if name in new else match.group()

    if not _MARKED.search(page):
        raise BellowsError("The page has no '<!-- bench: NAME -->' ... '<!-- end -->'.")
    return _MARKED.sub(table, page)


def _machine(machine: Mapping[str, Any]) -> str:
    """Return a sentence on the machine."""
    versions = ', '.join(f'{name} {version}' for name, version in machine['versions'].items())
    return (
        f'Measured on {machine["date"]} with {machine["cores"]} cores of {machine["processor"]} '
        f'(load {machine["load"]:.1f} at the start), {machine["system"]}, Python '
        f'{machine["python"]}, {versions}.'
    )
