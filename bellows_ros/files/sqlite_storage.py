"""
Reading the messages of a rosbag2 SQLite file (.db3).

The database is opened read-only and immutable, its schema is not trusted, and the work done on it
is bounded by its size, so that a damaged or hostile file ends in an error and not in an endless
query.
"""

from collections.abc import Iterator
from contextlib import closing
import os
from pathlib import Path
import sqlite3

from bellows_ros.files.bag_folder import Batch, Channel, DamagedError, LARGEST_RECORD, Wanted

_HEADER = 100
_BATCH = 4096

# Steps of SQLite's machine: a sound file of N bytes is read in far fewer than these.
_STEPS_PER_BYTE = 10
_LEAST_STEPS = 10_000_000
_STEPS_BETWEEN_CHECKS = 100_000


def scan(path: Path, wanted: Wanted, counts: dict[Channel, int]) -> Iterator[list[Batch]]:
    """
    Yield the messages of the wanted topics, topic by topic, in the order they are stored in.

    In batches of some thousand.

    Parameters
    ----------
    path : Path
        Plain file.
    wanted : callable
        Topic to whether its messages are yielded.
    counts : dict
        Filled before the first message: every topic, with its number of messages.

    Raises
    ------
    DamagedError
        If the file is truncated or damaged, or its recording was not closed.

    """
    _require_closed(path)
    _require_whole(path)
    try:
        with closing(_connect(path)) as database:
            _require_plain(database)
            (verdict,) = database.execute('PRAGMA quick_check(1)').fetchone()
            if verdict != 'ok':  # its pages do not fit together: messages could be missing
                raise DamagedError(f'SQLite finds it damaged: {verdict!s:.200}')
            numbers = _topics(database, counts)
            for topic_id, topic in numbers.items():
                if wanted(topic):
                    yield from _messages(database, topic_id, topic)
    except (sqlite3.Error, OverflowError, UnicodeError) as error:
        raise DamagedError(f'SQLite cannot read it: {error}') from None


def _require_closed(path: Path) -> None:
    """Refuse a database whose last changes are still in a file beside it."""
    for suffix in ('-wal', '-journal'):
        beside = path.with_name(path.name + suffix)
        if beside.is_file() and beside.stat().st_size:
            raise DamagedError(
                f'its recording was not closed: {beside.name} holds what is not yet in it. '
                f"Run 'sqlite3 {path.name} .schema' in its folder once, which merges the two"
            )


def _require_whole(path: Path) -> None:
    """Refuse a file that ends within a page; SQLite would read the rest of it as zeros."""
    with path.open('rb') as file:
        header = file.read(_HEADER)
        size = file.seek(0, os.SEEK_END)
    if len(header) < _HEADER:
        raise DamagedError('it ends in the middle: it was truncated')
    page_size = int.from_bytes(header[16:18]) or 1
    page_size = 65536 if page_size == 1 else page_size  # as the format has it
    if size % page_size:
        raise DamagedError(
            f'it ends in the middle: {size} bytes are no whole pages of {page_size}')


def _require_plain(database: sqlite3.Connection) -> None:
    """
    Refuse a database whose content is computed, as by views.

    One step of SQLite's machine may then take any time: steps bound the work on stored values.
    """
    tables = "SELECT name, rootpage FROM sqlite_master WHERE type = 'table'"
    stored = dict(database.execute(tables))
    if not {'topics', 'messages'} <= stored.keys():
        raise DamagedError("it has no tables 'topics' and 'messages'")
    computed = [name for name, root in stored.items() if not root]  # a virtual table has none
    computed += [name for (name,) in database.execute(
        'SELECT t.name FROM sqlite_master AS t, pragma_table_xinfo(t.name) AS c '
        "WHERE t.type = 'table' AND c.hidden")]
    if computed:
        raise DamagedError(
            f"its table '{computed[0]:.40}' is computed, not stored, which no recorder does")


def _connect(path: Path) -> sqlite3.Connection:
    """Open a database that is neither changed nor trusted."""
    uri = f'{path.resolve().as_uri()}?mode=ro&immutable=1'
    database = sqlite3.connect(uri, uri=True)
    database.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, LARGEST_RECORD)
    database.execute('PRAGMA trusted_schema = OFF')
    database.execute('PRAGMA cell_size_check = ON')
    database.execute('PRAGMA ignore_check_constraints = ON')
    left = max(_LEAST_STEPS, path.stat().st_size * _STEPS_PER_BYTE)

    def count_down() -> bool:
        """Return True, which ends the query, once the steps are used up."""
        nonlocal left
        left -= _STEPS_BETWEEN_CHECKS
        return left < 0

    database.set_progress_handler(count_down, _STEPS_BETWEEN_CHECKS)
    return database


def _topics(database: sqlite3.Connection, counts: dict[Channel, int]) -> dict[int, Channel]:
    """Return the topics by number, and count their messages."""
    amounts = dict(database.execute('SELECT topic_id, COUNT(*) FROM messages GROUP BY topic_id'))
    numbers: dict[int, Channel] = {}
    for row in database.execute('SELECT id, name, type, serialization_format FROM topics'):
        if not isinstance(row[0], int) or not all(isinstance(x, str) for x in row[1:]):
            raise DamagedError("its table 'topics' is damaged")
        topic = numbers[row[0]] = Channel(*row[1:])
        counts[topic] = counts.get(topic, 0) + amounts.pop(row[0], 0)
    if amounts:
        raise DamagedError(f'{sum(amounts.values())} messages have a topic it does not list')
    return numbers


def _messages(
    database: sqlite3.Connection, topic_id: int, topic: Channel
) -> Iterator[list[Batch]]:
    """Yield the messages of one topic in batches."""
    rows = database.execute('SELECT timestamp, data FROM messages WHERE topic_id = ?', (topic_id,))
    while batch := rows.fetchmany(_BATCH):
        if not all(isinstance(time, int) and isinstance(data, bytes) for time, data in batch):
            raise DamagedError("its table 'messages' is damaged")
        yield [Batch.of(topic, *zip(*batch, strict=True))]
