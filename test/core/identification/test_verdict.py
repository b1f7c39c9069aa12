"""What is said of residuals: no doubt where a free simulation is as good as the poses."""

from dataclasses import replace

from bellows_ros.core import findings
from bellows_ros.core.findings import Level
from bellows_ros.core.identification import verdict
from bellows_ros.core.identification.result import Cause, Fit
from bellows_ros.core.identification.verdict import cause_finding, Change, FitVerdict, Simulated
from bellows_ros.core.model.structure import STRUCTURES
from bellows_ros.core.parameters.conversion import tag_of
from bellows_ros.core.parameters.values import Values
from bellows_ros.core.recording.faults import recording_remarks
from bellows_ros.report.findings import text
import numpy as np
import pytest

from .laboratory import Laboratory, parameters


def words(findings):
    """Return findings in words."""
    return ' '.join(map(text, findings))


def cause(name, theta, share=0.9, certain=True):
    """Return what was found to be otherwise, with small standard errors."""
    theta = np.array(theta)
    return Cause(name, '', theta, 1e-3 * np.abs(theta), np.float64(share), 0.4, True, certain)


@pytest.mark.parametrize(('off', 'listed'), [(1.0, ()), (10.0, ('gravity', 'scale'))])
def test_an_unknown_cause_and_its_candidates_are_for_a_cup_that_is_refused(off, listed):
    """A sound recording gets none, whatever the memory of its noise."""
    noise = np.repeat([1e-4, 5e-4], 3)
    findings = (Cause('unknown', 'rx', np.array([0.0, 8.0, 0.0, 5.0]), np.zeros(4), 0.0,
                      certain=False, datum=False),
                cause('scale', [0.01], 0.4, False), cause('time_offset', [0.01], 0.2, False))
    found = FitVerdict((Simulated('a', off * noise, noise, 20.0 * noise),),
                       findings, Values({}))
    said = words(found.cause)
    assert bool(found.refusals) == bool(listed) == bool(said)
    if listed:
        assert 'unknown' in said and '1. ' in said and '40 %' in said and '2. ' in said


def judged(*causes):
    """Return a verdict on a fit with these causes."""
    return FitVerdict((), causes, Values({'package.com': (0.0, 0.0, 0.0)}))


@pytest.mark.parametrize(('heavier', 'pull', 'said'), [
    (0.09, 2.0, ['0.914 times', '120 %']), (-0.09, 2.0, ['1.09', '120 %']), (0.03, 2.0, ['120 %']),
    (-0.4, 16.0, ['1.49 times', '16 times'])])
def test_a_corrected_inertia_makes_the_mass_doubtful_and_is_a_finding(heavier, pull, said):
    found = judged()._replace(log_inertia_ratio=heavier, changes=(Change(
        'package.inertia', '120 %', pull, 'package.inertia_std'),)).corrections
    assert found[-1].level == (Level.OK if pull < 3.0 else Level.WARN)
    assert len(found) == len(said)
    assert all(part in text(each) for part, each in zip(said, found, strict=True))


@pytest.mark.parametrize(('factors', 'said'), [
    ((10.0, 10.0, 10.0), 'off by 900 ± 10 %, 900 ± 10 %, 900 ± 10 %, or package.mass by 90 %'),
    ((0.5, 1.0, 1.0), 'off by 50 ± 0.5 %, if package.mass is right')])
def test_an_inertia_is_off_by_percents_or_the_mass_by_as_large_a_factor(factors, said):
    cause = Cause('inertia', '', np.log(factors), np.full(3, 0.01))
    assert said in text(cause_finding(cause, {'package.inertia': (1.0, 1.0, 1.0)}))


@pytest.mark.parametrize(('certain', 'datum', 'share', 'refused'), [
    (True, True, 0.9, True), (True, False, 0.9, False), (False, True, 0.9, True),
    (False, True, 0.4, False)])
def test_a_certain_cause_or_a_likely_one_that_moves_k_refuses_a_cup(
        certain, datum, share, refused):
    found = judged(cause('time_offset', [0.02], share, certain)._replace(datum=datum))
    assert bool(found.refusals) == refused


