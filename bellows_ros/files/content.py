"""What is wrong with the content of a file that could be read, said with its name."""

from collections.abc import Iterator
from contextlib import contextmanager
import os

from bellows_ros.errors import BellowsError


@contextmanager
def content_of(*paths: str | os.PathLike[str]) -> Iterator[None]:
    """
    Say of results that hold something else than a fit writes which files they are.

    Raises
    ------
    BellowsError
        In place of what a missing key, another type or an impossible number causes.

    """
    try:
        yield
    except BellowsError as error:
        names = "' and '".join(os.fspath(path) for path in paths)
        raise type(error)(f"Of '{names}': {error}") from None
    except (ArithmeticError, AttributeError, LookupError, TypeError, ValueError) as error:
        names = "' or '".join(os.fspath(path) for path in paths)
        missing = isinstance(error, KeyError)
        what = f'{str(error)[:60]} is missing' if missing else f'{str(error)[:100]}'
        raise BellowsError(
            f"Result '{names}' is damaged, or was changed by hand: {what}. "
            "Make it again with 'bellows identify --json'."
        ) from None
