"""
Find sentences that are hard to read: `make lint` calls this, `--list` shows each of them.

Docstrings, texts of constants and comments of the package, texts of its tables, and the pages are
searched for `PATTERNS`. More than `MOST` findings fail: lower the number as they become fewer.
"""

import ast
from collections.abc import Iterator
import io
from pathlib import Path
import re
import sys
import tokenize
import tomllib
from typing import Any

ROOT = Path(__file__).resolve().parents[2]

MOST = 0
"""Number of findings that are left; none may be added."""

PATTERNS = {
    name: re.compile(pattern) for name, pattern in {
        'a clause as the beginning': r'(?:^|[.:;] )(?:What|Where|Whatever)\b(?!.*\?)',
        'a text without a head': r'^Of (?!course)',
        'a pronoun without a noun': r'\b(?:that|those) of\b|\bthe same[.,;:]',
        'a clause for a noun':
            r'\bwhat (?:is|was|were|are|has|have|it|they|he|this|that|no|a|the)\b|\bwhatever\b',
        'an everyday word': r'\bstart(?:s|ed)? afresh\b|\bBy so (?:much|many)\b|\bis told\b',
    }.items()}
"""Patterns by what is hard to read about them."""


def python_texts(file: Path) -> Iterator[tuple[int, str]]:
    """Yield line and text of the docstrings, constants' texts and comments of a module."""
    source = file.read_text(encoding='utf-8')
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(
                node.value.value, str):
            line = node.lineno
            for part in re.split(r'\n\s*\n|\n[^\n]* : [^\n]*\n', node.value.value):
                yield line, part
                line += part.count('\n') + 2
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if token.type == tokenize.COMMENT and not token.string.startswith(('# type', '# noqa')):
            yield token.start[0], token.string.lstrip('# ')


def table_texts(file: Path) -> Iterator[tuple[int, str]]:
    """Yield the texts of a table."""
    def inside(value: Any) -> Iterator[str]:
        if isinstance(value, str):
            yield value
        elif isinstance(value, dict | list):
            for item in value.values() if isinstance(value, dict) else value:
                yield from inside(item)

    for text in inside(tomllib.loads(file.read_text(encoding='utf-8'))):
        yield 0, text


def page_texts(file: Path) -> Iterator[tuple[int, str]]:
    """Yield the lines of a page outside of code."""
    is_code = False
    for number, line in enumerate(file.read_text(encoding='utf-8').splitlines(), 1):
        is_code ^= line.startswith('```')
        if not is_code and not line.startswith(('```', '<!--', '#')):
            yield number, re.sub('`[^`]*`', 'X', line)


def findings() -> Iterator[str]:
    """Yield place, kind and text of each finding."""
    sources = [
        *((file, python_texts) for file in sorted((ROOT / 'bellows_ros').rglob('*.py'))),
        *((file, table_texts) for file in sorted((ROOT / 'bellows_ros').rglob('*.toml'))),
        *((file, page_texts) for file in [
            ROOT / 'README.md', *sorted((ROOT / 'docs').glob('*.md'))])]
    for file, texts in sources:
        for line, raw in texts(file):
            text = ' '.join(raw.split())
            for kind, pattern in PATTERNS.items():
                for match in pattern.finditer(text):
                    yield f'{file.relative_to(ROOT)}:{line}: {kind}: {text[match.start():][:70]}'


def main() -> int:
    """Count the findings; return 1 if there are more than before."""
    found = list(findings())
    is_more = len(found) > MOST
    if is_more or '--list' in sys.argv:
        print(*found, f'{len(found)} sentences are hard to read; {MOST} may be left', sep='\n')
    return int(is_more)


if __name__ == '__main__':
    sys.exit(main())
