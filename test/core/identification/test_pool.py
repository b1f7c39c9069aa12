"""Functions of recordings run where these are, and their sums have one order."""

from bellows_ros.core.identification.segments import here
from bellows_ros.errors import BellowsError
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


def refused(number):
    """Refuse small numbers."""
    if number < 2:
        raise BellowsError(f'of {number}')
