"""
Safe YAML: plain data, no duplicate or merge keys, bounded, errors with their line.

Aliases are refused where asked: ROS does not know them either, and nested ones grow without bound
when written out.
"""

from collections.abc import Hashable, Iterator, Mapping, Sequence
import json
from pathlib import Path
import re
from types import SimpleNamespace
from typing import Any

from bellows_ros.errors import BellowsError
from bellows_ros.files import read_text
import yaml

MAX_FILE_BYTES = 2**20
# Values and keys in a file; as many take some seconds.
MAX_VALUES = 50_000

Lines = dict[tuple[str, ...], int]


def _refused(why: str, at: Any) -> yaml.MarkedYAMLError:
    """Return the error for an event or a node."""
    return yaml.MarkedYAMLError(problem=why, problem_mark=at.start_mark)


class Content(dict[str, Any]):
    """The content of a YAML file, which knows where its keys stand."""

    def __init__(self, content: Mapping[str, Any], path: Path, lines: Lines) -> None:
        """Take a mapping, and the line of each key."""
        super().__init__(content)
        self._path, self._lines = path, lines

    def where(self, keys: Sequence[str]) -> str:
        """Return the file and the line of the innermost of some keys that is given."""
        lines = (self._lines.get(tuple(keys[:n])) for n in range(len(keys), 0, -1))
        line = next(filter(None, lines), None)
        return f'{self._path}, line {line}: ' if line else f'{self._path}: '


yaml.SafeDumper.add_representer(Content, yaml.SafeDumper.represent_dict)


class _Loader(yaml.SafeLoader):
    """PyYAML's safe loader, stricter."""

    aliases_allowed = False
    count = 0

    def compose_node(self, parent: yaml.Node | None, index: int) -> yaml.Node | None:
        """Refuse tags, aliases, and more values than anyone writes."""
        event = self.peek_event()  # type: ignore[no-untyped-call]
        self.count += 1
        if self.count > MAX_VALUES:
            raise _refused(
                f'more than {MAX_VALUES} values are not read; split the file, or record what '
                "is a message with 'ros2 bag record'", event)
        alias = isinstance(event, yaml.AliasEvent)
        if getattr(event, 'tag', None) or (alias and not self.aliases_allowed):
            reason = 'aliases (*name)' if alias else 'tags (!name)'
            raise _refused(f'{reason} are not allowed; write plain values', event)
        return super().compose_node(parent, index)

    def flatten_mapping(self, node: yaml.MappingNode) -> None:
        """Refuse merge keys."""
        for key, _ in node.value:
            if key.tag == 'tag:yaml.org,2002:merge':
                raise _refused('merge keys (<<) are not allowed', key)

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Hashable, Any]:
        """Refuse keys that are not plain or are given twice."""
        names: set[str] = set()
        for key, _ in node.value:
            if not isinstance(key, yaml.ScalarNode):
                raise _refused('a key must be a plain name', key)
            if key.value in names:
                raise _refused(f"key '{key.value[:80]}' is given twice", key)
            names.add(key.value)
        return super().construct_mapping(node, deep)


# As in ROS: 1e-05 is a number though YAML 1.1 wants a point in it; 2024-05-01 and 1:30 are texts.
_NUMBERS = {
    'int': r'[-+]?(0b[01_]+|0[0-7_]*|[1-9][0-9_]*|0x[0-9a-fA-F_]+)$',
    'float': r'[-+]?([0-9][0-9_]*\.[0-9_]*([eE][-+]?[0-9]+)?|\.[0-9][0-9_]*([eE][-+]?[0-9]+)?'
             r'|[0-9]+[eE][-+]?[0-9]+|\.(inf|Inf|INF))$|\.(nan|NaN|NAN)$'}
_OTHERWISE = {f'tag:yaml.org,2002:{name}' for name in (*_NUMBERS, 'timestamp')}
_Loader.yaml_implicit_resolvers = {
    first: [(tag, form) for tag, form in forms if tag not in _OTHERWISE]
    for first, forms in yaml.SafeLoader.yaml_implicit_resolvers.items()}
for _name, _form in _NUMBERS.items():
    _Loader.add_implicit_resolver(
        f'tag:yaml.org,2002:{_name}', re.compile(_form), list('-+.0123456789'))


def load(path: Path, aliases: bool = False) -> Any:
    """
    Return the content of a YAML file: dicts, lists, strings, numbers, booleans and None.

    A mapping is returned as `Content`, which knows no lines with aliases.

    Raises
    ------
    BellowsError
        If the file cannot be read, is too large, or is not the YAML described above.

    """
    return _parsed(_text(path, MAX_FILE_BYTES), path, aliases)


