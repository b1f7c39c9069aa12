"""
Find sentences that are hard to read: `make lint` calls this.

Docstrings, texts of constants and comments of the package, texts of its tables, and the pages are
searched for `PATTERNS`.
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
    pending: list[Any] = [tomllib.loads(file.read_text(encoding='utf-8'))]
    for value in pending:
        if isinstance(value, str):
            yield 0, value
        elif isinstance(value, dict | list):
            pending += value.values() if isinstance(value, dict) else value


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


if __name__ == '__main__':
    found = list(findings())
    print(*found, sep='\n', end='\n' * bool(found))
    sys.exit(bool(found))
