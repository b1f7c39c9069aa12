"""Pages of an identification and of a replay: the text of the terminal, pictures, provenance."""

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from html import escape
import io
from typing import Any

from bellows_ros import plots
from bellows_ros.core.parameters.table import PARAMETERS
from bellows_ros.errors import shown
from bellows_ros.files import atomic, File, results
from bellows_ros.workflows.identification import Identification
from bellows_ros.workflows.replay import Replay
from rich.console import Console

from .text import print_identification, print_replay, Writer

PAGE = """<!DOCTYPE html>
<html lang="en"><head><meta charset="utf-8"><title>{title}</title><style>
body {{ max-width: 66rem; margin: 2rem auto; padding: 0 1rem }}
pre {{ white-space: pre-wrap; overflow-wrap: anywhere }} svg {{ width: 100%; height: auto }}
</style></head><body>
{parts}
</body></html>
"""

WIDTH = 110
"""Width of the text, characters: two columns of digits fit beside their names."""


def printed(show: Callable[[Writer], None]) -> str:
    """Return printed text as HTML."""
    console = Console(record=True, file=io.StringIO(), width=WIDTH)
    show(Writer(console))
    return console.export_html(inline_styles=True, code_format='<pre>{code}</pre>')


def page_of(result: Identification | Replay, parameter_files: Sequence[File] = ()) -> str:
    """Return the page of a result, with pictures of free simulations, which loads nothing."""
    origin = {**result.as_json()['provenance'], 'parameter_files': results.listed(parameter_files)}
    if isinstance(result, Identification):
        title = f'Cup identified from {", ".join(result.bags)}'
        text, simulations = printed(partial(print_identification, result)), (
            result.verdict.simulations)
    else:
        title = f'Replay of {result.bag}'
        text, simulations = printed(partial(print_replay, result)), (result.validation,)
    pictures = [plots.svg_of(plots.simulation_figure(each)) for each in simulations]
    return PAGE.format(title=escape(shown(title)), parts='\n'.join(
        [text, *pictures, _origin(origin, result.values)]))


def write_page(
    result: Identification | Replay, path: File, parameter_files: Sequence[File] = ()
) -> None:
    """Write the page of a result; raise BellowsError if the file cannot be written."""
    atomic.write_text(path, page_of(result, parameter_files))


def _origin(provenance: Mapping[str, Any], values: Mapping[str, Any]) -> str:
    """Return digests of files, versions, and settings."""
    def show(out: Writer) -> None:
        out.line('Provenance', 'bold')
        for entry in (*provenance['recordings'], *provenance['parameter_files']):
            for file in entry['files']:
                out.line(f'{file["sha256"]}  {entry["path"]}, {file["name"]}')
        out.table([('', 'version'), *(
            (name, version or '-') for name, version in provenance['versions'].items())])
        out.table([('parameter', 'value'), *(
            (name, str(each)) for name, each in values.items()
            if name not in PARAMETERS or each != PARAMETERS[name].default)])

    return printed(show)
