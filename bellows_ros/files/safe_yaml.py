"""
Safe YAML: plain data, no tags, duplicate or merge keys, bounded depth, errors with their line.

The values are built from the events of libyaml, in one pass without recursion. Aliases are
optionally rejected: ROS does not support them, and nested ones grow without bound in output.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
import re
from typing import Any

from bellows_ros.errors import BellowsError
from bellows_ros.files import read_text
import yaml

MAX_FILE_BYTES = 2**28
MAX_DEPTH = 50
"""Largest number of nested lists and mappings."""
MAX_ALIASES = 10_000
_LOADER = getattr(yaml, 'CSafeLoader', yaml.SafeLoader)
"""Ten times faster in C, where PyYAML was built with libyaml."""

_CONTENT = yaml.ScalarEvent, yaml.CollectionStartEvent, yaml.CollectionEndEvent, yaml.AliasEvent

Lines = dict[tuple[str, ...], int]


def _refused(why: str, at: Any) -> yaml.MarkedYAMLError:
    return yaml.MarkedYAMLError(problem=why, problem_mark=at.start_mark)


class Content(dict[str, Any]):
    """The content of a YAML file, with the lines of its keys."""

    def __init__(self, content: Mapping[str, Any], path: Path, lines: Lines) -> None:
        super().__init__(content)
        self._path, self._lines = path, lines

    def where(self, keys: Sequence[str]) -> str:
        """Return the file and the line of the innermost given key."""
        lines = (self._lines.get(tuple(keys[:n])) for n in range(len(keys), 0, -1))
        line = next(filter(None, lines), None)
        return f'{self._path}, line {line}: ' if line else f'{self._path}: '


yaml.SafeDumper.add_representer(Content, yaml.SafeDumper.represent_dict)


def load(path: Path, aliases: bool = False) -> Any:
    """
    Return the content of a YAML file: dicts, lists, strings, numbers, booleans and None.

    A mapping is returned as `Content`.

    Raises
    ------
    BellowsError
        If the file cannot be read, is too large, has several documents, or is not safe YAML.

    """
    documents = load_all(path, aliases, most=1)
    return documents[0] if documents else None


def load_all(path: Path, aliases: bool = False, most: int = 10_000) -> list[Any]:
    """Return all documents of a YAML file, as printed messages are; see `load`."""
    text = read_text(path, MAX_FILE_BYTES).removesuffix('---\n')  # end of a printed message
    found, builder = list[Any](), _Builder(aliases)
    try:
        for event in yaml.parse(text, _LOADER):
            if isinstance(event, _CONTENT):
                builder.add(event)
            elif isinstance(event, yaml.DocumentStartEvent):
                if len(found) == most:
                    raise _refused(f'more than {most} documents (---)', event)
                builder = _Builder(aliases)
            elif isinstance(event, yaml.DocumentEndEvent):
                content = builder.content
                found.append(Content(content, path, builder.lines) if isinstance(
                    content, dict) else content)
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        line = f', line {mark.line + 1}' if mark else ''
        raise BellowsError(f'{path}{line}: not valid YAML here: {error.problem}.') from None
    except yaml.YAMLError as error:
        raise BellowsError(f'{path} is not valid YAML: {error}') from None
    except (ValueError, OverflowError) as error:  # similar to a number
        raise BellowsError(f'{path}: a value cannot be read: {error}.') from None
    return found


class _Builder:
    """
    The values of one document, built from its events.

    Attributes
    ----------
    content : object
        The document, once it is complete.
    lines : dict
        Line of each key of nested mappings, by the keys that lead to it; mappings of a list are
        'name[0]', 'name[1]' and so on.

    """

    def __init__(self, aliases: bool) -> None:
        self.content: Any = None
        self.lines: Lines = {}
        self._aliases = MAX_ALIASES if aliases else 0
        self._anchors: dict[str, Any] = {}
        # Open lists and mappings: the value, its anchor, the keys to it, and the key in a mapping.
        self._open: list[list[Any]] = []

    def add(self, event: Any) -> None:
        """Take a scalar, an alias, or the start or end of a list or mapping."""
        if isinstance(event, yaml.ScalarEvent):
            self._check(event)
            if not self._is_key(event):
                self._put(_scalar(event), event)
        elif isinstance(event, yaml.CollectionStartEvent):
            self._check(event)
            if len(self._open) == MAX_DEPTH:
                raise _refused(f'more than {MAX_DEPTH} lists and mappings in each other', event)
            self._require_no_key(event)
            is_list = isinstance(event, yaml.SequenceStartEvent)
            self._open.append([[] if is_list else {}, event.anchor, self._keys(event), _NO_KEY])
        elif isinstance(event, yaml.CollectionEndEvent):
            value, anchor, _, _ = self._open.pop()
            self._put(value, event, anchor)
        else:
            self._require_no_key(event)
            self._aliases -= 1
            if self._aliases < 0:
                raise _refused('aliases (*name) are not allowed; write plain values', event)
            if event.anchor not in self._anchors:
                raise _refused(f"alias '*{event.anchor}' has no complete value", event)
            self._put(self._anchors[event.anchor], event)

    def _check(self, event: Any) -> None:
        """Raise for a tag."""
        if event.tag:
            raise _refused('tags (!name) are not allowed; write plain values', event)

    def _is_key(self, event: Any) -> bool:
        """Store a scalar as the key of the innermost mapping, if a key is expected."""
        if not self._open or isinstance(self._open[-1][0], list) or (
                self._open[-1][3] is not _NO_KEY):
            return False
        mapping, _, keys, _ = self._open[-1]
        if event.implicit[0] and event.value == '<<':
            raise _refused('merge keys (<<) are not allowed', event)
        key = _scalar(event)
        if key in mapping:
            raise _refused(f"key '{event.value[:80]}' is given twice", event)
        self._open[-1][3] = key
        self.lines[(*keys, event.value)] = event.start_mark.line + 1
        return True

    def _require_no_key(self, event: Any) -> None:
        """Raise for a key that is no scalar."""
        if self._open and isinstance(self._open[-1][0], dict) and self._open[-1][3] is _NO_KEY:
            raise _refused('a key must be a plain name', event)

    def _keys(self, event: Any) -> tuple[str, ...]:
        """Return the keys on the path to a new list or mapping."""
        if not self._open:
            return ()
        value, _, keys, key = self._open[-1]
        if isinstance(value, dict):
            return (*keys, str(key))
        if not keys or isinstance(event, yaml.SequenceStartEvent):
            return ()
        item = (*keys[:-1], f'{keys[-1]}[{len(value)}]')
        self.lines[item] = event.start_mark.line + 1
        return item

    def _put(self, value: Any, event: Any, anchor: str | None = None) -> None:
        """Put a value into the innermost list or mapping."""
        if anchor := anchor or getattr(event, 'anchor', None):
            self._anchors[anchor] = value
        if not self._open:
            self.content = value
        elif isinstance(self._open[-1][0], list):
            self._open[-1][0].append(value)
        else:
            self._open[-1][0][self._open[-1][3]] = value
            self._open[-1][3] = _NO_KEY


_NO_KEY = object()

# As in ROS, 1e-05 is a number, although YAML 1.1 requires a point; 2024-05-01 and 1:30 are texts.
_INTEGER = re.compile(r'[-+]?(?:0b[01_]+|0[0-7_]*|[1-9][0-9_]*|0x[0-9a-fA-F_]+)$')
_FLOAT = re.compile(
    r'[-+]?(?:[0-9][0-9_]*\.[0-9_]*(?:[eE][-+]?[0-9]+)?|\.[0-9][0-9_]*(?:[eE][-+]?[0-9]+)?'
    r'|[0-9]+[eE][-+]?[0-9]+|\.(?:inf|Inf|INF))$|\.(?:nan|NaN|NAN)$')
_WORDS: dict[str, bool | None] = {form: value for word, value in {
    '~': None, '': None, 'null': None, **yaml.SafeLoader.bool_values}.items()
    for form in (word, word.capitalize(), word.upper())}


def _scalar(event: Any) -> Any:
    """Return the value of a scalar."""
    text = event.value
    if not event.implicit[0]:  # quoted, or of several lines
        return text
    if text[:1] in _NUMERIC:
        if _INTEGER.match(text):
            digits = text.replace('_', '').lstrip('+-')
            base = {'0b': 2, '0x': 16}.get(digits[:2], 8 if digits[:1] == '0' else 10)
            return (-1 if text[0] == '-' else 1) * int(digits, base)
        if _FLOAT.match(text):
            return float(text.replace('_', '').lower().replace('.inf', 'inf').replace(
                '.nan', 'nan'))
    return _WORDS.get(text, text)


_NUMERIC = frozenset('-+.0123456789')
