"""Values of recordings are computed where these are, and again where they are lost."""

from bellows_ros.core.identification import pool as module
from bellows_ros.core.identification.pool import carried_out, forget, here, Pool
from bellows_ros.core.identification.search import median
from bellows_ros.errors import BellowsError
import numpy as np
from numpy.testing import assert_allclose
import pytest


class Forgetful:
    """Carry out tasks in this process, and lose all values before some of the rounds."""

    def __init__(self, *lost):
        """Begin with the first round."""
        self.rounds, self.lost = 0, lost

    def __call__(self, tasks):
        """Return the replies, the last recording first."""
        if self.rounds in self.lost:
            forget(tasks[0].session)
        self.rounds += 1
        return [(task.recording, reply) for task, reply in zip(
            tasks, carried_out(tasks), strict=True)][::-1]


def counted(calls, number):
    """Return a recording, and how often it was read."""
    calls.append(number)
    return [number], len(calls)


def longer(values, more):
    """Return a longer value, and its sum."""
    return [*values, more], sum(values) + more


@pytest.mark.parametrize('lost', [(), (2,), (2, 4), (3,)])
def test_lost_values_are_computed_again_and_results_are_the_same(lost):
    calls, run = [], Forgetful(*lost)
    pool = Pool(run, 3)
    values, _ = pool.hold(counted, calls, pool.each([1, 2, 3]))
    for more in (10, 20):
        values, sums = pool.hold(longer, values, more)
    assert pool.results(list, values) == [[1, 10, 20], [2, 10, 20], [3, 10, 20]]
    assert sums == [31, 32, 33]
    assert len(calls) == 3 * (1 + len(lost))
    assert pool.only([2]).results(sum, values) == [33]


def test_values_that_nobody_has_are_released():
    values = here([[1], [2]])
    pool, kept = values.pool, module._KEPT[values.pool.session]
    for more in range(5):
        values, _ = pool.hold(longer, values, more)
    assert [len(own) for own in kept.values()] == [2, 2]  # the last one, and that before
    name = pool.session
    del values, pool, kept
    assert name not in module._KEPT


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
