"""Threads of linear algebra: one is enough for matrices as small as those here."""

import os

_VARIABLES = ('OPENBLAS_NUM_THREADS', 'MKL_NUM_THREADS')


def keep_linear_algebra_single() -> None:
    """
    Ask for one thread of linear algebra in this process; call it before NumPy is imported.

    More only wait for each other: on two busy cores least squares takes two to seven times as
    long with them. What the user has set prevails.
    """
    for variable in _VARIABLES:
        os.environ.setdefault(variable, '1')
