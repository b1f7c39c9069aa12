"""The pages: commands run or are checked, links lead somewhere, generated pages are current."""

import importlib.util
from pathlib import Path
import re
import shlex
import subprocess
import sys

from bellows_ros.cli import app
from bellows_ros.core.geometry.jit import COMPILED
from bellows_ros.core.parameters.table import PARAMETERS
import pytest

DOCS = Path(__file__).resolve().parents[1] / 'docs'


def load(name):
    """Import a script of docs/tools, which is no package."""
    spec = importlib.util.spec_from_file_location(name, DOCS / 'tools' / f'{name}.py')
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    spec.loader.exec_module(module)
    return module


PAGES = load('pages')
"""The script that knows the commands on the pages."""

ALL = {str(page.relative_to(PAGES.ROOT)): page for page in PAGES.pages()}
SLOW = ('output_error', 'tosses')
EXECUTABLES = ('predictor', 'identifier', 'bellows')


def with_mode(page, *modes):
    """Return the blocks of a page that are to be treated so."""
    return [block for block in PAGES.blocks(page.read_text()) if block.mode in modes]


def runnable():
    """Return the pages with commands that are run."""
    return [name for name, page in ALL.items() if with_mode(page, 'run', 'fails')]


@pytest.mark.lane
@pytest.mark.parametrize('name', runnable())
def test_commands_do_what_the_page_shows(name, tmp_path, user_environment):
    """Run a page's commands in order, from a checkout's bags and config."""
    pytest.importorskip('matplotlib', reason="no matplotlib here (pip install '.[plot]')")
    PAGES.make_folder(tmp_path)
    variables = PAGES.environment(user_environment)
    for block in with_mode(ALL[name], 'run', 'fails'):
        for number, command in enumerate(block.commands, 1):
            if not COMPILED and any(words in command.text for words in SLOW):
                continue  # takes minutes interpreted; run where numba is
            done = PAGES.run(command, tmp_path, variables)
            where = f'{name}, line {block.line}: {command.text}\n'
            failed = block.mode == 'fails' and number == len(block.commands)
            assert (done.returncode != 0) == failed, where + done.stdout
            assert 'Traceback' not in done.stdout, where + done.stdout
            if command.output is not None:
                assert PAGES.matches(command.output, done.stdout), where + done.stdout


def words(text):
    """Yield the words of each command in a line, without assignments and comments."""
    for part in re.split(r'&&|\|\||[;|\n]', text.replace('\\\n', ' ')):
        try:
            found = shlex.split(part, comments=True)
        except ValueError:
            continue
        while found and re.match(r'\w+=', found[0]):
            found = found[1:]
        if found:
            yield found


def checked():
    """Return all blocks of all pages, those that are run too."""
    return [
        pytest.param(block, id=f'{name}:{block.line}')
        for name, page in ALL.items() for block in PAGES.blocks(page.read_text())
    ]


@pytest.mark.parametrize('block', checked())
def test_commands_are_well_formed(block, root):
    """Hold no syntax errors, and name only what is there: commands, options, targets."""
    for command in block.commands:
        done = subprocess.run(
            ['bash', '-n', '-c', command.text], capture_output=True, text=True)
        assert done.returncode == 0, done.stderr
        for found in words(command.text):
            check_words(found, root)


def check_words(found, root):
    """Check one command, as far as it is of this package."""
    first, *rest = found
    if first == 'make':
        targets = re.findall(r'^([a-z-]+):', (root / 'Makefile').read_text(), re.MULTILINE)
        assert {word for word in rest if '=' not in word} <= set(targets), found
    elif found[:3] == ['ros2', 'run', 'bellows_ros']:
        check_words(found[3:], root)
    elif found[:3] == ['ros2', 'launch', 'bellows_ros']:
        assert (root / 'launch' / found[3]).is_file(), found
    elif found[:2] == ['ros2', 'param'] and found[2] in ('set', 'get', 'describe'):
        assert found[4] in PARAMETERS, found
    elif first == 'bellows':
        check_bellows(rest)
    elif first in EXECUTABLES:
        check_node(rest)


def check_bellows(rest):
    """Check a command line of `bellows` with its own parser."""
    if not rest or rest[0].startswith('-'):
        return
    command = app.commands[rest[0]]
    redirected = [i for i, word in enumerate(rest) if re.match(r'\d?[<>]', word)]
    arguments = rest[1:min(redirected, default=len(rest))]
    if '--help' not in arguments:
        command.make_context(rest[0], arguments)


def check_node(rest):
    """Check the parameters a node is given."""
    for option, value in zip(rest, rest[1:], strict=False):
        if option == '-p':
            name = value.partition(':=')[0]
            assert name in PARAMETERS or name.startswith(('qos_overrides.', 'use_sim_time')), value


def test_parameter_files_on_the_pages_are_right(tmp_path):
    """Read every YAML block with parameters as a node would."""
    from bellows_ros.files.parameter_files import read_parameters

    found, yaml = 0, re.compile(r'^```yaml\n(.*?)^```', re.DOTALL | re.MULTILINE)
    for page in ALL.values():
        for block in yaml.findall(page.read_text()):
            if 'ros__parameters' in block:
                (tmp_path / 'block.yaml').write_text(block)
                read_parameters(tmp_path / 'block.yaml')
                found += 1
    assert found > 0


LINK = re.compile(r'\]\(([^)\s]+)\)|(?:src|srcset)="([^"]+)"')


def anchors(page):
    """Return the anchors that GitHub and Sphinx make of a page's headings."""
    heads = re.findall(r'^#+ (.*)$', page.read_text(), re.MULTILINE)
    return {re.sub(r'[^\w\- ]', '', head.lower()).replace(' ', '-') for head in heads}


@pytest.mark.parametrize('page', PAGES.pages(), ids=lambda page: page.name)
def test_links_lead_somewhere(page):
    """Find every file and heading that a page links to."""
    text = re.sub(r'```.*?```', '', page.read_text(), flags=re.DOTALL)
    for found in LINK.finditer(text):
        link = found[1] or found[2]
        if link.startswith(('http://', 'https://')):
            continue
        name, _, anchor = link.partition('#')
        target = (page.parent / name).resolve() if name else page
        assert target.exists(), link
        if anchor:
            assert anchor in anchors(target), link


def test_every_picture_is_shown(root):
    """Keep no picture that no page shows."""
    text = ''.join(page.read_text() for page in PAGES.pages())
    unused = [path.name for path in (root / 'docs' / 'images').iterdir()
              if path.name not in text]
    assert unused == []


@pytest.mark.parametrize('name', ['parameters.md', 'topics.md', 'commands.md', 'groups.pyi'])
def test_reference_is_current(name, root):
    """Say what the declarations say; `make reference` writes the pages."""
    reference = load('reference')
    assert reference.path_of(name).read_text() == reference.text_of(name), 'run: make reference'
