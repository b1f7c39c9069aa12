"""The integrator by hand in C, compiled when it is measured."""

from collections.abc import Sequence
import ctypes
from pathlib import Path
import shutil
import subprocess
from typing import Any

from bellows_ros.core.kernels import ModelTuple, State
from bellows_ros.errors import BellowsError
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

SOURCE = Path(__file__).with_name('step.c')


class CKernel:
    """
    `simulate` of step.c.

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
        command = [compiler, *options, '-shared', '-fPIC', '-o', str(library), str(SOURCE), '-lm']
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
                    for array in (*inputs, out)]  # fmt: skip
        self._simulate(*pointers[:4], ctypes.c_long(len(tool)), pointers[4])
        return out


def flat(values: Any) -> list[float]:
    """Return nested tuples of numbers as one list."""
    if isinstance(values, tuple):
        return [number for part in values for number in flat(part)]
    return [float(values)]
