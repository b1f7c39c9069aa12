"""What looking ahead costs the node and takes: plans answered, the landing said, in pairs."""

from pathlib import Path
import tempfile
from typing import Any

import numpy as np

from .live import halves, measured, PLANS, PREDICTOR, TOSSING
from .probe import CYCLE, PLAN_LASTS

POINTS, RATE = 500, 500
"""Points per second of a plan; rate (Hz) of the tool's poses."""
PLAN_ROUNDS, PLAN_CYCLES, PLAN_PERIOD = 2, 15, 1
LANDING_ROUNDS, LANDING_RATES, LANDING_SECONDS = 7, (125, 500), 5.0


def run(short: bool) -> dict[str, Any]:
    """Return times of answers (s), and ratios of latencies and processor time."""
    with tempfile.TemporaryDirectory() as folder:
        return {'answers': _answers(Path(folder), short), 'landing': [
            _landing(Path(folder), rate, short) for rate in LANDING_RATES[short:]]}


def _answers(folder: Path, short: bool) -> dict[str, Any]:
    """Plans of 2 s, one in each period for half of each cycle, while poses come."""
    times: dict[str, list[float]] = {PLANS: [], PREDICTOR: []}
    pairs = []
    for _ in range(1 if short else PLAN_ROUNDS):
        for name, found in times.items():
            run = measured(name, RATE, (1 if short else PLAN_CYCLES) * CYCLE, True, folder,
                           f'plans,{PLAN_PERIOD},{POINTS},raw')
            found += run['plans']
            if name == PREDICTOR:
                pairs += halves(run, CYCLE, PLAN_LASTS - PLAN_PERIOD)
    return {
        'points': POINTS * PLAN_LASTS + 1, 'count': len(times[PREDICTOR]),
        **{name: np.percentile(found, [50.0, 99.0]).tolist() for name, found in times.items()},
        'ratios': np.median(pairs, axis=0).tolist(), 'pairs': len(pairs),
    }


def _landing(folder: Path, rate: int, short: bool) -> dict[str, Any]:
    """Compare the node that says where the package would land with one that knows of no toss."""
    rows = []
    for _ in range(1 if short else LANDING_ROUNDS):
        pair = []
        for name, heard in ((PREDICTOR, 'pose'), (TOSSING, 'landing')):
            run = measured(name, rate, LANDING_SECONDS, True, folder, heard)
            pair.append([*np.percentile(run['latency'], [50.0, 99.0]),
                         run['processor_seconds'] / run['answered']])
        rows.append(np.divide(pair[1], pair[0]))
    p50, p99, processor = np.median(rows, axis=0).tolist()
    return {'rate_hz': rate, 'pairs': len(rows), 'p50': p50, 'p99': p99, 'processor': processor}
