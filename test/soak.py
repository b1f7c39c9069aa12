"""
Run a predictor for minutes at 1 kHz over DDS, and measure its memory and its losses.

    python -m test.soak [--seconds 300] [--rate 1000]

Ends with 1 if a prediction was lost, or if the memory of the predictor grew by 1 MB or more after
its warm-up: a tenth of the time, and at least 20 s.
"""

import argparse
import math
import os
from pathlib import Path
import sys
import tempfile

from bellows_ros.demo import isolate
from benchmarks.live import NODES, PREDICTOR, process
from benchmarks.probe import Probe, used
import rclpy

RELIABLE = [
    word for topic in ('/tool_arm/pose', '/tool_arm/twist') for word in (
        '-p', f'qos_overrides.{topic}.subscription.reliability:=reliable',
        '-p', f'qos_overrides.{topic}.subscription.depth:=1000')
]
TURN = 10.0  # s
WARM_UP, SHORTEST_WARM_UP = 0.1, 20.0
LARGEST_GROWTH = 1_000_000


class Soak(Probe):
    """Counts answers that are not finite, or not newer than the one before."""

    wrong = last_ns = 0

    def _on_answer(self, message):
        super()._on_answer(message)
        stamp_ns, p = next(reversed(self.answered)), message.pose.position
        self.wrong += stamp_ns <= self.last_ns or not math.isfinite(p.x + p.y + p.z)
        self.last_ns = stamp_ns


def soak(seconds, rate, log):
    """Run, report, and return whether all is well."""
    rclpy.init(args=[])
    turns, base, sent, lost = max(1, round(seconds / TURN)), 0, 0, 0
    warm = math.ceil(max(SHORTEST_WARM_UP, WARM_UP * seconds) / TURN)
    with process((*NODES[PREDICTOR], *RELIABLE), os.environ, log) as pid:
        probe = Soak(rate, TURN)
        if not probe.connected():
            sys.exit(f'no answer: {log.read_text(errors="replace")[-400:]}')
        for turn in range(turns):
            probe.play(turn * TURN)
            sent, lost = sent + len(probe.sent), lost + len(probe.sent) - len(probe.answered)
            memory = used(pid)['memory']
            base = memory if turn < warm else base
            print(f'{(turn + 1) * TURN:5.0f} s  sent {sent}  lost {lost}  '
                  f'memory {memory / 1e6:.2f} MB', flush=True)
    rclpy.try_shutdown()
    print(f'sent {sent}, lost {lost}, not finite or out of order {probe.wrong}, memory grew by '
          f'{(memory - base) / 1e6:.3f} MB after {warm * TURN:.0f} s')
    return sent > 0 and lost == 0 and probe.wrong == 0 and memory - base < LARGEST_GROWTH


def main():
    """Read the command line and run."""
    parser = argparse.ArgumentParser(description=__doc__.strip().splitlines()[0])
    parser.add_argument('--seconds', type=float, default=300.0)
    parser.add_argument('--rate', type=float, default=1000.0)
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as logs:
        isolate(logs)
        return 0 if soak(given.seconds, given.rate, Path(logs) / 'predictor.log') else 1


if __name__ == '__main__':
    sys.exit(main())
