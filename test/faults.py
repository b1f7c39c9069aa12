"""
Count which faults of recordings are named first.

    OPENBLAS_NUM_THREADS=1 python -m test.faults --seeds 2 --pairs 0 --kinds length inertia

Every fault is put into simulated recordings of a laboratory of its own: cup, package, noise and
motion. What `bellows identify` says of them first is counted: the cause, another one (certain or
not), or nothing; where nothing is refused, K is compared with the truth: beyond 5 standard errors
and 2 % it is wrong and silent. Sound recordings of white and of correlated noise are to be kept.
"""

import argparse
from collections import Counter
import time

from bellows_ros.core.findings import Level
from bellows_ros.core.identification.methods import fit
from bellows_ros.core.recording.faults import pose_remarks, recording_remarks
from bellows_ros.core.recording.pose_faults import RecordedPoses
from bellows_ros.errors import BellowsError
from bellows_ros.workflows.verdict import verdict_of
import numpy as np

from .core.identification.laboratory import FAULTS, Laboratory, parameters

SOUND = 'sound'


def outcome(laboratory, cause, other=''):
    """
    Return the judgement of the first finding on a laboratory's recordings, and all findings.

    Of two simultaneous faults both are named, or neither finding is certain.
    """
    try:
        recordings = laboratory.recordings()
        values = parameters(laboratory)
        length = values['cup.length']
        warned = ' '.join(own.code for one in recordings for own in one.report.remarks)
        if wrong := [code for one in recordings for code in before_a_fit(one, length)]:
            named = ' '.join(wrong)
            return 'right' if cause in named and (not other or other in named) else (
                'one of two' if other and (cause in named or other in named) else
                'wrong and certain'), named
        found = fit(recordings, values)
        verdict = verdict_of(found, recordings, length, values)
    except BellowsError as error:
        named = [own for own in (cause, other) if own and own in str(error)]
        return ('refused otherwise', 'one of two' if other else 'right', 'right')[len(named)], (
            str(error)[:90])
    findings = verdict.causing
    named = [f'{own.name} {own.value} {own.instead} '
             f'{"certain" if own.certain else "perhaps"}' for own in findings]
    said = '; '.join([*named, *(own.code for own in verdict.refusals)])[:200]
    if other and named:
        return of_two(named, cause, other), said
    word, off = unnamed(laboratory, verdict, found, said)
    if cause == SOUND:
        if verdict.refusals or 'step' in warned:
            return 'refused', f'{said} {warned}'
        return {'silent': 'right'}.get(word, word), off
    if verdict.cause and findings:
        if word == 'silent and wrong':
            return 'said, and wrong', f'{said} {off}'
        return of_one(named, cause), said
    first = next(iter(verdict.found), '')  # with K and P, so that nothing is refused
    if cause in first:
        word = {'silent': 'right', 'silent and wrong': 'said, and wrong'}.get(word, word)
    return word, f'{first} {off}'


def before_a_fit(recording, length):
    """Return the codes of the faults that prevent a fit."""
    poses = RecordedPoses(
        recording.tool_pose, recording.package_pose, recording.settings.R_world_recorded,
        recording.payload, twist=recording.tool_twist)
    found = *recording.report.remarks, *pose_remarks(poses)
    wrong = [own.code for own in found if own.level == Level.ERROR]
    return wrong or [own.code for own in recording_remarks(recording, length)
                     if own.level == Level.ERROR]


def of_one(named, cause):
    """Return whether a cause is named first, for an unknown one first of the listed."""
    if cause in named[0]:
        return 'right'
    listed = named[1:] if named[0].startswith('unknown') else named
    if any(cause in word for word in listed):
        return 'first, not certain' if cause in listed[0] else 'among three'
    return 'wrong and certain' if 'certain' in named[0] else 'wrong, not certain'


def of_two(named, cause, other):
    """Return whether both causes are named, or at least none is certain alone."""
    if all(any(own in word for word in named) for own in (cause, other)):
        return 'right'
    if 'certain' not in named[0]:
        return 'neither certain'
    return ('one of two' if any(own in named[0] for own in (cause, other)) else
            'wrong and certain')


def unnamed(laboratory, verdict, found, said):
    """Return the judgement of a result without a named cause."""
    if verdict.refusals or found is None:
        return 'refused without a cause' if verdict.refusals else 'not named before the fit', said
    std = np.diag(found.stiffness_std)
    off = np.abs(np.diag(found.stiffness) - laboratory.K)
    wrong = np.isfinite(std) & (off > 5.0 * std) & (off > 0.02 * laboratory.K)
    return ('silent and wrong' if wrong.any() else 'silent'), (
        f'K {np.round(100.0 * off / laboratory.K, 1).tolist()} %, chi^2 {found.chi2:.3g}')


def two_of(kinds, seed):
    """Return two kinds of faults that have different causes."""
    rng = np.random.default_rng((12, seed))
    kinds = [name for name in kinds if FAULTS[name][1] != SOUND]
    while True:
        names = rng.choice(kinds, 2, replace=False).tolist()
        if FAULTS[names[0]][1] != FAULTS[names[1]][1]:
            return names


def main():
    """Print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('--seeds', type=int, default=1, help='recordings of each kind')
    parser.add_argument('--pairs', type=int, default=1, help='recordings with two faults')
    parser.add_argument('--sound', type=int, default=1, help='sound recordings')
    parser.add_argument('--first', type=int, default=100, help='seed')
    parser.add_argument('--seconds', type=float, default=12.0, help='length of recordings')
    parser.add_argument('--coloured', action='store_true',
                        help='noise with a memory of 26 ms in all, not in every second sound one')
    parser.add_argument('--camera', type=float, default=0.0, help='rate of the package, Hz')
    parser.add_argument('--kinds', nargs='*', choices=FAULTS, default=list(FAULTS))
    arguments = parser.parse_args()
    work = []
    for number in range(max(arguments.seeds, arguments.pairs, arguments.sound)):
        seed = arguments.first + number
        if number < arguments.seeds:
            work += [('fault', [name], seed) for name in arguments.kinds]
        if number < arguments.pairs:
            work.append(('pair', two_of(arguments.kinds, seed), seed))
        if number < arguments.sound:
            work.append((SOUND, [], seed))
    counts = {}
    for group, names, seed in work:
        laboratory = Laboratory(
            seed, coloured=arguments.coloured or (group == SOUND and seed % 2 == 1),
            seconds=arguments.seconds)
        laboratory.camera_hz = arguments.camera or laboratory.camera_hz
        for name in names:
            FAULTS[name][0](laboratory)
        began = time.process_time()
        word, said = outcome(laboratory, *([FAULTS[name][1] for name in names] or [SOUND]))
        counts.setdefault(group, Counter())[word] += 1
        print(f'{" and ".join(names) or SOUND} {seed}: {word} ({said}; '
              f'{time.process_time() - began:.0f} s)', flush=True)
    for group, words in counts.items():
        print(f'{group}: {dict(words)}')


if __name__ == '__main__':
    main()
