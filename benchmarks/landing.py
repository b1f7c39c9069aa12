"""
What the live prediction of the landing costs the node, measured in turns in one run.

`python -m benchmarks.landing` prints the processor time per tool pose of the predictor without
`package.size`, and with it while `package/landing` is heard at 50 Hz, and their ratio.
"""

from pathlib import Path
import tempfile

import numpy as np

from .live import LANDING, measured, PREDICTOR

RATES, ROUNDS, SECONDS = (125, 500), 5, 5.0


def main() -> None:
    """Measure and print."""
    print('rate (Hz)  without (us)  with (us)  ratio of the medians, of each pair')
    with tempfile.TemporaryDirectory() as folder:
        for rate in RATES:
            pairs = 1e6 * np.array([
                [run['processor_seconds'] / run['answered'] for run in (
                    measured(name, rate, SECONDS, True, Path(folder))
                    for name in (PREDICTOR, LANDING))]
                for _ in range(ROUNDS)])
            without, with_ = np.median(pairs, axis=0)
            each = ', '.join(f'{ratio:.3f}' for ratio in pairs[:, 1] / pairs[:, 0])
            print(f'{rate:9}  {without:12.1f}  {with_:9.1f}  {with_ / without:.3f}  ({each})')


if __name__ == '__main__':
    main()
