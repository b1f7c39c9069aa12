"""Common parts of the commands: order of the work, settings, checks of outputs."""

import argparse
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
import importlib
from itertools import permutations, product
import os
from pathlib import Path
import re
from typing import Any, NamedTuple

from bellows_ros.core.parameters import checks, table
from bellows_ros.errors import BellowsError
from bellows_ros.files import atomic, File, parameter_files, results
from bellows_ros.version import __version__

from .console import Binary, Console, Folder, NOT_USABLE, OK, Output, STDOUT


class Outcome(NamedTuple):
    """
    Result of a command.

    Parameters
    ----------
    result
        Result for `print_result` of the command's module; its `as_json()` is written to --json.
    succeeded : bool
        Whether the exit code is 0.
    then : tuple of str
        Next steps after a file was written.
    inputs : sequence of path or None
        Recordings and plans named in the JSON file with their digests, in addition to the
        parameter files; None if the result has no inputs, or names them itself.
    content : mapping or None
        Content for --json instead of the result.
    draw : str
        File for the picture of the result.

    """

    result: Any
    succeeded: bool = True
    then: tuple[str, ...] = ()
    inputs: Sequence[File] | None = None
    content: Mapping[str, Any] | None = None
    draw: str = ''


def run_command(arguments: argparse.Namespace, console: Console) -> int:
    """Check the outputs, work, write --json, print, name the written files; return the code."""
    require_named_outputs(arguments)
    console.warn(*_hard_links(arguments))
    require_drawable(arguments)
    command = importlib.import_module(f'{__package__}.{arguments.command.replace("-", "_")}')
    with console.progress, console.asking():
        done: Outcome = command.run(arguments, console)
        if done.draw:
            from bellows_ros import plots

            result = done.result[0] if isinstance(done.result, tuple) else done.result
            plots.write(done.draw, result)
        if getattr(arguments, 'json', None):
            content = done.content or {**results.plain(done.result), 'version': __version__}
            more: dict[str, Any] = {} if done.inputs is None else {
                'provenance': results.provenance(done.inputs, arguments.params)}
            if console.asked and 'warnings' in content:
                more['warnings'] = [*dict.fromkeys((*console.asked, *content['warnings']))]
            results.write_json(arguments.json, {**content, **more})
    written = [value for key, value in sorted(
        vars(arguments).items(), key=lambda item: item[0] == 'out') if isinstance(value, Output)]
    if STDOUT in written:
        console.keep_stdout_free()
    command.print_result(done.result, console)
    for line in *(f'Wrote {file}.' for file in written if file not in ('', STDOUT)), *done.then:
        console.line(line)
    console.warn(*console.final_warnings)
    return OK if done.succeeded else NOT_USABLE


def require_absent(output: str, force: bool) -> None:
    """Raise for an output that exists, unless it may be replaced."""
    if output and os.path.exists(output) and not force:
        raise BellowsError(
            f"Output '{output}' exists. Give another name, or replace it with --force; what it "
            'holds is then lost.')


def require_drawable(arguments: argparse.Namespace) -> None:
    """Raise for a name for --plot that is not the name of a picture."""
    if getattr(arguments, 'plot', ''):
        from bellows_ros import plots

        plots.require_ending(arguments.plot)


def read_settings(
    arguments: argparse.Namespace, node: str | None = None, cup_for: Console | None = None
) -> dict[str, table.Value]:
    """
    Return the parameters of the files, overridden by the command line.

    Parameters
    ----------
    arguments : Namespace
        Namespace with `params`, files of which later ones override earlier ones, and `overrides`,
        each 'name=value'; `tool_link`, if any, overrides both.
    node : str, optional
        Node whose part of a file is used.
    cup_for : Console, optional
        Console that warns at the end if there is no cup.

    Raises
    ------
    BellowsError
        If a file cannot be read, a name or value is invalid, or an output of the command line is
        also an input by a parameter.

    """
    values: dict[str, Any] = {}
    for file in arguments.params:
        values.update(parameter_files.read_parameters(file, node))
    values |= [parse_override(override) for override in arguments.overrides]
    values |= interval_settings(arguments)
    if link := getattr(arguments, 'tool_link', ''):
        values['tool_link'] = link
    require_named_outputs(arguments, inputs_of(values))
    if cup_for and 'cup.stiffness' not in values:
        cup_for.final_warnings.append(
            'cup.stiffness is not set: using the cup of the thesis, (4.78, 4.79).')
    return values


