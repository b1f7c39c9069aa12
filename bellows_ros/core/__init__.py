"""
Hold the numbers: model, integration, filtering, identification, prediction.

Needs numpy and scipy, and numba where present. Reads no files, logs nothing, knows no ROS.
"""

import os


def keep_linear_algebra_single() -> None:
    """
    Ask for one thread of linear algebra in this process; call it before NumPy is imported.

    More only wait for each other: on two busy cores least squares takes two to seven times as
    long with them. What the user has set prevails.
    """
    for variable in ('OPENBLAS_NUM_THREADS', 'MKL_NUM_THREADS'):
        os.environ.setdefault(variable, '1')
