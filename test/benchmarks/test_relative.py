"""The comparison of absolute and relative filtering runs, and says what the documentation says."""

from benchmarks.relative import both, Case, COLUMNS, table
import numpy as np
from numpy.testing import assert_allclose


def test_equal_windows_make_no_difference_and_different_ones_do():
    absolute, relative = both(Case((1e-4, 5e-4), (1e-4, 5e-4)), seed=1)
    assert_allclose(relative, absolute, atol=5e-3)
    damping_x = COLUMNS.index('P x')
    absolute, relative = both(
        Case((1e-4, 5e-4), (1e-4, 5e-4), half_windows=(15, 30)), seed=1)
    assert np.abs(relative - 1.0)[damping_x] < 0.5 * np.abs(absolute - 1.0)[damping_x]


def test_the_table_has_both_filters_for_every_case():
    lines = list(table((Case((0.0, 0.0), (0.0, 0.0)),), (1,)))
    assert [line.count('|') for line in lines] == [4 + len(COLUMNS)] * 4
    assert [' absolute ' in lines[2], ' relative ' in lines[3]] == [True, True]
