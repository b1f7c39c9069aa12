"""Name what is wrong, and nothing where nothing is."""

from collections import Counter

import numpy as np
import pytest

from .faults import by_chance, KINDS, most_within, SLIP, work


@pytest.mark.parametrize('kind', KINDS)
def test_cause_of_a_fault_is_named(kind):
    """Say of a few faults what they are, none before it is there."""
    for seed in range(2):
        alarms = work(seed, kind, 4.2)
        assert alarms
        cause, after = alarms[0]
        assert cause == kind
        assert after < 1.2
        assert kind in ('wear', 'payload') or after > 0.0


def test_sound_work_raises_no_alarm():
    """Say nothing in 24 s."""
    assert [work(seed, '', 8.0) for seed in range(3)] == [[], [], []]


def test_chance_raises_no_alarm():
    """Say nothing in a quarter of an hour of innovations that are pure chance."""
    assert by_chance(0.25, 0) == []


@pytest.mark.stress
@pytest.mark.timeout(3600)
def test_a_thousand_faults(capsys):
    """Name the causes of faults of six kinds, and slips nearly as soon as any test can."""
    right, slips = 0, []
    most = np.mean([most_within(0.5, 1.0, seed) for seed in range(20)])
    for kind in KINDS:
        firsts = [(work(seed, kind) or [('none', np.inf)])[0] for seed in range(167)]
        named = Counter(cause for cause, _ in firsts)
        delays = np.array([after for _, after in firsts])
        right += named[kind]
        slips = delays if kind == 'slip' else slips
        with capsys.disabled():
            print(f'\n{kind}: {dict(named)}, after {np.median(delays):.2f} s (median), '
                  f'{100 * np.mean(delays <= 0.5):.0f} % within 0.5 s')
    with capsys.disabled():
        print(f'right {right} of {167 * len(KINDS)}; no test finds more than {100 * most:.1f} % '
              f'of slips of {1e3 * SLIP:g} mm within 0.5 s')
    assert right >= 0.95 * 167 * len(KINDS)
    assert np.mean(np.array(slips) <= 0.5) >= 0.93


@pytest.mark.stress
@pytest.mark.timeout(3600)
def test_chance_raises_no_more_alarms_than_allowed(capsys):
    """Allow one an hour in twenty hours of innovations that are pure chance."""
    false = Counter(cause for seed in range(4) for cause, _ in by_chance(5.0, seed))
    with capsys.disabled():
        print(f'\nfalse alarms in 20 h of pure chance: {dict(false)}')
    assert false.total() <= 20


@pytest.mark.stress
@pytest.mark.timeout(7200)
def test_ten_hours_of_sound_work(capsys):
    """Raise no more false alarms than are allowed: one an hour."""
    false = Counter(alarm[0] for seed in range(600) for alarm in work(seed, '', 60.0))
    with capsys.disabled():
        print(f'\nfalse alarms in 10 h: {dict(false)}')
    assert false.total() <= 10
