"""The finding of a detector: a fact by its code, with level, numbers and the topic in question."""

from collections.abc import Mapping
from enum import IntEnum
from types import MappingProxyType
from typing import Any, NamedTuple


class Level(IntEnum):
    """Levels of REP-107, as in diagnostic_msgs/DiagnosticStatus."""

    OK = 0
    WARN = 1
    ERROR = 2


class Finding(NamedTuple):
    """
    A fact on a recording, a fit, a plan, or the live prediction.

    Parameters
    ----------
    code : str
        Key in `report/findings.toml`, which has the sentence, the remedy, and the use of the data
        that the fact prevents.
    level : Level
        Whether the fact is as intended, needs attention, or prevents a use.
    numbers : mapping
        Sizes in SI units, and names.
    topic : str
        Name of the topic or parameter in question, '' for none.

    """

    code: str
    level: Level = Level.WARN
    numbers: Mapping[str, Any] = MappingProxyType({})
    topic: str = ''
