"""
Judge which fault of a simulated recording is named first.

What `bellows identify` says first of the recordings of a laboratory is judged: the cause, another
one (certain or not), or nothing; where nothing is refused, K is compared with the truth: beyond
5 standard errors and 2 % it is wrong and silent.
"""

from bellows_ros.core.findings import Level
from bellows_ros.core.identification.fitting import fit
from bellows_ros.core.recording.faults import pose_remarks, recording_remarks
from bellows_ros.core.recording.pose_faults import RecordedPoses
from bellows_ros.errors import BellowsError
from bellows_ros.workflows.verdict import verdict_of
import numpy as np

from .core.identification.laboratory import parameters


def outcome(laboratory, cause):
    """Return the judgement of the first finding on a laboratory's recordings, and all findings."""
    try:
        recordings = [laboratory.recording()]
        values = parameters(laboratory)
        length = values['cup.length']
        if wrong := [code for one in recordings for code in before_a_fit(one)]:
            named = ' '.join(wrong)
            return 'right' if cause in named else 'wrong and certain', named
        found = fit(recordings, values)
        verdict = verdict_of(found, recordings, length, values)
    except BellowsError as error:
        return 'right' if cause in str(error) else 'refused otherwise', str(error)[:90]
    findings = verdict.causing
    named = [f'{own.name} {own.value} {own.instead} '
             f'{"certain" if own.certain else "perhaps"}' for own in findings]
    said = '; '.join([*named, *(own.code for own in verdict.refusals)])[:200]
    word, off = unnamed(laboratory, verdict, found, said)
    if verdict.cause and findings:
        if word == 'silent and wrong':
            return 'said, and wrong', f'{said} {off}'
        return of_one(named, cause), said
    first = next(iter(verdict.found), '')  # with K and P, so that nothing is refused
    if cause in first:
        word = {'silent': 'right', 'silent and wrong': 'said, and wrong'}.get(word, word)
    return word, f'{first} {off}'


def before_a_fit(recording):
    """Return the codes of the faults that prevent a fit."""
    poses = RecordedPoses(
        recording.tool_pose, recording.package_pose, recording.settings.R_world_recorded,
        recording.payload, twist=recording.tool_twist)
    found = *recording.report.remarks, *pose_remarks(poses)
    wrong = [own.code for own in found if own.level == Level.ERROR]
    return wrong or [own.code for own in recording_remarks(recording)
                     if own.level == Level.ERROR]


def of_one(named, cause):
    """Return whether a cause is named first, for an unknown one first of the listed."""
    if cause in named[0]:
        return 'right'
    listed = named[1:] if named[0].startswith('unknown') else named
    if any(cause in word for word in listed):
        return 'first, not certain' if cause in listed[0] else 'among three'
    return 'wrong and certain' if 'certain' in named[0] else 'wrong, not certain'


def unnamed(laboratory, verdict, found, said):
    """Return the judgement of a result without a named cause."""
    if verdict.refusals or found is None:
        return 'refused without a cause' if verdict.refusals else 'not named before the fit', said
    std = np.diag(found.stiffness_std)
    off = np.abs(np.diag(found.stiffness) - laboratory.K)
    wrong = np.isfinite(std) & (off > 5.0 * std) & (off > 0.02 * laboratory.K)
    return ('silent and wrong' if wrong.any() else 'silent'), (
        f'K {np.round(100.0 * off / laboratory.K, 1).tolist()} %, chi^2 {found.chi2:.3g}')
