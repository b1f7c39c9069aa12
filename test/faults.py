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

from bellows_ros.core.identification.methods import fit
from bellows_ros.errors import BellowsError
from bellows_ros.workflows.verdict import verdict_of
import numpy as np

from .core.identification.hypotheses.laboratory import FAULTS, Laboratory, parameters

SOUND = 'sound'


def outcome(laboratory, cause, other=''):
    """
    Return what is said first of a laboratory in a word, and all that is said.

    Of two causes both are named, or neither is certain.
    """
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
        named = [own for own in (cause, other) if own and own in str(error)]
        return ('refused otherwise', 'one of two' if other else 'right', 'right')[len(named)], (
            str(error)[:90])
    named = [f'{own.name} {own.value} {own.instead} {"certain" if own.certain else "perhaps"}'
             for own in verdict.diagnosis.findings]
    said = '; '.join([*named, *verdict.refusals])[:200]
    if other and named:
        both = [any(own in word for word in named) for own in (cause, other)]
        if all(both) or 'certain' not in named[0]:
            return ('right' if all(both) else 'neither certain'), said
        return ('one of two' if any(own in named[0] for own in (cause, other)) else
                'wrong and certain'), said
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
            seed, coloured=group == SOUND and seed % 2 == 1, seconds=arguments.seconds)
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