def inputs_of(values: Mapping[str, Any]) -> list[str]:
    """Return the input files that parameters name."""
    return [file for name in (
        'bags', 'validation.bags', 'static.bags', 'static.files', 'package.files')
        for file in values.get(name, ())]


def interval_settings(arguments: argparse.Namespace) -> dict[str, table.Value]:
    """Return the parameters that --from and --to set."""
    return dict(parse_override(f'{name}={text}', f'--{option}')
                for option, name in (('from', 'recording.start'), ('to', 'recording.end'))
                if (text := getattr(arguments, name, '')))


def parse_override(text: str, option: str = '') -> tuple[str, table.Value]:
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
    if kind == 'bool':
        return {'true': True, 'false': False}.get(text.lower(), text)
    if kind.endswith('_array'):
        kind = kind.removesuffix('_array')
        items = re.split(
            ',' if kind == 'string' else r'[,\s]+', text.removeprefix('[').removesuffix(']'))
        return [_parsed(kind, item.strip()) for item in items if item.strip()]
    if kind == 'string':
        quoted = len(text) >= 2 and text[0] == text[-1] and text[0] in '\'"'
        return text[1:-1] if quoted else text
    for number in (int, float):
        with suppress(ValueError):
            return number(text)
    return text


def _named(arguments: argparse.Namespace) -> tuple[list[Output], list[Path]]:
    """Return the outputs and the inputs of a command line."""
    named = [item for value in vars(arguments).values()
             for item in (value if isinstance(value, list) else [value])]
    return ([item for item in named if isinstance(item, Output)],
            [item for item in named if isinstance(item, Path)])


def _hard_links(arguments: argparse.Namespace) -> Iterator[str]:
    """Yield a sentence on each output that is an input by another name."""
    outputs, inputs = _named(arguments)
    for name, given in product(filter(os.path.isfile, outputs), inputs):
        with suppress(OSError, ValueError):  # of inputs, which are told where they are read
            for file in given.iterdir() if given.is_dir() else [given]:
                if os.path.samefile(name, file):
                    yield (f"Output '{name}' is a hard link of the input '{file}': it becomes a "
                           'file of its own, and the input stays as it is.')


def require_named_outputs(arguments: argparse.Namespace, inputs: Sequence[str] = ()) -> None:
    """
    Check every `Output` of a command line against all inputs, before any work.

    Raises
    ------
    BellowsError
        If a folder is missing, a path is not a file, two paths are equal, an output would replace
        an input or be inside one, or binary output is for stdout.

    """
    outputs, paths = _named(arguments)
    read: list[str | Path] = [*inputs, *paths]
    targets = list[Path]()
    files = [name for name in outputs if name not in ('', STDOUT)]
    to_stdout = [name for name in outputs if name == STDOUT]
    if any(isinstance(name, Binary) for name in to_stdout):
        raise BellowsError(
            f"'{STDOUT}' is stdout, which is for text, and this output is a recording or a binary "
            'file. Give it a name.')
    if len(to_stdout) > 1:
        raise BellowsError(
            f"{len(to_stdout)} outputs are '{STDOUT}', stdout, which has room for one. Give the "
            'others names.')
    for name in files:
        atomic.require_no_input(name, read)
        if isinstance(name, Folder) and os.path.isdir(name):
            require_absent(name, arguments.force)
        targets.append(Path(os.path.realpath(
            atomic.require_folder_target(name) if isinstance(name, Folder) else
            atomic.require_file_target(name))))
    for target, other in permutations(targets, 2):
        if target == other or other in target.parents:
            raise BellowsError(
                f"Two outputs have the same name, or one is in the other: '{target}'. Rename "
                'one.')
