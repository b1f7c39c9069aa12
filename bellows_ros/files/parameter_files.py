"""
Parameter files: YAML in the form of ROS, read and written.

Accepted forms are `/**:`, a node's name or its full name above `ros__parameters:`, and files
without either; names may be nested or dotted. ROS reads written files unchanged: every double has
a decimal point.
"""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
import textwrap
from typing import Any

from bellows_ros.core.model.cup_package import TERMS
from bellows_ros.core.parameters.checks import validate
from bellows_ros.core.parameters.table import lookup, Parameter, PARAMETERS, Value
from bellows_ros.core.signals.residuals import AXES
from bellows_ros.errors import BellowsError, require_types
from bellows_ros.files import File, safe_yaml
from bellows_ros.files.atomic import write_text

NODES = ('identifier', 'predictor')
_SECTION = 'ros__parameters'
_INDENT = '    '
_ROW = 6  # items of a list on one line
_TO_FILL_IN = "SET THESE where they apply: remove the '#', and change the example."

# Units of the rows of K and P as comments: of linear and of angular rows.
_ROW_UNITS = {term.parameter: (', '.join(term.units[:2]), ', '.join(term.units[1:]))
              for term in TERMS.values() if term.is_matrix}


def read_parameters(path: File, node: str | None = None) -> dict[str, Value]:
    """
    Read a parameter file.

    Parameters
    ----------
    path : path
        YAML file.
    node : str, optional
        Node 'identifier' or 'predictor': the parameters that ROS gives to a node of this name,
        later values over earlier ones. Default: the parameters of both nodes, without
        contradictions.

    Returns
    -------
    dict
        Values by dotted name, checked, in the normal form of `checks.validate`, without the
        parameters of every ROS node, such as use_sim_time.

    Raises
    ------
    BellowsError
        With file and line: unreadable, not YAML, an unknown name, or an invalid value.

    Examples
    --------
    >>> bellows_ros.read_parameters('bags/package.yaml')['package.com']
    (0.0, 0.0, -0.03)

    """
    if node not in (None, *NODES):
        raise BellowsError(f"node is '{node}'; expected {' or '.join(NODES)}.")
    file = Path(path)
    content = safe_yaml.load_names(file)
    values: dict[str, Value] = {}
    for keys, section in _sections(file, content, node):
        for name, value, where in _flattened(section, keys):
            if name in ('use_sim_time', 'start_type_description_service') or (
                    name.startswith('qos_overrides.')):
                continue
            try:
                checked = validate(name, value)
            except BellowsError as error:
                raise BellowsError(f'{content.where(where)}{error}') from None
            if node is None and values.get(name, checked) != checked:
                raise BellowsError(
                    f"{content.where(where)}'{name}' is given before with another value. "
                    'Keep one.')
            values[name] = checked
    return values


def write_parameters(path: File, values: Mapping[str, Any], header: Sequence[str] = ()) -> None:
    """
    Write a parameter file for all ROS nodes (--params-file), whole or not at all.

    Parameters
    ----------
    path : path
        YAML file.
    values : mapping
        Values by dotted name, which are checked, and written in the order of the parameter table.
    header : sequence of str
        Comment lines at the top.

    Raises
    ------
    BellowsError
        If a value is invalid, or the file cannot be written; an existing file is then unchanged.

    Examples
    --------
    >>> bellows_ros.write_parameters(
    ...     folder / 'cell.yaml', {'recording.package_frame': 'lip'}, ['What I know of my cell'])
    >>> bellows_ros.read_parameters(folder / 'cell.yaml')
    {'recording.package_frame': 'lip'}

    """
    write_text(path, format_parameters(values, header))


def format_parameters(
    values: Mapping[str, Any], header: Sequence[str] = (), to_fill_in: Sequence[Parameter] = ()
) -> str:
    """Return the text of a parameter file; parameters to fill in are comments with an example."""
    for line in header:
        require_types(header=(line, str))
    checked = {name: validate(name, value) for name, value in values.items()}
    # A line break must not end a comment.
    plain = (''.join(c if c.isprintable() else ' ' for c in line) for line in header)
    lines = [*(f'# {line}'.rstrip() for line in plain), '/**:', f'  {_SECTION}:']
    if to_fill_in:
        lines.append(f'{_INDENT}# {_TO_FILL_IN}')
    for each in to_fill_in:
        lines += _entry(each, f'#{each.name}', f'{each.example or each.default}')
    for name in sorted(checked, key=[*PARAMETERS].index):
        if checked[name] != ():  # ROS has no empty lists
            lines += _entry(lookup(name), name, *_texts(checked[name]))
    if not (to_fill_in or any(value != () for value in checked.values())):
        lines.append(f'{_INDENT}{{}}')
    return '\n'.join(lines) + '\n'


