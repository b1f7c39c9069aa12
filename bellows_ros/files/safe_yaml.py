"""
Safe YAML: plain data, no tags, anchors, duplicate or merge keys, errors with their line.

Values are those of ROS: 1e-05 is a number, yes and on are true, 2024-05-01 and 1:30 are texts.
"""

from collections.abc import Mapping, Sequence
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any

from bellows_ros.errors import BellowsError
from bellows_ros.files import read_text
from ruamel.yaml import YAML
from ruamel.yaml.error import MarkedYAMLError, YAMLError

MAX_FILE_BYTES = 2**28
NUMERIC = frozenset('-+.0123456789')
"""First characters of numbers."""

_WORDS: dict[str, bool | None] = {
    form: value for value, words in ((None, ('', '~', 'null')), (True, ('true', 'yes', 'on')),
                                     (False, ('false', 'no', 'off')))
    for word in words for form in (word, word.capitalize(), word.upper())}


class Content(dict[str, Any]):
    """The content of a YAML file, with the lines of its keys."""

    def __init__(self, path: Path) -> None:
        self._path, self.lines = path, dict[tuple[str, ...], int]()

    def where(self, keys: Sequence[str]) -> str:
        """Return the file and the line of the innermost given key."""
        lines = (self.lines.get(tuple(keys[:n])) for n in range(len(keys), 0, -1))
        line = next(filter(None, lines), None)
        return f'{self._path}, line {line}: ' if line else f'{self._path}: '


def load(path: Path) -> Any:
    """
    Return the content of a YAML file: dicts, lists, strings, numbers, booleans and None.

    A mapping is returned as `Content`.

    Raises
    ------
    BellowsError
        If the file cannot be read, is too large, has several documents, or is not safe YAML.

    """
    text = read_text(path, MAX_FILE_BYTES).removesuffix('---\n')  # end of a printed message
    content = Content(path)
    try:
        node = YAML(typ='safe').compose(text)
        value = _value(node, text, content.lines, ()) if node else None
    except MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        line = f', line {mark.line + 1}' if mark else ''
        raise BellowsError(f'{path}{line}: not valid YAML here: {error.problem}.') from None
    except (YAMLError, RecursionError, ValueError) as error:
        raise BellowsError(f'{path} is not valid YAML: {error}') from None
    if isinstance(value, Mapping):
        content.update(value)
        return content
    return value


def _value(node: Any, text: str, lines: dict[tuple[str, ...], int], keys: tuple[str, ...]) -> Any:
    """Return the value of a node, and add the lines of the keys in it."""
    if text[node.start_mark.index:node.start_mark.index + 1] in ('&', '!'):
        raise _refused('tags (!name) and anchors (&name) are not allowed', node)
    if node.id == 'scalar':
        return node.value if node.style else plain(node.value)
    if node.id == 'sequence':
        parent, last = keys[:-1], keys[-1] if keys else ''
        for number, item in enumerate(node.value):
            lines[*parent, f'{last}[{number}]'] = item.start_mark.line + 1
        return [_value(item, text, lines, (*parent, f'{last}[{number}]'))
                for number, item in enumerate(node.value)]
    found: dict[Any, Any] = {}
    for key, item in node.value:
        if key.id != 'scalar' or key.value == '<<' and not key.style:
            raise _refused('a key must be a plain name; merge keys (<<) are not allowed', key)
        name = _value(key, text, lines, keys)
        if name in found:
            raise _refused(f"key '{key.value[:80]}' is given twice", key)
        inner = (*keys, key.value)
        lines[inner] = key.start_mark.line + 1
        found[name] = _value(item, text, lines, inner)
    return found


def _refused(why: str, node: Any) -> MarkedYAMLError:
    return MarkedYAMLError(problem=why, problem_mark=node.start_mark)


def plain(text: str) -> Any:
    """Return the value of a text without quotes."""
    if text[:1] in NUMERIC:
        number = text.lower().replace('.inf', 'inf').replace('.nan', 'nan')
        for kind in (partial(int, base=0), float):
            with suppress(ValueError):
                return kind(number)
    return _WORDS.get(text, text)
