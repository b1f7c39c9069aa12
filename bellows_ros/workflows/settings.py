"""Parameters of a run, from files and from the texts of a command line."""

from collections.abc import Iterable, Mapping
from typing import Any

from bellows_ros.core.parameters import checks, table
from bellows_ros.errors import BellowsError
from bellows_ros.files import File, safe_yaml
from bellows_ros.files.parameter_files import read_parameters

INPUTS = ('bags', 'package.files')
"""Parameters that name input files."""


def settings_of(
    files: Iterable[File], overrides: Iterable[str] = (), options: Mapping[str, str] | None = None,
    node: str | None = None,
) -> dict[str, Any]:
    """
    Return the parameters of files, overridden by texts.

    Parameters
    ----------
    files : iterable of path
        Parameter files; later ones override earlier ones.
    overrides : iterable of str
        Texts 'name=value' of --set.
    options : mapping of str to str
        Other options, each with its text 'name=value'; an empty value is not set.
    node : str, optional
        Node whose part of a file is used.

    Raises
    ------
    BellowsError
        If a file cannot be read, or a name or value is invalid.

    """
    values: dict[str, Any] = {}
    for file in files:
        values.update(read_parameters(file, node))
    return values | dict(map(parse_override, overrides)) | dict(
        parse_override(text, option) for option, text in (options or {}).items()
        if not text.endswith('='))


def inputs_of(values: Mapping[str, Any]) -> list[str]:
    """Return the input files that parameters name."""
    return [file for name in INPUTS for file in values.get(name, ())]


def parse_override(text: str, option: str = '') -> tuple[str, Any]:
    """
    Return name and checked value of 'name=value', from --set or another option.

    Lists are written as in YAML or without brackets: `package.com=[0, 0, -0.03]` or
    `package.com=0,0,-0.03`.

    Raises
    ------
    BellowsError
        If there is no '=', or name or value are invalid.

    """
    name, equals, value = (part.strip() for part in text.partition('='))
    if not (name and equals):
        raise BellowsError(
            f"--set takes NAME=VALUE, got '{text}'. For example: --set fit.structure=full")
    try:
        parameter = table.lookup(name)
        return parameter.name, checks.validate(name, _parsed(parameter.kind, value))
    except BellowsError as error:
        raise BellowsError(f'{option or f"--set {name}"}: {error}') from None


def _parsed(kind: str, text: str) -> object:
    """Return a value of a parameter's kind, or the text itself if invalid."""
    one = kind.removesuffix('_array')
    if one != kind:
        items = text.removeprefix('[').removesuffix(']')
        return [_parsed(one, item.strip()) for item in (
            items if one == 'string' else items.replace(' ', ',')).split(',') if item.strip()]
    if kind != 'string':
        return safe_yaml.plain(text)
    return text[1:-1] if len(text) >= 2 and text[0] == text[-1] and text[0] in '\'"' else text
