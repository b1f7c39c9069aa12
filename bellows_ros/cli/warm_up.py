"""Compile everything ahead of its first use."""

import argparse
import time
from typing import Any

from bellows_ros.core.geometry.jit import COMPILED, FOLDER
from bellows_ros.errors import BellowsError, install
from bellows_ros.workflows import warm_up

from . import options
from .console import Console


def run(arguments: argparse.Namespace, console: Console) -> options.Outcome:
    """Compile in as many processes as cores."""
    if not COMPILED:
        raise BellowsError(f'Nothing is compiled without numba. Install it: {install("fast")}')
    if FOLDER is None:
        raise BellowsError('Compiled code cannot be stored. Set NUMBA_CACHE_DIR to a folder.')
    begun = time.monotonic()
    with console.progress as progress:
        warm_up.warm_up(warm_up.PARTS, ((0.0, 0.0), warm_up.RELAXING), progress)
    found = {'folder': str(FOLDER), 'duration_s': time.monotonic() - begun}
    return options.Outcome(found, content=found)


def print_result(found: dict[str, Any], console: Console) -> None:
    """Print the folder, and the time."""
    console.line(f'Compiled in {found["duration_s"]:.0f} s, and stored in {found["folder"]}.')
