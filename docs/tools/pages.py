"""
The commands on the pages: found, run as a reader would run them, and their output compared.

A fenced block of the language `bash` holds commands; one of the language `console` holds commands
after `$ ` with what they print below, where a line `...` stands for any lines. Blocks of a page
are run one after the other in a folder that has `bags` and `config`. A comment before a block says
when that is not so:

    <!-- test: parse, REASON -->   only checked: a robot, ROS or an installation would be needed
    <!-- test: make -->            only checked: targets of the Makefile
    <!-- test: fails -->           the last command ends with an error, whose message is shown

Blocks that would install something, or reach for ROS, are only checked, with or without comment.

`python docs/tools/pages.py` runs all pages, or those it is given, and writes what the commands
print now into them, and the pictures that they draw into docs/images.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
import os
from pathlib import Path
import re
import shutil
import subprocess
import sys
import tempfile
import textwrap

ROOT = Path(__file__).resolve().parents[2]
MARK = re.compile(r'<!-- test: (\w+)')
FENCE = re.compile(r'^\s*```(\S*)\s*$')
NUMBER = re.compile(r'[-+]?\d+(?:\.\d+)?(?:[eE][-+]?\d+)?')
ANY = '...'
TIMEOUT = 100.0  # s, for one command
NEVER_RUN = ('apt', 'colcon', 'git', 'make', 'pip', 'ros2', 'rosdep', 'rviz2', 'sudo')
PRELUDE = 'set -o pipefail\n'


@dataclass(frozen=True)
class Command:
    """
    A command and what it prints.

    Parameters
    ----------
    text : str
        As typed, with continuation lines.
    output : str or None
        None where the page does not show any.
    first, last : int
        Lines of the page (from 0) that the output takes: `lines[first:last]`.

    """

    text: str
    output: str | None = None
    first: int = 0
    last: int = 0


@dataclass(frozen=True)
class Block:
    """
    A fenced block of commands.

    Parameters
    ----------
    line : int
        Of its first fence, from 1.
    mode : str
        'run', 'parse', 'make' or 'fails'.
    commands : tuple of Command

    """

    line: int
    mode: str
    commands: tuple[Command, ...]


def pages() -> list[Path]:
    """Return all pages, the README first."""
    return [ROOT / 'README.md', *sorted((ROOT / 'docs').rglob('*.md')),
            ROOT / 'bags' / 'README.md']


def blocks(text: str) -> list[Block]:
    """Return the blocks with commands on a page."""
    found, lines, mode, at = [], text.splitlines(), 'run', 0
    while at < len(lines):
        mark, fence = MARK.match(lines[at].strip()), FENCE.match(lines[at])
        if mark:
            mode = mark[1]
        elif fence:
            end = next(i for i in range(at + 1, len(lines)) if lines[i].strip() == '```')
            if fence[1] in ('bash', 'console'):
                read = _typed if fence[1] == 'bash' else _with_output
                commands = tuple(read(lines, at + 1, end))
                harmless = not any(_first_word(c.text) in NEVER_RUN for c in commands)
                safe = mode if harmless or mode == 'make' else 'parse'
                found.append(Block(at + 1, safe, commands))
            at, mode = end, 'run'
        elif lines[at].strip():
            mode = 'run'
        at += 1
    return found


def _first_word(text: str) -> str:
    """Return the first word of a command, or nothing."""
    return (text.split() or [''])[0]


def _typed(lines: Sequence[str], start: int, end: int) -> Iterator[Command]:
    """Yield the commands of a block without output."""
    at = start
    while at < end:
        text, at = _joined(lines, at)
        text = textwrap.dedent(text)
        if text.strip() and not text.lstrip().startswith('#'):
            yield Command(text)


def _with_output(lines: Sequence[str], start: int, end: int) -> Iterator[Command]:
    """Yield the commands of a block, each with the lines below it."""
    at = start
    while at < end:
        text, at = _joined(lines, at)
        first = at
        while at < end and not lines[at].startswith('$ '):
            at += 1
        yield Command(text.removeprefix('$ '), '\n'.join(lines[first:at]), first, at)


def _joined(lines: Sequence[str], at: int) -> tuple[str, int]:
    """Return a command with its continuation lines, and where the next line is."""
    typed = [lines[at]]
    while typed[-1].endswith('\\'):
        at += 1
        typed.append(lines[at])
    return '\n'.join(typed), at + 1


def matches(expected: str, got: str) -> bool:
    """
    Return whether an output is the one shown, but for numbers, blanks and lines left out.

    The line that announces the compiling comes once a version, with any command.
    """
    got = re.sub(r'(?m)^Compiling \(once a version\).*$', '', got)
    parts = [re.escape(_plain(part)) for part in re.split(r'(?m)^\.\.\.$', expected)]
    pattern = r'\s?.*?\s?'.join(parts)
    return re.fullmatch(pattern, _plain(got), re.DOTALL) is not None


def _plain(text: str) -> str:
    """Return a text with all numbers alike and single blanks."""
    return re.sub(r'\s+', ' ', NUMBER.sub('0', text)).strip()


def make_folder(folder: Path) -> None:
    """Put into a folder what a checkout has and the pages use."""
    for name in ('bags', 'config'):
        shutil.copytree(ROOT / name, folder / name)


def environment(base: Mapping[str, str]) -> dict[str, str]:
    """Return variables under which the commands of this Python come first."""
    path = os.pathsep.join([str(Path(sys.executable).parent), base.get('PATH', '')])
    return {**base, 'PATH': path, 'COLUMNS': '100', 'MPLBACKEND': 'Agg'}


def run(
    command: Command | str, folder: Path, variables: Mapping[str, str]
) -> 'subprocess.CompletedProcess[str]':
    """Run a command in a shell; its stdout has stderr in it, as on a terminal."""
    text = command if isinstance(command, str) else command.text
    return subprocess.run(
        ['bash', '-c', PRELUDE + text], cwd=folder, env=dict(variables), text=True,
        stdout=subprocess.PIPE, stderr=subprocess.STDOUT, stdin=subprocess.DEVNULL,
        timeout=TIMEOUT,
    )


def refresh(page: Path) -> bool:
    """Write what the commands of a page print now into it; return whether that changed it."""
    text = page.read_text()
    lines = text.splitlines()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        make_folder(folder)
        edits = []
        for block in blocks(text):
            for command in block.commands if block.mode in ('run', 'fails') else ():
                done = run(command, folder, environment(os.environ))
                if (done.returncode != 0) != (block.mode == 'fails'):
                    sys.exit(f'{page}: {command.text}\nends with {done.returncode}\n{done.stdout}')
                if command.output is not None and not _shortened(command.output):
                    edits.append((command.first, command.last, done.stdout.rstrip().splitlines()))
        for picture in (ROOT / 'docs' / 'images').iterdir():
            if (folder / picture.name).exists():
                shutil.copy(folder / picture.name, picture)
    for first, last, output in reversed(edits):
        lines[first:last] = output + [''] * _blank_end(lines, first, last)
    new = '\n'.join(lines) + '\n'
    page.write_text(new)
    return new != text


def _shortened(output: str) -> bool:
    """Return whether a shown output has been shortened by hand."""
    return ANY in output.splitlines()


def _blank_end(lines: Sequence[str], first: int, last: int) -> int:
    """Return 1 where an output shown is followed by an empty line before the next command."""
    return int(last > first and not lines[last - 1].strip())


def main() -> None:
    """Refresh the pages that are named, or all."""
    for page in [Path(name).resolve() for name in sys.argv[1:]] or pages():
        if refresh(page):
            print(f'changed {page.relative_to(ROOT)}')


if __name__ == '__main__':
    main()
