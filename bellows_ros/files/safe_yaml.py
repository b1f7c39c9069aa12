"""
Safe YAML: plain data, no tags, anchors, duplicate or merge keys, errors with their line.

Values are those of ROS: 1e-05 is a number, yes and on are true, 2024-05-01 and 1:30 are texts.
"""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from bellows_ros.errors import BellowsError, shown
from bellows_ros.files import read_text
from ruamel.yaml import YAML
from ruamel.yaml.error import MarkedYAMLError, YAMLError
from ruamel.yaml.events import (
    AliasEvent,
    MappingEndEvent,
    ScalarEvent,
    SequenceEndEvent,
    SequenceStartEvent,
    StreamEndEvent,
)

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
        value = _document(YAML(typ='safe').parse(text), content.lines)
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


def load_names(path: Path) -> Content:
    """Return the content of a YAML file of names and values; raise BellowsError for another."""
    content = load(path)
    if not isinstance(content, Content):
        raise BellowsError(f"'{path}' must hold 'name: value' lines, got "
                           f"{'nothing' if content is None else shown(repr(content), 60)}.")
    return content


def _document(events: Iterator[Any], lines: dict[tuple[str, ...], int]) -> Any:
    """Return the value of the only document in the events of a file, and add its lines."""
    next(events)  # the start of the file
    if isinstance(next(events), StreamEndEvent):
        return None
    value = _value(next(events), events, lines, ())
    next(events)  # the end of the document
    if not isinstance(other := next(events), StreamEndEvent):
        raise _refused('expected one document, got another document', other)
    return value


def _value(event: Any, events: Iterator[Any], lines: dict[tuple[str, ...], int],
           keys: tuple[str, ...]) -> Any:
    """Return the value that begins with an event, and add the lines of the keys in it."""
    if isinstance(event, AliasEvent) or event.anchor or event.tag:
        raise _refused('tags (!name), anchors (&name) and aliases (*name) are not allowed', event)
    if isinstance(event, ScalarEvent):
        return event.value if event.style else plain(event.value)
    if isinstance(event, SequenceStartEvent):
        return _items(events, lines, keys)
    return _members(events, lines, keys)


def _items(events: Iterator[Any], lines: dict[tuple[str, ...], int],
           keys: tuple[str, ...]) -> list[Any]:
    """Return the items of a sequence up to its end, and add their lines."""
    found, parent, last = list[Any](), keys[:-1], keys[-1] if keys else ''
    while not isinstance(event := next(events), SequenceEndEvent):
        own = (*parent, f'{last}[{len(found)}]')
        lines[own] = event.start_mark.line + 1
        found.append(_value(event, events, lines, own))
    return found


def _members(events: Iterator[Any], lines: dict[tuple[str, ...], int],
             keys: tuple[str, ...]) -> dict[Any, Any]:
    """Return the members of a mapping up to its end, and add their lines."""
    found = dict[Any, Any]()
    while not isinstance(key := next(events), MappingEndEvent):
        if not isinstance(key, ScalarEvent) or key.value == '<<' and not key.style:
            raise _refused('a key must be a plain name; merge keys (<<) are not allowed', key)
        name = _value(key, events, lines, keys)
        if name in found:
            raise _refused(f"key '{key.value[:80]}' is given twice", key)
        own = (*keys, key.value)
        lines[own] = key.start_mark.line + 1
        found[name] = _value(next(events), events, lines, own)
    return found


def _refused(why: str, event: Any) -> MarkedYAMLError:
    return MarkedYAMLError(problem=why, problem_mark=event.start_mark)


def plain(text: str) -> Any:
    """Return the value of a text without quotes."""
    if text[:1] in NUMERIC:
        with suppress(ValueError):
            return float(text) if '.' in text else int(text, base=0)
        with suppress(ValueError):
            return float(text.lower().replace('.inf', 'inf').replace('.nan', 'nan'))
    return _WORDS.get(text, text)
