"""
Mutations of core: 40 one-line changes at random, and those that no mirrored test notices.

`python -m test.mutants --seed 7 --count 40 geometry toss`, or `make mutants`: lines of all rooms,
or of the named ones. A mutation changes a sign, halves
or doubles a number, or moves an index, in a copy of the package; the tests of the module's room
run until one fails. Mutations without a failure, or without an end in time, are printed with
their lines; the exit code is then 1.
"""

import argparse
import ast
import os
from pathlib import Path
import random
import shutil
import subprocess
import sys
import tempfile

ROOT = Path(__file__).parents[1]
CORE = Path('bellows_ros/core')

SECONDS = 900.0
"""Longest run of the tests of a mutation, s."""


def mutations(tree):
    """Yield the place (line, column, end column) of each mutation of a module, and its text."""
    parents = {child: node for node in ast.walk(tree) for child in ast.iter_child_nodes(node)}
    for node in ast.walk(tree):
        is_line = getattr(node, 'lineno', 0) == getattr(node, 'end_lineno', -1)
        if not is_line:
            continue
        if isinstance(node, ast.BinOp) and isinstance(node.op, ast.Add | ast.Sub):
            sign = '-' if isinstance(node.op, ast.Add) else '+'
            yield node, f'{ast.unparse(node.left)} {sign} ({ast.unparse(node.right)})'
        elif isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.USub):
            yield node, ast.unparse(node.operand)
        elif isinstance(node, ast.Constant) and type(node.value) is float and node.value:
            yield node, repr(2.0 * node.value)
            yield node, repr(0.5 * node.value)
        elif isinstance(node, ast.Constant) and type(node.value) is int and isinstance(
                parents[node], ast.Subscript) and parents[node].slice is node:
            yield node, repr(node.value - 1 if node.value > 0 else node.value + 1)


def is_text(path, node, parents):
    """Return whether a node stands in an annotation or a formatted text."""
    while node in parents:
        above = parents[node]
        if isinstance(above, ast.JoinedStr) or node in (
                getattr(above, 'annotation', None), getattr(above, 'returns', None)):
            return True
        if isinstance(above, ast.Raise):
            return True
        node = above
    return False


def drawn(count, seed, rooms):
    """Return mutations at random: file, line number, the line before and after."""
    found = []
    for path in sorted(path for room in rooms for path in (ROOT / CORE / room).rglob('*.py')):
        source = path.read_text()
        lines, tree = source.splitlines(), ast.parse(source)
        parents = {child: node for node in ast.walk(tree) for child in ast.iter_child_nodes(node)}
        for node, text in mutations(tree):
            if not is_text(path, node, parents):
                line = lines[node.lineno - 1]  # columns are in bytes: core has none but ASCII
                changed = line[:node.col_offset] + text + line[node.end_col_offset:]
                found.append((path.relative_to(ROOT), node.lineno, line, changed))
    return random.Random(seed).sample(found, count)


def tests_of(path):
    """Return the mirrored tests of a module, its own first."""
    room = Path('test/core') / path.relative_to(CORE).parent
    own = room / f'test_{path.stem}.py'
    return [str(each) for each in ([own] if (ROOT / own).exists() else []) + [room]]


def outcome(copy, path, number, changed, environment):
    """Return the outcome of the tests with a line of the copy changed; restore the line."""
    file = copy / path
    source = file.read_text()
    lines = source.splitlines(keepends=True)
    lines[number - 1] = changed + '\n'
    file.write_text(''.join(lines))
    try:
        done = subprocess.run(
            [sys.executable, '-m', 'pytest', '-q', '-x', '-p', 'no:cacheprovider',
             *tests_of(path)], cwd=copy, env=environment, capture_output=True, timeout=SECONDS,
            check=False)
        return 'noticed' if done.returncode else 'SURVIVED'
    except subprocess.TimeoutExpired:
        return 'TIMEOUT'
    finally:
        file.write_text(source)


def main(arguments=None):
    """Draw mutations, test each, and print the survivors."""
    parser = argparse.ArgumentParser(description=__doc__.split('\n\n')[0])
    parser.add_argument('--count', type=int, default=40)
    parser.add_argument('--seed', type=int, default=random.SystemRandom().randrange(10**6))
    parser.add_argument('rooms', nargs='*', default=['.'], help='rooms of core, all without')
    asked = parser.parse_args(arguments)
    print(f'seed {asked.seed}', flush=True)
    environment = {**os.environ, 'PYTHONDONTWRITEBYTECODE': '1', 'PYTHONPATH': ''}
    left = []
    with tempfile.TemporaryDirectory() as folder:
        copy = Path(folder) / 'copy'
        shutil.copytree(ROOT, copy, ignore=shutil.ignore_patterns('.git', '.venv', '.mypy_cache'))
        mutants = drawn(asked.count, asked.seed, asked.rooms)
        for number, (path, line, before, after) in enumerate(mutants, 1):
            word = outcome(copy, path, line, after, environment)
            print(f'{number:3} {word:8} {path}:{line}', flush=True)
            if word != 'noticed':
                left.append(f'{word} {path}:{line}\n  - {before.strip()}\n  + {after.strip()}')
    print(f'{len(left)} of {asked.count} unnoticed', *left, sep='\n')
    return bool(left)


if __name__ == '__main__':
    sys.exit(main())
