"""
Print the size of the tree: `make count`.

A line of code has a token that is no comment and no docstring, also none of a constant.
"""

from pathlib import Path
import sys
import tokenize

ROOT = Path(__file__).parents[2]
FREE = {tokenize.COMMENT, tokenize.NL, tokenize.NEWLINE, tokenize.INDENT, tokenize.DEDENT,
        tokenize.ENCODING, tokenize.ENDMARKER}


def code_lines(file: Path) -> int:
    """Return the number of lines of code of a file."""
    lines, statement = set[int](), []
    with file.open('rb') as stream:
        for token in tokenize.tokenize(stream.readline):
            if token.type not in FREE:
                statement.append(token)
            elif token.type == tokenize.NEWLINE:
                if [own.type for own in statement] != [tokenize.STRING]:
                    lines.update(line for own in statement
                                 for line in range(own.start[0], own.end[0] + 1))
                statement = []
    return len(lines)


def main() -> None:
    """Print lines of code, lines of the other files of the package, and words of the pages."""
    for name in sys.argv[1:] or ('bellows_ros', 'test', 'benchmarks'):
        files = sorted((ROOT / name).rglob('*.py'))
        print(f'{name:12} {sum(map(code_lines, files)):6} lines in {len(files):3} modules')
    others = [file for file in (ROOT / 'bellows_ros').rglob('*.*')
              if file.suffix not in ('.py', '.pyc')]
    lines = sum(len(file.read_text().splitlines()) for file in others)
    print(f'{"TOML, XML":12} {lines:6} lines in {len(others):3} files of the package')
    pages = [ROOT / 'README.md', *sorted((ROOT / 'docs').glob('*.md'))]
    for name, texts in (('pages', pages), ('changelog', [ROOT / 'CHANGELOG.rst'])):
        print(f'{name:12} {sum(len(text.read_text().split()) for text in texts):6} words')


if __name__ == '__main__':
    main()
