"""What holds for all commands: help, wrong lines, values, completion, streams, signals."""

from contextlib import suppress
import os
import re
import signal
import subprocess
import sys
import time

from bellows_ros.cli import app
from bellows_ros.core.geometry import jit
from bellows_ros.errors import BellowsError
from bellows_ros.exits import guarded
from bellows_ros.files.atomic import PREFIX
from bellows_ros.report.console import Console
from bellows_ros.report.text import column, with_error
from bellows_ros.workflows.identify import signals_deferred
from bellows_ros.workflows.settings import parse_override
import pytest

from .conftest import contents, MOTION, write_yaml

HEAVY = ('numpy', 'scipy', 'numba', 'matplotlib', 'rosbags', 'ruamel', 'rclpy', 'rich')
WITHIN = 600.0  # s, for what comes at once on a machine that is not busy


def run(environment, *arguments, **more):
    """Run `bellows` as a process of its own."""
    return subprocess.run(
        [sys.executable, '-m', 'bellows_ros.cli', *map(str, arguments)], text=True,
        capture_output=True, env={**environment, **more}, stdin=subprocess.DEVNULL)


@pytest.mark.parametrize('columns', [80, 120])
def test_help_teaches(succeed, columns, user_environment):
    """Each command says what it does, gives examples, and where to read on; nothing is cut."""
    top = run(user_environment, '--help', COLUMNS=str(columns)).stdout
    for name, command in app.commands.items():
        assert command.get_short_help_str(200) in top and not command.short_help
        done = succeed(name, '--help', quiet=True)
        assert f'Usage: bellows {name}' in done.stdout and 'Read on: docs/' in done.stdout
        assert f'\n    bellows {name} ' in done.stdout.partition('For example:')[2]
        assert ('Exit code 1: ' in done.stdout) == (name in ('identify', 'plan', 'replay', 'toss'))
        assert '--json' in done.stdout and max(map(len, done.stdout.splitlines())) < 100
    assert '  130  interrupted' in top and '...' not in top.replace('[ARGS]...', '')


def test_a_command_loads_only_what_it_uses(user_environment, root):
    """Of help nothing heavy, of info no part of scipy that only other commands use."""
    info, parts = ['info', str(root / 'bags/validation')], [
        'scipy.signal', 'scipy.stats', 'scipy.optimize']
    lines = [['--help'], ['--version'], *([name, '-h'] for name in app.commands), info]
    code = f"""
import sys
from bellows_ros.cli import main
for line in {lines!r}:
    names = {parts!r} if line == {info!r} else {HEAVY!r}
    print('exit', main(line), line, [name for name in names if name in sys.modules])
"""
    done = subprocess.run(
        [sys.executable, '-c', code], env=user_environment, capture_output=True, text=True)
    for line in lines:
        assert f'exit 0 {line} []\n' in done.stdout, done.stdout + done.stderr


@pytest.mark.parametrize(('arguments', 'named'), [
    (['indentify'], "'indentify'.*'identify'"), (['xyz'], "'xyz'.*identify"),
    (['replay'], 'BAG'), (['simulate', '--out', 'x'], '--motion'), ([], 'Commands:'),
    (['replay', 'bag', '--jsn', 'x'], "'?--jsn'?.*--json"), (['plan', 'x', '--steer', 'y'], 'zvd'),
    (['identify', 'x', '--set', 'fit.structur=full'], r'fit\.structure'),
    (['parameters', 'gravty'], 'gravity')])
def test_a_wrong_command_line_is_explained(arguments, named, bellows):
    done = bellows(*arguments)
    assert (done.returncode, done.stdout) == (2, '')
    assert re.search(named, ' '.join(done.stderr.split()))


@pytest.mark.parametrize(('text', 'name', 'value'), [
    ('package.mass=1e-1', 'package.mass', 0.1),
    ('package.com=[0, 0, -0.03]', 'package.com', (0.0, 0.0, -0.03)),
    ('package.com=0,0,-3e-2', 'package.com', (0.0, 0.0, -0.03)),
    ("topics.tool_twist=''", 'topics.tool_twist', ''), ('topics.tool_pose=/a=b',
                                                        'topics.tool_pose', '/a=b'),
    ('frames.tool=7', 'frames.tool', '7'),
    ('recording.align_at_rest=True', 'recording.align_at_rest', True),
    ("bags=['one', two]", 'bags', ('one', 'two'))])
def test_overrides_are_read_in_the_kind_of_the_parameter(text, name, value):
    got = parse_override(text)
    assert got == (name, value) and type(got[1]) is type(value)


@pytest.mark.parametrize(('words', 'expected'), [
    ('bellows ', set(app.commands)), ('bellows simulate --mot', {'--motion'}),
    ('bellows identify --set fit.st', {'fit.structure='}),
    ('bellows plan p --steer z', {'zv', 'zvd'})])
def test_what_can_follow_is_offered(words, expected, user_environment):
    done = run(user_environment, _BELLOWS_COMPLETE='bash_complete', COMP_WORDS=words,
               COMP_CWORD=str(len(words.split(' ')) - 1))
    assert expected <= {line.partition(',')[2] for line in done.stdout.splitlines()}, done.stderr


@pytest.mark.parametrize(('value', 'error', 'shown'), [
    (5405.62, 7.04, '5405.6 ± 7.0 N/m'), (5405.62, 0.0, '5405.6 N/m'),
    (5405.62, float('inf'), 'not identifiable')])
def test_a_value_is_shown_as_far_as_it_is_known(value, error, shown):
    assert with_error(value, error, 'N/m') == shown
    assert column([0.0851, 1.234, 12.5]) == ['0.1', '1.2', '12.5']


