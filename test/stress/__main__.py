"""
Damage files, kill writers and fill disks, and say how it ended.

    python -m test.stress [--minutes 60] [--seed 1] [--only ROUND ...]

Ends with 1 on any traceback, hang, number that is not finite, or change that a checksum shows and
nobody reported. A failure names the options that make it again.
"""

import argparse
import sys
import time

from .frame import OUTCOMES, Tally, turn
from .rounds import ROUNDS


def main():
    """Make turns of every round until the time is over."""
    parser = argparse.ArgumentParser(prog='python -m test.stress')
    parser.add_argument('--minutes', type=float, default=60.0)
    parser.add_argument('--seed', type=int, default=1)
    parser.add_argument('--turn', type=int, help='this turn only, of each round')
    parser.add_argument('--only', nargs='+', choices=sorted(ROUNDS), default=list(ROUNDS))
    arguments = parser.parse_args()
    until = time.monotonic() + 60.0 * arguments.minutes
    tallies = {name: Tally() for name in arguments.only}
    number = arguments.turn or 0
    while time.monotonic() < until:
        for name, tally in tallies.items():
            turn(name, ROUNDS[name], (arguments.seed, number), tally, until)
        if arguments.turn is not None:
            break
        number += 1
    print(f'{"round":12}{"tried":>8}' + ''.join(f'{o:>9}' for o in (*OUTCOMES, 'failed')))
    for name, tally in tallies.items():
        counts = [*(tally.outcomes[outcome] for outcome in OUTCOMES), len(tally.failures)]
        print(f'{name:12}{tally.tried:8}' + ''.join(f'{count:9}' for count in counts))
    failures = [text for tally in tallies.values() for text in tally.failures]
    print(*failures, sep='\n')
    return 1 if failures or not all(tally.tried for tally in tallies.values()) else 0


if __name__ == '__main__':
    sys.exit(main())
