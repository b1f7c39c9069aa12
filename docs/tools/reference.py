"""
Write the reference pages from what the program itself declares; `make reference`.

Parameters come from the one table, topics from the node, commands from their functions,
so that no page can say something else than the program does. The stub with the types of the
parameters makes a wrong name an error of mypy.
"""

from collections.abc import Callable, Iterator, Mapping
import inspect
from pathlib import Path
import re
import sys

from bellows_ros.cli import app
from bellows_ros.core.parameters.table import Parameter, PARAMETERS
from bellows_ros.exits import EXIT_CODES
from bellows_ros.files.atomic import write_text
from bellows_ros.nodes.command import interface
import click

ROOT = Path(__file__).resolve().parents[2]
FOLDER = ROOT / 'docs' / 'reference'
STUB = ROOT / 'bellows_ros' / 'core' / 'parameters' / 'groups.pyi'
GENERATED = '<!-- Made by docs/tools/reference.py; change the declarations and run it again. -->'


def parameters() -> Iterator[str]:
    """Yield the lines of the page of parameters."""
    yield from (
        '# Parameters', '', GENERATED, '',
        'Of the nodes `identifier` and `predictor`, and of the command `bellows`: one table, so '
        'one file serves all three. `bellows parameters` prints it, `bellows parameters --yaml` '
        'writes a file to fill in, and `ros2 param describe` shows the same sentences.', '',
        'Units are SI. A 6x6 matrix is 36 numbers, row by row; translations x, y, z come first, '
        'then rotations x, y, z. In a parameter file for ROS every number of a real parameter '
        'has a decimal point.', '',
    )
    groups = dict.fromkeys(_group(name) for name in PARAMETERS)
    for group in groups:
        yield f'## {group}'
        yield ''
        yield '| name | unit | default | allowed | used by | meaning |'
        yield '|---|---|---|---|---|---|'
        for parameter in PARAMETERS.values():
            if _group(parameter.name) == group:
                yield _parameter(parameter)
        yield ''


def _group(name: str) -> str:
    """Return the heading a parameter stands under."""
    return name.partition('.')[0] if '.' in name else 'single ones'


def _parameter(parameter: Parameter) -> str:
    """Return the row of a parameter."""
    unit = f' ({parameter.unit})' if parameter.unit else ''
    allowed = parameter.constraint.removesuffix(unit)
    fixed = ' Cannot change while a node runs.' if parameter.read_only else ''
    users = ', '.join(parameter.used_by)
    return (f'| `{parameter.name}` | {parameter.unit} | {_default(parameter)} | {_cell(allowed)} '
            f'| {users} | {_cell(parameter.description)}{fixed} |')


def _default(parameter: Parameter) -> str:
    """Return a default in words."""
    if parameter.default is None:
        return 'must be given'
    if isinstance(parameter.default, tuple):
        return _list_default(parameter.name, parameter.default)
    if isinstance(parameter.default, bool):
        return f'`{str(parameter.default).lower()}`'
    if parameter.default == '':
        return "`''`"
    return f'`{parameter.default}`'


def _list_default(name: str, default: tuple[object, ...]) -> str:
    """Return the default of a list in words."""
    if name in ('cup.stiffness', 'cup.damping'):
        return 'from the thesis'
    if not default:
        return 'none'
    same = len(set(default)) == 1
    return f'`{default[0]}` each' if same else f'`{list(default)}`'


def _cell(text: str) -> str:
    """Return a text that does not end its cell, and that shows its stars."""
    return re.sub(r'([|*])', r'\\\1', text)


def topics() -> Iterator[str]:
    """Yield the lines of the page of topics."""
    yield from (
        '# Topics and services', '', GENERATED, '',
        'Of the node `predictor`. Names are relative: remap them with `-r FROM:=TO`, or put the '
        'node into a namespace.', '',
        '| name | type | meaning |', '|---|---|---|',
    )
    for topic in interface('predictor')['topics']:
        yield f"| `{topic['name']}` | {_cell(topic['type'])} | {_cell(topic['text'])} |"
    yield from (
        '',
        'As a lifecycle node it also has the services `~/change_state`, `~/get_state`, '
        '`~/get_available_states`, `~/get_available_transitions` and `~/get_transition_graph` '
        '(`lifecycle_msgs`), and publishes `~/transition_event`.', '',
        '## QoS', '',
        'Inputs are best effort with a queue of 500, which matches reliable and best-effort '
        'drivers alike; outputs are reliable with a queue of 500. Each can be overridden in a '
        'parameter file, under the resolved name of the topic:', '',
        '```yaml',
        '/predictor:',
        '  ros__parameters:',
        '    qos_overrides:',
        '      /tool_arm/pose:',
        '        subscription:',
        '          reliability: reliable',
        '          depth: 10',
        '```', '',
        '## Stamps', '',
        'All times are those of message headers. A prediction has the stamp and the frame of the '
        'tool pose it was made for. Pose and twist of one instant are paired by stamp, not by '
        'arrival.', '',
        'The node `identifier` has no topics: it reads recordings, and shows its result as its '
        'parameters `cup.stiffness` and `cup.damping`.', '',
    )


