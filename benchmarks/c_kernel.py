"""The header of `bellows export --to c`, compiled when it is measured."""

from collections.abc import Sequence
import ctypes
from pathlib import Path
import shutil
import subprocess
from typing import Any

from bellows_ros.core.geometry.arrays import Array
from bellows_ros.core.model.kernels import ModelTuple, State
from bellows_ros.errors import BellowsError
from bellows_ros.files.exports import Exported, header
import numpy as np

from .step_case import CUP, PACKAGE

SIMULATE = """
void simulate(const bellows_model *m, const bellows_state *start, const bellows_state *tool,
              const double *durations, long count, bellows_state *out)
{
    out[0] = *start;
    for (long k = 0; k + 1 < count; k++)
        out[k + 1] = bellows_step(m, &out[k], &tool[k], &tool[k + 1], durations[k], 1);
}
"""
"""Writes so many rows of 13 numbers: the package at each of the tool's rows."""


class CKernel:
    """
    `bellows_step` along a motion of the tool.

    Parameters
    ----------
    folder : Path
        Where the library is put.
    options : sequence of str
        For the compiler.

    Raises
    ------
    BellowsError
        If there is no compiler, or it fails.

    """

    def __init__(self, folder: Path, options: Sequence[str] = ('-O3',)) -> None:
        """Compile and load."""
        compiler = shutil.which('gcc') or shutil.which('cc')
        if compiler is None:
            raise BellowsError('No C compiler (gcc or cc) is installed.')
        library = folder / f'step{"_".join(options)}.so'
        source = library.with_suffix('.c')
        source.write_text(header(Exported(CUP, PACKAGE)) + SIMULATE)
        command = [compiler, '-std=c11', '-ffp-contract=off', *options, '-shared', '-fPIC', '-o',
                   str(library), str(source), '-lm']
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if done.returncode:
            raise BellowsError(f'The C compiler failed: {done.stderr[-400:]}')
        self._simulate = ctypes.CDLL(str(library)).simulate
        self._simulate.restype = None

    def simulate(self, model: ModelTuple, start: State, tool: Array, durations: Array) -> Array:
        """Return the package's rows (N, 13) for as many tool rows and the times (s) between."""
        inputs = [np.array(flat(model)), np.array(flat(start)), tool, durations]
        out = np.empty((len(tool), 13))
        pointers = [np.ascontiguousarray(array).ctypes.data_as(ctypes.c_void_p)
                    for array in (*inputs, out)]
        self._simulate(*pointers[:4], ctypes.c_long(len(tool)), pointers[4])
        return out


def flat(values: Any) -> list[float]:
    """Return nested tuples of numbers as one list."""
    if isinstance(values, tuple):
        return [number for part in values for number in flat(part)]
    return [float(values)]
