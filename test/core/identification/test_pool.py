"""Functions of recordings run where these are, and their sums have one order."""

from bellows_ros.core.identification.pool import here
from bellows_ros.core.identification.search import median
from bellows_ros.errors import BellowsError
import numpy as np
from numpy.testing import assert_allclose
import pytest


def longer(values, more):
    """Return a longer value, and its sum."""
    return [*values, more], sum(values) + more


def test_a_part_of_a_value_is_kept_and_the_other_one_returned():
    values = here([[1], [2], [3]])
    for more in (10, 20):
        values, sums = values.pool.hold(longer, values, more)
    assert values.pool.results(list, values) == [[1, 10, 20], [2, 10, 20], [3, 10, 20]]
    assert sums == [31, 32, 33]
    assert values.pool.results(sum, values.only([2])) == [33]


def test_the_first_error_of_recordings_is_raised():
    values = here([2, 0, 1])
    with pytest.raises(BellowsError, match='of 0'):
        values.pool.results(refused, values)


@pytest.mark.parametrize('sizes', [(7,), (8,), (5, 9, 1), (2, 40, 11, 6)])
def test_medians_of_recordings_are_those_of_all_numbers(sizes):
    rng = np.random.default_rng(sum(sizes))
    parts = [rng.standard_normal((size, 3)) * (1.0 + size) for size in sizes]
    found = median(np.asarray, here(parts))
    assert_allclose(found, np.median(np.abs(np.concatenate(parts)), axis=0), rtol=1e-15)


def refused(number):
    """Refuse small numbers."""
    if number < 2:
        raise BellowsError(f'of {number}')
