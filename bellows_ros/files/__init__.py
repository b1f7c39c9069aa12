"""Files in, core types out: recordings, parameter files and results."""

import os
from pathlib import Path

from bellows_ros.errors import BellowsError

File = str | os.PathLike[str]
"""Path of a file or folder."""


def read_text(path: File, largest: int, what: str = 'File') -> str:
    """
    Return the content of a text file in UTF-8 with a limited number of bytes.

    Raises
    ------
    BellowsError
        If the path is not a text file in UTF-8, or cannot be read; `what` is its name in the
        message.

    """
    file = Path(path)
    try:
        if not file.is_file():
            raise BellowsError(f"{what} '{path}' does not exist or is not a plain file.")
        if file.stat().st_size > largest:
            raise BellowsError(f"{what} '{path}' is larger than {largest} bytes.")
        return file.read_text(encoding='utf-8-sig')
    except UnicodeDecodeError as error:
        raise BellowsError(f"{what} '{path}' is not text in UTF-8: {error}.") from None
    except (OSError, ValueError) as error:
        raise BellowsError(f"{what} '{path}' cannot be read: {error}.") from None
