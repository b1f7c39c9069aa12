"""Commands that are ended from outside."""

from contextlib import suppress
import os
import signal
import subprocess
import sys
import time

from bellows_ros.cli.console import run_guarded, STOP_SIGNALS, TWICE
from bellows_ros.files.atomic import PREFIX
import pytest

from .conftest import contents, MOTION, write_yaml

WITHIN = 600.0  # s, for what comes at once on a machine that is not busy


def start(environment, *arguments, cwd):
    """Start `bellows` in a session of its own, with pipes that only its processes hold."""
    return subprocess.Popen(
        [sys.executable, '-m', 'bellows_ros.cli', *map(str, arguments)], cwd=cwd, text=True,
        env=environment, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.PIPE,
        start_new_session=True)


def wait_until_hidden(folder, process):
    """Wait until a process has begun to write in a folder."""
    deadline = time.monotonic() + WITHIN
    while time.monotonic() < deadline and process.poll() is None:
        if any(folder.glob(f'{PREFIX}*')):
            return
        time.sleep(0.002)
    pytest.fail(f'nothing was written in {folder}: {process.communicate()}')


@pytest.fixture
def handlers():
    """Restore the handlers of signals."""
    before = {number: signal.getsignal(number) for number in STOP_SIGNALS}
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


@pytest.mark.parametrize(('number', 'said'), [
    (signal.SIGHUP, 'Ended by SIGHUP'), (signal.SIGINT, 'Interrupted')])
def test_a_signal_ends_in_order(number, said, workshop, tmp_path, user_environment):
    """Say so, end with 128 and its number, and leave what was there; twice is as good as once."""
    motion = write_yaml(tmp_path / 'long.yaml', {**MOTION, 'duration': 150.0})
    before = contents(tmp_path)
    process = start(user_environment, 'simulate', '--params', workshop / 'cup.yaml',
                    '--motion', motion, '--out', tmp_path / 'long', cwd=workshop)
    wait_until_hidden(tmp_path, process)
    os.killpg(process.pid, number)
    os.killpg(process.pid, number)
    out, err = process.communicate(timeout=WITHIN)
    assert process.returncode == 128 + number
    assert out == '' and err == f'{said}; no partial output was left.\n'
    assert contents(tmp_path) == before


@pytest.mark.parametrize('number', [signal.SIGTERM, signal.SIGINT])
def test_a_signal_whose_exception_is_lost_ends_at_the_next_output(number, capsys, handlers):
    """As where it comes in a callback that a library made."""
    def work(console):
        with suppress(KeyboardInterrupt):
            signal.raise_signal(number)
        console.line('It goes on.')
        return 0

    assert run_guarded(work) == 128 + number
    out, err = capsys.readouterr()
    assert out == '' and 'no partial output was left' in err


def test_a_signal_within_an_exec_has_its_code(user_environment, tmp_path):
    """What runs as `python -m` would end with -2: CPython remembers a KeyboardInterrupt there."""
    (tmp_path / 'ended.py').write_text(
        'import signal, sys\nfrom bellows_ros.cli.console import run_guarded\n'
        'sys.exit(run_guarded(lambda _: exec("signal.raise_signal(signal.SIGHUP)")))\n')
    done = subprocess.run([sys.executable, '-m', 'ended'], env=user_environment, text=True,
                          cwd=tmp_path, stderr=subprocess.PIPE)
    assert done.returncode == 128 + signal.SIGHUP and 'Ended by SIGHUP' in done.stderr


def test_ctrl_c_again_ends_what_the_first_one_did_not(capsys, handlers):
    """Twice at once is once, also while the command cleans up."""
    cleaned = list[bool]()

    def work(console):
        try:
            signal.raise_signal(signal.SIGINT)
        finally:
            signal.raise_signal(signal.SIGINT)
            cleaned.append(True)
            time.sleep(1.1 * TWICE)
            signal.raise_signal(signal.SIGINT)
            cleaned.append(False)

    assert run_guarded(work) == 128 + signal.SIGINT
    signal.raise_signal(signal.SIGINT)  # nothing is left to interrupt
    assert cleaned == [True] and capsys.readouterr().err.startswith('Interrupted')


@pytest.mark.skipif(not os.path.exists('/dev/full'), reason='there is no /dev/full here')
@pytest.mark.parametrize('option', ['--yaml', '--help'])
def test_a_full_device_is_one_sentence(option, user_environment):
    """Exit with 2, not with the code of a negative result."""
    with open('/dev/full', 'w') as full:
        done = subprocess.run(
            [sys.executable, '-m', 'bellows_ros.cli', 'parameters', option], text=True,
            env=user_environment, stdout=full, stderr=subprocess.PIPE)
    assert done.returncode == 2
    assert 'No space left on device' in done.stderr and 'Traceback' not in done.stderr