def load_records(path: Path, names: Sequence[str], largest: int) -> Any:
    """
    Return the content of a YAML file that may have a long list of records under one of some names.

    Records that differ in plain numbers alone, as the points of a plan do, are read some 50 times
    faster than other values, and have their parts as attributes. A file without them, or of other
    records, is read as by `load`.

    Raises
    ------
    BellowsError
        As `load`, for a file of more than `largest` bytes.

    """
    text = _text(path, largest)
    start = re.search(rf'^({"|".join(names)}): *\n( *- )', text, re.MULTILINE)
    if start:
        after = _NEXT_KEY.search(text, start.end())
        end = after.start() if after else len(text)
        records = _records(text[start.end():end].rstrip('\n').split('\n' + start[2]))
        if records:
            content = dict(_parsed(text[:start.end()] + '0\n' + text[end:], path, False))
            content[start[1]] = records
            return content
    if len(text) > MAX_FILE_BYTES:
        raise BellowsError(
            f'{path} is larger than {MAX_FILE_BYTES} bytes; expected so much only of '
            f'{" or ".join(names)} that differ in nothing but plain numbers. Give a recording of '
            "the message: 'ros2 bag record'.")
    return _parsed(text, path, False)


_NEXT_KEY = re.compile(r'^[^\s#-]', re.MULTILINE)
_NUMBER = r'(-?(?:0|[1-9]\d{0,18})(?:\.\d+)?(?:[eE][-+]?\d+)?)'
MAX_RECORD_LENGTH = 2**13
"""Characters."""


def _records(texts: Sequence[str]) -> list[Any]:
    """Return records that differ in their numbers alone, or nothing if they are not such."""
    if len(texts[0]) > MAX_RECORD_LENGTH:
        return []
    between = re.split(rf'(?<=[ ,\[]){_NUMBER}(?=[\s,\]}}]|\Z)', texts[0])[::2]
    marked = ''.join(f'{part}__{i}__' for i, part in enumerate(between))
    try:
        first = _Loader('- ' + marked.removesuffix(f'__{len(between) - 1}__')).get_single_data()
    except (yaml.YAMLError, ValueError, RecursionError):
        return []
    form = json.dumps(first[0]).replace('%', '%%')
    form, count = re.subn(r'"__\d+__"', '%s', form)
    if count != len(between) - 1:
        return []
    alike = re.compile(_NUMBER.join(map(re.escape, between)))
    matches = [alike.fullmatch(text) for text in texts]
    if None in matches:
        return []
    decode = json.JSONDecoder(object_hook=lambda part: SimpleNamespace(**part)).decode
    return [decode(form % each.groups()) for each in matches if each]


def _text(path: Path, largest: int) -> str:
    """Return the text of a file, without what ends a message that ROS prints."""
    return read_text(path, largest).removesuffix('---\n')


def _parsed(text: str, path: Path, aliases: bool) -> Any:
    """Return what `load` does, of a text in a file; with aliases no key knows its line."""
    try:
        loader = _Loader(text)
        loader.aliases_allowed = aliases  # in files that other programs write
        node = loader.get_single_node()
        if node is None:
            return None
        content = loader.construct_document(node)
        lines = {} if aliases else dict(_lines(node, ()))
        return Content(content, path, lines) if isinstance(content, dict) else content
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        line = f', line {mark.line + 1}' if mark else ''
        raise BellowsError(f'{path}{line}: not valid YAML here: {error.problem}.') from None
    except yaml.YAMLError as error:
        raise BellowsError(f'{path} is not valid YAML: {error}') from None
    except RecursionError:
        raise BellowsError(f'{path} is nested too deeply to be read.') from None
    except (ValueError, OverflowError) as error:  # what only looks like a number
        raise BellowsError(f'{path}: a value cannot be read: {error}.') from None


def _lines(node: yaml.Node, keys: tuple[str, ...]) -> Iterator[tuple[tuple[str, ...], int]]:
    """
    Yield the keys that lead to each value of nested mappings, with the line of the last.

    The mappings of a list are 'name[0]', 'name[1]' and so on.
    """
    if isinstance(node, yaml.MappingNode):
        for key, value in node.value:
            yield (*keys, key.value), key.start_mark.line + 1
            yield from _lines(value, (*keys, key.value))
    elif isinstance(node, yaml.SequenceNode) and keys:
        for i, value in enumerate(node.value):
            if isinstance(value, yaml.MappingNode):
                item = (*keys[:-1], f'{keys[-1]}[{i}]')
                yield item, value.start_mark.line + 1
                yield from _lines(value, item)