def test_an_unusual_stream_is_no_error(user_environment, succeed):
    """End quietly if the reader has had enough, as `head` has; do without special characters."""
    command = f'{sys.executable} -m bellows_ros.cli parameters --yaml | head -n 1'
    done = subprocess.run(
        ['bash', '-c', command], env=user_environment, capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (0, '') and done.stdout.startswith('#')
    assert succeed('parameters', quiet=True, PYTHONIOENCODING='ascii').stdout.isascii()


@pytest.mark.skipif(not os.path.exists('/dev/full'), reason='there is no /dev/full here')
@pytest.mark.parametrize('option', ['--yaml', '--help'])
def test_a_full_device_is_one_sentence(option, user_environment):
    with open('/dev/full', 'w') as full:
        done = subprocess.run(
            [sys.executable, '-m', 'bellows_ros.cli', 'parameters', option], text=True,
            env=user_environment, stdout=full, stderr=subprocess.PIPE)
    assert done.returncode == 2
    assert 'No space left on device' in done.stderr and 'Traceback' not in done.stderr


@pytest.mark.parametrize('error', [ZeroDivisionError('a defect'), OSError(22, 'a defect')])
def test_a_crash_has_its_own_exit_code_and_asks_for_a_report(error, capsys):
    def work():
        raise error

    assert guarded(work) == 70
    *traceback, line = capsys.readouterr().err.splitlines()
    assert 'Traceback' in traceback[0] and 'a defect' in traceback[-1]
    assert line.startswith('bellows: This is a defect') and 'please report it' in line


@pytest.mark.parametrize('is_new', [True, False])
def test_progress_stands_on_a_terminal_and_says_that_nothing_is_compiled_yet(
        is_new, monkeypatch, capsys):
    monkeypatch.setattr(jit, 'announce', lambda tell: tell() if is_new else None)
    for terminal in ('', '1'):
        if terminal:
            monkeypatch.setenv('FORCE_COLOR', terminal)
        with Console().progress as progress:
            progress('fitting', 0.5)
        said = capsys.readouterr().err
        assert ('fitting' in said) == bool(terminal) and ('50%' in said) == bool(terminal)
        assert ('Compiling (once a version): about' in said) == is_new


@pytest.mark.parametrize(('number', 'said'), [
    (signal.SIGTERM, 'Ended by SIGTERM'), (signal.SIGINT, 'Interrupted')])
def test_a_signal_ends_in_order(number, said, workshop, tmp_path, user_environment):
    """Say so, end with 128 and its number, and leave what was there; twice is as good as once."""
    motion = write_yaml(tmp_path / 'long.yaml', {**MOTION, 'duration': 150.0})
    before, deadline = contents(tmp_path), time.monotonic() + WITHIN
    process = subprocess.Popen(
        [sys.executable, '-m', 'bellows_ros.cli', 'simulate', '--params', workshop / 'cup.yaml',
         '--motion', motion, '--out', tmp_path / 'long'], text=True, env=user_environment,
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, start_new_session=True)
    while not any(tmp_path.glob(f'{PREFIX}*')):
        assert time.monotonic() < deadline and process.poll() is None, process.communicate()
        time.sleep(0.002)
    os.killpg(process.pid, number)
    os.killpg(process.pid, number)
    out, err = process.communicate(timeout=WITHIN)
    assert process.returncode == 128 + number
    assert out == '' and err == f'{said}; every output file is whole, the old or the new one.\n'
    assert contents(tmp_path) == before


@pytest.mark.parametrize('error', [
    None, SystemError('CPUDispatcher(whiten)'), BellowsError('wrong'), BrokenPipeError(32, 'pipe'),
    ValueError('a defect'), SystemExit(1), MemoryError()], ids=repr)
def test_after_a_signal_every_end_is_that_interruption(error, capsys, handlers):
    """Compiled code turns the exception of a signal into another one; callbacks lose it."""
    def work():
        with suppress(KeyboardInterrupt):
            signal.raise_signal(signal.SIGTERM)
        if error:
            raise error
        return 0

    assert guarded(work) == 143
    assert 'defect' not in capsys.readouterr().err


def test_a_signal_while_the_handlers_are_restored_is_that_interruption(
        monkeypatch, capsys, handlers):
    """Nothing of it is printed, and the exit code is not that of a crash."""
    restore = signal.signal

    def interrupted(number, handler):
        if handler is signal.default_int_handler:
            signal.raise_signal(number)  # the handler of the work is still there
        return restore(number, handler)

    restore(signal.SIGINT, signal.default_int_handler)
    monkeypatch.setattr(signal, 'signal', interrupted)
    assert guarded(lambda: 0) == 130
    assert 'Traceback' not in capsys.readouterr().err


def test_a_signal_in_a_callback_is_not_printed(capsys, handlers):
    """Python prints what a callback raises, as those of numba while it loads stored code."""
    class Loaded:

        def __del__(self):
            signal.raise_signal(signal.SIGTERM)

    def work():
        Loaded()
        return 0

    assert guarded(work) == 143
    assert 'Traceback' not in capsys.readouterr().err


def test_a_signal_waits_until_the_processes_have_started(handlers):
    """A cluster that is interrupted while it starts leaves a traceback at the end."""
    reached = False

    def work():
        nonlocal reached
        with signals_deferred():
            signal.raise_signal(signal.SIGTERM)
            reached = True
        raise AssertionError('not interrupted')

    assert guarded(work) == 143 and reached
