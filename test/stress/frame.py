"""
What all rounds have in common: attempts that are counted, timed and judged.

A round is a generator: it takes a random generator and an empty folder, and yields the outcome of
each attempt. An exception other than what an attempt expects, an attempt that takes too long, and
whatever a round raises as `Failed` is a failure, which is reported with what makes it again.
"""

from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
import itertools
from pathlib import Path
import signal
import tempfile
import time
import traceback

from bellows_ros.errors import BellowsError
import numpy as np

REFUSED, CLEAN, COUNTED, SILENT = 'refused', 'clean', 'counted', 'silent'
"""Refused with a message; as if undamaged; with a loss reported; changed without a word."""

OUTCOMES = (REFUSED, CLEAN, COUNTED, SILENT)


MAX_MESSAGE = 3000


class Failed(AssertionError):
    """What must not happen, in words."""


class TookTooLong(BaseException):
    """An attempt that has not ended; nothing that is under test catches it."""


@dataclass(frozen=True)
class Round:
    """
    A kind of attempts.

    Parameters
    ----------
    run : callable
        From a random generator and an empty folder to the outcomes of attempts.
    patience : float
        How long one may take, s.
    short : int
        How many the suite makes.

    """

    run: Callable[[np.random.Generator, Path], Iterator[str]]
    patience: float = 20.0
    short: int = 40


@dataclass
class Tally:
    """How the attempts of a round ended."""

    outcomes: Counter[str] = field(default_factory=Counter)
    failures: list[str] = field(default_factory=list)

    @property
    def tried(self):
        """All attempts."""
        return sum(self.outcomes.values()) + len(self.failures)


def turn(name, round_, seed, tally, until, most=None):
    """Make the attempts of one turn until they, the time or the number of them is used up."""
    rng = np.random.default_rng(seed)
    before = tally.tried
    with tempfile.TemporaryDirectory(prefix='bellows_stress_') as folder:
        attempts = round_.run(rng, Path(folder))
        for number in itertools.count():
            if number == most or time.monotonic() > until:
                return
            try:
                with _limited(round_.patience):
                    outcome = next(attempts, None)
            except (Exception, TookTooLong):  # noqa: BLE001
                where = f'--only {name} --seed {seed[0]} --turn {seed[1]}, attempt {number}'
                tally.failures.append(f'{where}:\n{traceback.format_exc(limit=-6)}')
                return
            if outcome is None:
                if tally.tried == before:
                    tally.failures.append(f'{name} made no attempt')
                return
            tally.outcomes[outcome] += 1


def judged(named, work, *arguments):
    """Return the outcome of some work; a refusal must name something, in words one can read."""
    try:
        return work(*arguments)
    except BellowsError as error:
        if not 10 < len(str(error)) < MAX_MESSAGE or named not in str(error):
            raise Failed(f'a message of {len(str(error))} characters: {error}'[:400]) from error
        return REFUSED


@contextmanager
def _limited(seconds):
    """End what takes longer."""
    def end(*_):
        raise TookTooLong(f'{seconds:g} s were not enough')

    handler = signal.signal(signal.SIGALRM, end)
    left, _ = signal.setitimer(signal.ITIMER_REAL, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, left)
        signal.signal(signal.SIGALRM, handler)


def damaged(rng, whole):
    """Return bytes with a few bits turned, a block overwritten, lost, doubled or cut off."""
    data = bytearray(whole)
    at, size = int(rng.integers(len(data))), int(rng.integers(1, 400))
    kind = rng.integers(7)
    if kind <= 1:
        for place in rng.integers(len(data), size=1 if kind else rng.integers(2, 20)):
            data[place] ^= 1 << rng.integers(8)
    elif kind == 2:
        block = data[at:at + size]
        filling = (bytes(len(block)), b'\xff' * len(block), rng.bytes(len(block)))
        data[at:at + size] = filling[rng.integers(3)]
    elif kind == 3:
        del data[at:at + size]
    elif kind == 4:
        data[at:at] = data[at:at + size]
    elif kind == 5:
        del data[at:]
    else:
        data[at:at] = rng.bytes(size)
    return bytes(data)


TEXTS = (
    'nan', 'inf', '-inf', '1e999', '-1', '0', '9' * 400, '', "'", '"', '\0', '\x1b[2J', '[', '}',
    ':', ' ', '\n', '#', ',', '&a', '*a', '!!x', '1:30', 'true', 'null', '\u202e', '\U0001f600',
)


def scrambled(rng, text):
    """Return a text with words of it replaced, exchanged or left out."""
    if rng.random() < 0.3:
        return damaged(rng, text.encode()).decode(errors='replace')
    cells = text.split(' ') if ' ' in text else list(text)
    for _ in range(rng.integers(1, 4)):
        at = int(rng.integers(len(cells)))
        other = cells[rng.integers(len(cells))]
        cells[at] = str(rng.choice(TEXTS)) if rng.random() < 0.7 else other
    return ' '.join(cells)


VALUES = (
    None, True, -1, 0, 10**30, 1e308, -1e-320, '', [], {}, [[1.0]], {'a': None}, [1] * 500,
    'a' * 5000, 'sqlite3', 'zstd', 'FILE', '../..', '/etc/passwd', ['../bag.mcap'], *TEXTS[:3])


def replaced(rng, content):
    """Replace some value in nested content, or leave it out; return the content."""
    if not isinstance(content, dict | list) or not content or rng.random() < 0.1:
        return VALUES[rng.integers(len(VALUES))]
    keys = list(content) if isinstance(content, dict) else range(len(content))
    key = keys[rng.integers(len(keys))]
    if rng.random() < 0.1:
        del content[key]
    else:
        content[key] = replaced(rng, content[key])
    return content