def _sections(
    file: Path, content: Mapping[str, Any], node: str | None
) -> list[tuple[tuple[str, ...], Mapping[str, Any]]]:
    """Return the parts of a file for a node, with the keys that lead to each."""
    every = list(_ros_sections(content, ()))
    if not every:
        return [((), content)]
    wanted = (node,) if node else NODES
    chosen = [(keys, part) for keys, part in every
              if '/'.join(keys[:-1]).rpartition('/')[2] in ('**', '*', *wanted)]
    if not chosen:
        named = ', '.join('/'.join(keys[:-1]) for keys, _ in every)
        raise BellowsError(
            f"Parameter file '{file}' has nothing for {' or '.join(wanted)}, only for: {named}. "
            "Name the node, or write '/**:' for any.")
    for keys, part in chosen:
        if not isinstance(part, dict):
            raise BellowsError(
                f"Parameter file '{file}': {'/'.join(keys)} must hold 'name: value' lines.")
    return chosen


def _ros_sections(content: Mapping[str, Any], keys: tuple[str, ...]) -> Iterator[tuple[Any, Any]]:
    """Yield the content of each `ros__parameters`, with the keys that lead to it."""
    for key, value in content.items():
        if key == _SECTION:
            yield (*keys, key), value
        elif isinstance(value, dict):
            yield from _ros_sections(value, (*keys, str(key)))


def _flattened(
    part: Mapping[str, Any], keys: tuple[str, ...], prefix: str = ''
) -> Iterator[tuple[str, Any, tuple[str, ...]]]:
    """Yield the dotted names and values of nested mappings, with the keys that lead to each."""
    for key, value in part.items():
        where = (*keys, str(key))
        name = f'{prefix}{key}'
        if isinstance(value, dict):
            yield from _flattened(value, where, f'{name}.')
        else:
            yield name, value, where


def _entry(parameter: Parameter, name: str, *texts: str) -> Iterator[str]:
    """Yield the lines of one parameter: its description, its value, and units in every line."""
    for line in textwrap.wrap(parameter.description, 97 - len(_INDENT)):
        yield f'{_INDENT}# {line}'
    rows = _ROW_UNITS.get(name)
    for row, text in enumerate(texts):
        unit = f'{AXES[row]}: {rows[row // 3]}' if rows and len(texts) > 1 else parameter.unit
        start = f'{name}: ' if len(texts) == 1 else f'{name}:\n{_INDENT}  ' if row == 0 else '  '
        yield f'{_INDENT}{start}{text}' + (f'  # {unit}' if unit else '')


def _texts(value: Value) -> list[str]:
    """Return a value in YAML, a long list in lines of six items."""
    if not isinstance(value, tuple) or len(value) <= _ROW:
        return [_scalar(value)]
    texts = [_scalar(x) for x in value]
    width = max(map(len, texts))
    rows = [', '.join(text.rjust(width) for text in texts[start:start + _ROW])
            for start in range(0, len(texts), _ROW)]
    return [f'[{rows[0]},', *(f' {row},' for row in rows[1:-1]), f' {rows[-1]}]']


def _scalar(value: object) -> str:
    """Return a value in a form for every version of YAML: doubles with a decimal point."""
    if isinstance(value, tuple):
        return f'[{", ".join(map(_scalar, value))}]'
    if isinstance(value, str):
        if value.isprintable():
            return "'" + value.replace("'", "''") + "'"
        return '"' + ''.join(c if c.isprintable() and c not in '"\\' else f'\\U{ord(c):08x}'
                             for c in value) + '"'
    if isinstance(value, float):
        digits, e, exponent = repr(value).partition('e')
        point = '' if '.' in digits else '.0'
        return f'{digits}{point}{e}{exponent}'
    return str(value).lower()
