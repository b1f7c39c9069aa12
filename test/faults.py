"""
Count which faults of recordings are named first.

    python -m test.faults --seeds 2 --kinds length mass

Every fault is put into simulated recordings of a laboratory of its own: cup, package, noise and
motion. What `bellows identify` says of them first is counted: the cause, another one (certain or
not), or nothing; where nothing is refused, K is compared with the truth: beyond 5 standard errors
and 2 % it is wrong and silent. Sound recordings of white and of correlated noise are to be kept.
"""

import argparse
from collections import Counter
import time

from bellows_ros.core.identification.methods import fit
from bellows_ros.core.parameters.checks import resolve
from bellows_ros.errors import BellowsError
from bellows_ros.workflows.verdict import verdict_of
import numpy as np

from .core.identification.hypotheses.laboratory import FAULTS, Laboratory

SOUND = 'sound'


def parameters(laboratory):
    """Return the parameters that are said of a laboratory."""
    said = laboratory.said
    return resolve({
        'cup.length': laboratory.said_length, 'fit.method': 'output_error',
        'fit.structure': 'axisymmetric', 'recording.package_frame': laboratory.said_frame,
        'recording.world': laboratory.said_world, 'package.mass': said.mass,
        'package.com': said.com.tolist(),
        'package.inertia': said.inertia[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]].tolist()})


def outcome(laboratory, cause):
    """Return what is said first of a laboratory in a word, and all that is said."""
    try:
        recordings = laboratory.recordings()
        warned = ' '.join(own for one in recordings for own in one.report.warnings)
        values = parameters(laboratory)
        length = values['cup.length']
        verdict, found = verdict_of(None, recordings, length, values), None
        if not verdict.refusals:
            found = fit(recordings, values).fit
            verdict = verdict_of(found, recordings, length, values)
    except BellowsError as error:
        return ('right' if cause in str(error) else 'refused otherwise'), str(error)[:90]
    named = [f'{own.name} {own.value} {own.instead} {"certain" if own.certain else "perhaps"}'
             for own in verdict.diagnosis.findings]
    said = '; '.join([*named, *verdict.refusals])[:200]
    if cause == SOUND:
        if verdict.refusals or 'does not return' in warned:
            return 'refused', f'{said} {warned}'
        return 'right', said
    if verdict.cause and cause in named[0]:
        return 'right', said
    if verdict.cause and verdict.diagnosis.findings:
        return ('wrong and certain' if 'certain' in named[0] else 'wrong, not certain'), said
    if verdict.refusals or found is None:
        return 'refused without a cause', said
    std = np.diag(found.stiffness_std)
    off = np.abs(np.diag(found.stiffness) - laboratory.K)
    wrong = np.isfinite(std) & (off > 5.0 * std) & (off > 0.02 * laboratory.K)
    return ('silent and wrong' if wrong.any() else 'silent'), (
        f'K {np.round(100.0 * off / laboratory.K, 1).tolist()} %, chi^2 {found.chi2:.3g}')


def main():
    """Print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('--seeds', type=int, default=1, help='recordings of each kind')
    parser.add_argument('--sound', type=int, default=1, help='sound recordings')
    parser.add_argument('--first', type=int, default=100, help='seed')
    parser.add_argument('--kinds', nargs='*', choices=FAULTS, default=list(FAULTS))
    arguments = parser.parse_args()
    faults, sound = Counter(), Counter()
    work = [(name, number) for name in arguments.kinds for number in range(arguments.seeds)]
    work += [(SOUND, number) for number in range(arguments.sound)]
    for name, number in work:
        seed = arguments.first + number
        laboratory = Laboratory(seed, coloured=name == SOUND and number % 2 == 1)
        break_it, cause = FAULTS.get(name, (lambda own: None, SOUND))
        break_it(laboratory)
        began = time.process_time()
        word, said = outcome(laboratory, cause)
        (sound if name == SOUND else faults)[word] += 1
        print(f'{name} {seed}: {word} ({said}; {time.process_time() - began:.0f} s)', flush=True)
    print(f'faults: {dict(faults)}; sound: {dict(sound)}')


if __name__ == '__main__':
    main()
