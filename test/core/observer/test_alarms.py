"""Tell a lost package, deviating poses and wrong parameters; nothing where nothing is wrong."""

from bellows_ros.core.geometry.tuples import quaternion_product
from bellows_ros.core.observer import alarms, measurement
from bellows_ros.core.observer.results import Evidence
from bellows_ros.report.findings import text
import numpy as np
import pytest
from scipy.stats import chi2

from .cases import (
    Cell,
    CELL_PERIOD_NS,
    CONDITIONS,
    CUP,
    EXACT,
    observer,
    PACKAGE,
)

EXACTLY = {**EXACT, 'payload__estimate': False}
KNOWN = {'payload__estimate': True}
"""As stated, mass and K to 1 %."""


@pytest.mark.parametrize(('fault', 'kind', 'within', 'more'), [
    ('slip', 'deviates', 1.5, {}), ('turn', 'deviates', 0.3, {}), ('camera', 'deviates', 1.0, {}),
    ('push', 'deviates', 0.7, {}),
    ('worn', 'differs', 12.0, KNOWN), ('mass', 'differs', 12.0, KNOWN)])
def test_fault_raises_its_alarm(fault, kind, within, more):
    """Say so once it is there, not before, with numbers in the sentence."""
    for seed in (1, 2):
        at = 0.0 if kind == 'differs' else 3.0
        wrong, size = ({'mass': 0.01, 'stiffness': 0.01}, 2.0) if kind == 'differs' else ({}, 2.0)
        cell = Cell(seed, at + (12.0 if kind == 'differs' else 4.0), wrong, fault, at, size=size,
                    **{**EXACTLY, **more})
        (found, after), *_ = cell.run()
        assert (found, 0.0 < after < within) == (kind, True)
        alarm = cell.made.alarms[0]
        assert '-.' not in text(alarm.finding) and 'None' not in text(alarm.finding)
        if kind == 'deviates':
            assert 0.0 <= alarm.since_ns - cell.stamps[0] + 5e7 - 1e9 * at
            assert np.linalg.norm([*alarm.shift, *alarm.rotation]) > 1e-3
        if kind == 'differs':
            ratio = cell.cup.stiffness[0, 0] * PACKAGE.mass / (
                CUP.stiffness[0, 0] * cell.package.mass)
            assert alarm.parameter == alarms.RATIO
            assert abs(alarm.value[0] - ratio) < 4.0 * alarm.std[0] < 0.2
            assert text(alarm.finding).startswith('The measured poses show K/m ')
            assert 'a softer cup or a heavier package' in text(alarm.finding)


@pytest.mark.parametrize('more', [
    EXACT, {'measured__camera_std': [2e-3, 3e-3], 'measured__marker_std': [2e-3, 3e-3]}])
def test_slip_of_the_stated_smallest_size_is_found(more):
    """State the size before the slip, by the noise and by the errors of camera and marker."""
    for seed in range(3):
        sound = Cell(seed, 3.0, {}, **more)
        assert sound.run() == []
        cell = Cell(seed, 5.0, {}, 'slip', 3.0, size=sound.made.smallest_slip / 3e-3, **more)
        assert cell.run()[0][0] == 'deviates'


def test_parameters_are_unknown_again_after_a_slip():
    """Predict 3 s after a slip of 6 mm to a millimetre, with the com where the lip now is."""
    errors = []
    for seed in range(3):
        cell, of_cell = Cell(seed, 9.0, {}, 'slip', 3.0, size=2.0, **EXACT), []
        cell.run(lambda k, cell=cell, of_cell=of_cell: of_cell.append(
            np.linalg.norm(np.subtract(cell.made.body[0], cell.body[k][0]))))
        assert [alarm.kind for alarm in cell.made.alarms] == ['deviates']
        errors += of_cell[round(6e9 / CELL_PERIOD_NS):]
    assert np.sqrt(np.mean(np.square(errors))) < 1.2e-3


def test_only_poses_that_fit_name_a_parameter():
    """Count no pose of another body, whose innovations are unusual."""
    made, sizes = observer(alarm__false_per_hour=1.0), np.array([9.0, 0.0, 0.0, 0.0])
    means, variances, squares = measurement.NO_MEANS
    counts = []
    for square, gated_ns in ((10.0, ()), (30.0, ()), (10.0, (1,))):
        estimate = made._correction.initial._replace(gated_ns=gated_ns)
        evidence = Evidence((means, variances, squares + square))
        counts.append(made._correction._differing(
            estimate, evidence, sizes)[0].evidence.differing)
    assert counts == [1, 0, 0]