def commands() -> Iterator[str]:
    """Yield the lines of the page of commands."""
    yield from ('# Commands', '', GENERATED, '',
                'The work of the nodes from a shell, without ROS. Each command has `--help`; '
                '`eval "$(_BELLOWS_COMPLETE=bash_source bellows)"` completes commands, options '
                'and parameters in bash (`zsh_source` in zsh).', '')
    for name, command in app.commands.items():
        yield from (f'## bellows {name}', '')
        for paragraph in inspect.cleandoc((command.help or '').replace('\b\n', '')).split('\n\n'):
            head, _, lines = paragraph.partition('\n  ')
            yield from (head, '', *(('```text', inspect.cleandoc(f'  {lines}'), '```', '')
                                    if lines else ()))
        rows = [_argument(option) for option in command.params]
        yield from ('| argument | meaning |', '|---|---|', *filter(None, rows), '')
    yield from ('## Exit codes', '', '| code | meaning |', '|---|---|', *(
        f'| {code} | {meaning} |' for code, meaning in EXIT_CODES.items()))
    yield '| 141 | the reader of the output has closed it |'


def _argument(option: click.Parameter) -> str:
    """Return the row of an option; '' for a positional argument."""
    if not isinstance(option, click.Option):
        return ''
    value = option.metavar or '/'.join(getattr(option.type, 'choices', ()))
    name = f'{option.opts[0]} {value}'.strip()
    return f'| `{name}` | {_cell(option.help or "")} |'


TYPES = {
    'bool': 'bool', 'integer': 'int', 'double': 'float', 'string': 'str',
    'double_array': 'tuple[float, ...]', 'string_array': 'tuple[str, ...]'}
"""Python types of the kinds of parameters."""


def groups() -> Iterator[str]:
    """Yield the lines of the stub with the types of all parameters by attribute of `Values`."""
    types: dict[str, dict[str, str]] = {'': {}}  # type by attribute, by prefix of the names
    for name, parameter in PARAMETERS.items():
        *prefixes, leaf = name.split('.')
        for k, prefix in enumerate(prefixes):
            outer, inner = '.'.join(prefixes[:k]), '.'.join(prefixes[:k + 1])
            types[outer][prefix] = _class_of(inner)
            types.setdefault(inner, {})
        types['.'.join(prefixes)][leaf] = TYPES[parameter.kind]
    yield '# Made by docs/tools/reference.py from table.toml; run `make reference` again.'
    for prefix, attributes in reversed(types.items()):
        yield from ('', f'class {_class_of(prefix)}:')
        if not prefix:
            yield '    def __init__(self, prefix: str) -> None: ...'
        yield from (f'    {name}: {kind}' for name, kind in attributes.items())


def _class_of(prefix: str) -> str:
    """Return the class of the attributes with a prefix; `Groups` without one."""
    words = prefix.replace('.', '_').split('_')
    return ''.join(word.capitalize() for word in words) + 'Group' if prefix else 'Groups'


PAGES: Mapping[str, Callable[[], Iterator[str]]] = {
    'parameters.md': parameters,
    'topics.md': topics,
    'commands.md': commands,
    'groups.pyi': groups,
}


def path_of(name: str) -> Path:
    """Return the path of a page, or of the stub."""
    return STUB if name == STUB.name else FOLDER / name


def text_of(name: str) -> str:
    """Return the text of a page."""
    return '\n'.join(PAGES[name]()).rstrip() + '\n'


def main() -> None:
    """Write the pages that are named, or all."""
    FOLDER.mkdir(exist_ok=True)
    for name in sys.argv[1:] or PAGES:
        write_text(path_of(name), text_of(name))


if __name__ == '__main__':
    main()
