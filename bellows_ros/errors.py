"""Errors with a message for the user, and the installation of missing optional packages."""

from collections.abc import Iterable
import importlib.util
from pathlib import Path
import sys
import sysconfig
from typing import Any

CRASHED = 70
"""Exit code after a defect of this package, EX_SOFTWARE of sysexits.h."""


class BellowsError(Exception):
    """
    An error that the user can correct; the message has the remedy.

    The message has the fact, the expectation, the value and the remedy. Commands and nodes print
    the message without a traceback and end with `exit_code`; any other exception is a defect of
    this package and keeps its traceback.

    Attributes
    ----------
    exit_code : int
        Exit code of the process: 2 for a mistake of the user, 1 for a negative answer.

    """

    exit_code = 2

    def __init__(self, message: str = '') -> None:
        """Escape foreign text in the message, except line breaks, and bound its length."""
        super().__init__(shown(message, MAX_MESSAGE, '\n'))


MAX_MESSAGE = 2500
"""Longest message of an error, characters: a screen."""


class UnitWarning(UserWarning):
    """A number passed to the library is likely in another unit."""


class UnstableError(BellowsError):
    """The package does not stay on its cup: there is no rest, or the prediction diverges."""


class NotSetError(BellowsError, AttributeError):
    """A parameter without a default is not given; also raised as an attribute of `Values`."""


class NoTopicError(BellowsError):
    """A recording lacks a topic, or the topic has another type."""


class UndeterminedError(BellowsError):
    """The recordings do not determine the unknown quantities."""

    exit_code = 1


class UnexplainedError(UndeterminedError):
    """No model explains the recordings."""


class NoLandingError(BellowsError):
    """A package is not released, is below the floor at its release, or never lands."""


class NoReleaseError(NoLandingError):
    """No release of a plan leads to a landing."""

    exit_code = 1


PACKAGES = {
    'fast': 'numba',
    'ros': "'ros-jazzy-rclpy[fastrtps]' ros-jazzy-common-interfaces",
    'plot': 'matplotlib',
    'dask': 'distributed'}


def install(extra: str) -> str:
    """
    Return the command that installs an extra in this Python.

    The Python of Ubuntu 24.04, which ROS uses, lacks pip, and accepts packages for a user only.
    The NumPy of Ubuntu must stay, because the SciPy of Ubuntu requires it.
    """
    marker = Path(sysconfig.get_path('stdlib'), 'EXTERNALLY-MANAGED')
    if sys.prefix != sys.base_prefix or not marker.exists():
        return f'pip install {PACKAGES[extra]}'
    return ('sudo apt-get install -y python3-pip && pip install --user --break-system-packages '
            f"{PACKAGES[extra]} 'numpy<2'")


def require_pictures() -> None:
    """Raise BellowsError if matplotlib is missing, before long work."""
    if importlib.util.find_spec('matplotlib') is None:
        raise BellowsError(f'matplotlib is not installed, but pictures need it: {install("plot")}')


def require_types(**arguments: tuple[Any, ...]) -> None:
    """Raise BellowsError for arguments of a wrong type, each a value with its allowed types."""
    for name, (value, *types) in arguments.items():
        if not isinstance(value, tuple(types)):
            expected = ' or '.join(each.__name__ for each in types)
            raise BellowsError(f'{name} must be of type {expected}, got {shown(value)}.')


MAX_NAME = 255
"""Longest name of a frame, joint or link, characters."""


def is_name(text: str) -> bool:
    """Return whether a text, possibly '', can be the name of a frame, joint or link in outputs."""
    return len(text) <= MAX_NAME and text.isprintable()


def require_names(names: Iterable[str], what: str) -> None:
    """Raise BellowsError for names of a kind with control characters, or too long ones."""
    for name in names:
        if not isinstance(name, str):
            raise TypeError(f'{name} as name of a frame or joint')
        if not is_name(name):
            raise BellowsError(
                f"A name of {what} is '{shown(name)}'; expected at most {MAX_NAME} printable "
                'characters. Rename it.')


def shown(text: object, length: int = 80, allowed: str = '') -> str:
    r"""
    Return foreign text, for example of a file, a message or a URDF, in a printable form.

    Parameters
    ----------
    text : object
        A string, or an object with a representation.
    length : int
        Largest number of characters of the result; a longer text ends with '...'.
    allowed : str
        Control characters to keep, such as a line break.

    Returns
    -------
    str
        All characters except printable and allowed ones are escaped, for example as \x1b, so that
        none controls a terminal, breaks a line of a log, or lacks an encoding.

    """
    text = text if isinstance(text, str) else repr(text)
    text = ''.join(
        c if c.isprintable() or c in allowed else c.encode('unicode_escape').decode()
        for c in text[:length + 1])
    return text if len(text) <= length else text[:length - 3] + '...'