@pytest.mark.parametrize(('pull', 'certain', 'named'), [
    (2.0, False, ''), (8.0, True, 'Correct'), (8.0, False, 'package.com is 18 mm')])
def test_contradicted_given_values_refuse_a_cup_without_a_certain_cause(pull, certain, named):
    found = judged(cause('com', [0.02, 0.0, 0.0], 0.1, certain))._replace(
        changes=(Change('package.com', '18 mm', pull, 'package.com_std'),))
    assert named in words(found.refusals) and bool(found.refusals) == bool(named)


def made_for(laboratory, factor=1.0, std=1e-3, structure='axisymmetric'):
    """Return a fit that found the true cup, but for a factor and a part of K rz and P rz."""
    structure = STRUCTURES[structure]
    about_z = np.array(['rz' in label for label in structure.labels])
    x = structure.parameters(np.diag(laboratory.K), laboratory.P) * np.where(about_z, factor, 1.0)
    return Fit(
        method='output_error', structure=structure.name, parameters=x,
        covariance=np.diag((np.where(about_z, std, 1e-3) * x) ** 2), samples_used=1,
        samples_rejected=0, condition_number=1.0, residual_rms=np.ones(6),
        chi2=1.0, robust_chi2=1.0)


@pytest.mark.parametrize(('factor', 'refused'), [(1.01, False), (1.5, True)])
def test_a_cup_that_does_not_predict_the_last_fifth_is_refused(factor, refused):
    """With K rz and P rz of the first four fifths, though those of the whole predict it."""
    laboratory = Laboratory(4, seconds=4.0)
    whole, first = (made_for(laboratory, each) for each in (1.0, factor))
    found = verdict.verdict_of(
        replace(whole, held_out=first.parameters), [laboratory.recording()], laboratory.length,
        parameters(laboratory))
    assert [(reason.code, reason.numbers['axes']) for reason in found.refusals] == (
        [('not_predicted', 'rz')] * refused)


def test_what_a_fit_found_comes_after_nothing_but_facts():
    """Of poses that come in bursts, and a centre of mass elsewhere."""
    laboratory = Laboratory(4, seconds=4.0)
    wrong = cause('com', [3e-3, 0.0, 0.0]), cause('length', [2e-3])
    found = verdict.verdict_of(
        replace(made_for(laboratory), causes=wrong), [laboratory.recording()], laboratory.length,
        parameters(laboratory))
    assert found.is_at_noise and found.causing == wrong
    recording = laboratory.recording()
    faulty = replace(recording, report=replace(recording.report, remarks=(
        findings.Finding('low_pass', Level.ERROR, {'above': 40.0}),)))
    found = verdict.verdict_of(
        replace(made_for(laboratory), causes=wrong), [faulty], laboratory.length,
        parameters(laboratory))
    assert found.cause[0].code == 'low_pass' and found.refusals and not found.causing


TILTING = np.array([6e-3, 6e-3, 2e-3])
"""Noise of the orientation of a tag, rad: its tilt is less certain than its turn."""


@pytest.mark.parametrize(('size', 'noise', 'camera_hz', 'named'), [
    (0.0, TILTING, 30.0, ['sensor']), (0.0, 5e-4, 240.0, []), (0.05, TILTING, 30.0, []),
    (0.0, 1e-2, 30.0, [])])  # white, as a body has by default
def test_poses_of_another_kind_of_sensor_are_named(size, noise, camera_hz, named):
    laboratory = Laboratory(4, seconds=6.0, rate_hz=240.0)
    laboratory.noise, laboratory.camera_hz = ((3e-4, noise), laboratory.noise[1]), camera_hz
    recording = laboratory.recording()
    recording = replace(recording, settings=replace(recording.settings, tag=tag_of(
        parameters(laboratory).replaced({'measured.tag_size': size}))))
    found = recording_remarks(recording)
    assert [remark.code for remark in found if remark.level < Level.ERROR] == named
