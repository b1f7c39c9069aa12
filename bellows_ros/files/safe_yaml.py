"""
Safe YAML: plain data, no duplicate or merge keys, bounded, errors with their line.

Aliases are optionally rejected: ROS does not support them, and nested ones grow without bound in
output.
"""

from collections.abc import Hashable, Iterator, Mapping, Sequence
from pathlib import Path
import re
from typing import Any

from bellows_ros.errors import BellowsError
from bellows_ros.files import read_text
import yaml

MAX_FILE_BYTES = 2**20
# Largest number of values and keys in a file, which takes some seconds.
MAX_VALUES = 50_000

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


class _Loader(yaml.SafeLoader):
    """PyYAML's safe loader, stricter."""

    aliases_allowed = False
    count = 0

    def compose_node(self, parent: yaml.Node | None, index: int) -> yaml.Node | None:
        """Raise for tags, aliases, and too many values."""
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
        """Raise for merge keys."""
        for key, _ in node.value:
            if key.tag == 'tag:yaml.org,2002:merge':
                raise _refused('merge keys (<<) are not allowed', key)

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Hashable, Any]:
        """Raise for keys that are not plain or are given twice."""
        names: set[str] = set()
        for key, _ in node.value:
            if not isinstance(key, yaml.ScalarNode):
                raise _refused('a key must be a plain name', key)
            if key.value in names:
                raise _refused(f"key '{key.value[:80]}' is given twice", key)
            names.add(key.value)
        return super().construct_mapping(node, deep)


# As in ROS, 1e-05 is a number, although YAML 1.1 requires a point; 2024-05-01 and 1:30 are texts.
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

    A mapping is returned as `Content`, without lines if aliases are allowed.

    Raises
    ------
    BellowsError
        If the file cannot be read, is too large, or is not safe YAML.

    """
    text = read_text(path, MAX_FILE_BYTES).removesuffix('---\n')  # end of a printed message
    try:
        loader = _Loader(text)
        loader.aliases_allowed = aliases  # in files of other programs
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
    except (ValueError, OverflowError) as error:  # similar to a number
        raise BellowsError(f'{path}: a value cannot be read: {error}.') from None


def _lines(node: yaml.Node, keys: tuple[str, ...]) -> Iterator[tuple[tuple[str, ...], int]]:
    """
    Yield the keys that lead to each value of nested mappings, with the line of the last key.

    Mappings of a list are 'name[0]', 'name[1]' and so on.
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
