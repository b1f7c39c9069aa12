"""Which stamps of a recording are left out: as few as possible."""

from bellows_ros.core.signals.screening import unusable_stamps
import numpy as np
import pytest

from ..recording.tracking import START

MS = 1_000_000
S = 1000 * MS
PERIOD = 2 * MS
COUNT = 5696


def sent(count=COUNT):
    """Give stamps at 500 Hz, and arrivals some milliseconds later."""
    stamps = START + PERIOD * np.arange(count)
    late = np.random.default_rng(1).integers(MS, 3 * MS, size=count)
    return stamps, np.maximum.accumulate(stamps + late)


def left_out(stamps, arrivals):
    """Give the indices left out by reason; what remains must increase."""
    found = unusable_stamps(stamps, arrivals)
    bad = np.logical_or.reduce(list(found.values()))
    assert sum(np.count_nonzero(mask) for mask in found.values()) == np.count_nonzero(bad)
    assert np.all(np.diff(stamps[~bad]) > 0)
    return {reason: np.flatnonzero(mask).tolist() for reason, mask in found.items() if mask.any()}


@pytest.mark.parametrize('ahead', [25 * MS, 100 * MS, 5 * S, 3600 * S])
@pytest.mark.parametrize('at', [100, 1000, COUNT - 1])
def test_one_future_stamp_is_the_only_omitted_one(at, ahead):
    stamps, arrivals = sent()
    stamps[at] += ahead
    assert left_out(stamps, arrivals) == {'future_stamp': [at]}


def test_late_and_repeated_stamps_cost_themselves():
    stamps, arrivals = sent()
    stamps[2000] = stamps[1990] + 1
    stamps[3000] = stamps[2999]
    assert left_out(stamps, arrivals) == {'backward_stamp': [2000], 'duplicate_stamp': [3000]}


@pytest.mark.parametrize('set_back', [30 * MS, S, 3600 * S])
@pytest.mark.parametrize('at', [500, 4000])
def test_a_clock_that_is_set_back_costs_the_shorter_part_of_what_overlaps(at, set_back):
    stamps, arrivals = sent()
    stamps[at:] -= set_back
    overlap = min(set_back // PERIOD, at, COUNT - at)
    lost = sum(map(len, left_out(stamps, arrivals).values()))
    assert overlap <= lost <= overlap + 1


def test_a_clock_that_is_set_forward_costs_no_pose():
    stamps, arrivals = sent()
    stamps[2000:] += 3600 * S
    assert left_out(stamps, arrivals) == {}


def test_pauses_and_late_arrivals_are_no_faults():
    stamps, arrivals = sent()
    stamps[3000:] += 20 * S
    arrivals[3000:] += 20 * S
    arrivals[1000:] += 40 * MS
    assert left_out(stamps, arrivals) == {}
    assert left_out(stamps[:0], arrivals[:0]) == {}
    assert left_out(stamps[:1], arrivals[:1]) == {}


def test_no_more_are_lost_than_are_wrong():
    rng = np.random.default_rng(2)
    for _ in range(60):
        stamps, arrivals = sent(600)
        right = stamps.copy()
        for at in rng.integers(20, 600, size=rng.integers(1, 6)):
            stamps[at:at + rng.integers(1, 4)] += rng.choice([-S, -5 * MS, 30 * MS, S, 3600 * S])
        wrong = np.count_nonzero(stamps != right)
        lost = sum(map(len, left_out(stamps, arrivals).values()))
        assert lost <= wrong
