"""What the two storages of a rosbag2 recording, MCAP and SQLite, have in common."""

from collections.abc import Callable
from typing import NamedTuple

from bellows_ros.errors import BellowsError

# No record, chunk or message of a sound recording is larger; a damaged or hostile file may say it
# is.
LARGEST_RECORD = 256 * 2**20


class Topic(NamedTuple):
    """A recorded topic: its name, its type and the encoding of its messages."""

    name: str
    type_name: str
    encoding: str


class Message(NamedTuple):
    """A recorded message: the topic, the time it was recorded at in ns, and its bytes."""

    topic: Topic
    log_time_ns: int
    data: bytes


Wanted = Callable[[Topic], bool]


class DamagedError(BellowsError):
    """A damaged storage file; raised without its name, which the caller adds."""