def test_value_by_the_measurements_alone_is_that_without_a_prior():
    """As two estimates of a number are fused by their variances."""
    prior, own, shift = np.array([1e-4]), np.array([2e-4]), np.array([0.03])
    variance = prior * own / (prior + own)
    change, std = alarms.shown_alone(shift * variance / own, prior, variance)
    np.testing.assert_allclose([change, std**2], [shift, own], rtol=1e-12)


@pytest.mark.stress
@pytest.mark.parametrize('name', ['all, small', 'outliers 3 %', 'noise 1.5 times as stated'])
def test_minutes_of_sound_work_raise_no_alarm(name):
    assert Cell(90_000, 600.0, CONDITIONS[name], payload__estimate=True).run() == []


@pytest.mark.parametrize('name', CONDITIONS)
def test_ordinary_cell_raises_no_alarm(name):
    """Say nothing of what is as uncertain as it was said to be."""
    for estimate in (False, True):
        cell = Cell(3, 8.0, CONDITIONS[name], payload__estimate=estimate)
        assert cell.run() == []
        outliers = cell.wrong['outliers'] + 0.1 * (cell.wrong['noise'] - 1.0)
        assert cell.made.counts['outlier'] <= 2 + len(cell.seen) * outliers


@pytest.mark.parametrize(('rate_hz', 'frames', 'shift'), [(125 / 4, 2, 0.02), (125.0, 3, 0.02)])
def test_pose_that_is_wrong_for_some_frames_raises_no_alarm(rate_hz, frames, shift):
    """Wait until a flipped tag or a confused marker is over."""
    cell = Cell(2, 6.0, CONDITIONS['all, small'], rate_hz=rate_hz)
    keys = sorted(cell.seen)
    for first in range(len(keys) // 4, len(keys) - frames, len(keys) // 4):
        for k in keys[first:first + frames]:
            (stamp_ns, (position, quaternion)), = cell.seen[k]
            flip = quaternion_product(quaternion, (0.2, 0.0, 0.0, 0.96**0.5))
            cell.seen[k] = [(stamp_ns, ((position[0] + shift, *position[1:]), flip))]
    assert (cell.run(), cell.made.counts['recovered']) == ([], 0)


@pytest.mark.parametrize('rate_hz', [125 / 4, 125 / 12])
@pytest.mark.parametrize('kind', ['drop', 'peel'])
def test_fall_is_always_noticed(kind, rate_hz):
    """Notice what falls, though the camera loses sight of it, or the vacuum's sensor sticks."""
    for is_stuck in (False, True):
        cell = Cell(1, 4.0, CONDITIONS['all, small'], kind, 3.0, rate_hz, **EXACTLY)
        found = cell.run(lambda k, cell=cell, is_stuck=is_stuck: (
            is_stuck and k == 1 and cell.made.on_vacuum(True, False, True)))
        assert [after for named, after in found if named == 'lost'][0] < 0.3


@pytest.mark.parametrize('fault', ['slip', 'drop', 'vacuum'])
def test_late_and_shuffled_equals_in_order_with_an_alarm(fault):
    """End with the same estimate and alarms where every second pose comes 100 ms later."""
    ends = []
    for shuffled in (False, True):
        cell = Cell(6, 6.0, {}, fault.replace('vacuum', ''), at=3.0, size=2.0, **EXACT)
        if shuffled:
            came = {}
            for n, (k, poses) in enumerate(cell.seen.items()):
                came.setdefault(min(k + 12 * (n % 2) + 3, len(cell.tool) - 1), []).extend(poses)
            cell.seen = came
        cell.run(lambda k, cell=cell: fault == 'vacuum' and k == 380 and cell.made.on_vacuum(
            False, True, True))
        ends.append(cell.made)
    assert ends[0].alarms
    for one, other in zip(ends[0].alarms, ends[1].alarms, strict=True):
        assert one[:3] == other[:3]
    one, other = (made.estimate for made in ends)
    np.testing.assert_allclose(one.theta, other.theta, rtol=1e-6, atol=1e-9)
    np.testing.assert_allclose(np.concatenate(one.body), np.concatenate(other.body), rtol=1e-6)


def test_threshold_is_exceeded_at_the_allowed_rate():
    """As chi^2 of 6 and independent means have it."""
    x = chi2.isf(2.0 * 0.03 / 3600.0 / measurement.SHARES.sum(), 6)
    assert [alarms.is_deviation(x + by, 2.0, 0.03) for by in (-1e-3, 1e-3)] == [False, True]
    rng, means, largest = np.random.default_rng(1), measurement.NO_MEANS, []
    for z in rng.normal(size=(3000, 6)):
        means = measurement.moved_means(means, z)
        largest.append(means[2])
    np.testing.assert_allclose(np.mean(largest, axis=0), 6.0, rtol=0.35)
