"""The demonstration, run as `make demo` runs it."""

import importlib.util
import re
import shutil
import subprocess
import sys

from bellows_ros.demo import main
import pytest

pytestmark = [pytest.mark.lane, pytest.mark.xdist_group('demo')]  # it is run once

LARGEST_ERROR = {'mm': 0.12, 'deg': 0.034}
LONGEST = 900.0  # s: on a busy machine where nothing is compiled yet


@pytest.fixture(scope='module')
def outcome(root, user_environment, tmp_path_factory):
    """Run it once, and give what it printed and where it wrote."""
    pytest.importorskip('rclpy', reason="no rclpy here (pip install '.[ros]')")
    pytest.importorskip('matplotlib', reason="no matplotlib here (pip install '.[plot]')")
    out = tmp_path_factory.mktemp('demo') / 'demo_output'
    done = subprocess.run(
        [sys.executable, '-m', 'bellows_ros.demo', '--out', str(out)], cwd=root,
        env=user_environment, capture_output=True, text=True, timeout=LONGEST,
        stdin=subprocess.DEVNULL)
    assert done.returncode == 0, done.stdout + done.stderr
    return done, out


def test_it_prints_only_the_summary(outcome):
    """No warnings, no colour, no progress; nothing to complain about in the node's log."""
    done, out = outcome
    assert done.stderr == '' and '\x1b' not in done.stdout
    assert len(done.stdout.splitlines()) < 35
    log = (out / 'predictor.log').read_text()
    assert re.search(r'\d+ predictions', log) and not re.search('ERROR|Traceback', log), log


def test_every_message_is_answered_within_the_noise(outcome):
    """Lose no pose at recorded speed; predict to little more than 0.1 mm and 0.03 degrees."""
    text = outcome[0].stdout
    counts = re.search(r'All of (\d+) poses were answered', text)
    latency = re.search(r'p50 (\d+) us, p99 (\d+) us', text)
    assert counts and latency, text
    assert int(counts[1]) > 5000
    assert 0 < int(latency[1]) <= int(latency[2])
    errors = re.findall(r'([\d.]+) (mm|deg) +[\d.]+ % of', text)
    assert [unit for _, unit in errors] == ['mm'] * 3 + ['deg'] * 3
    for value, unit in errors:
        assert float(value) < LARGEST_ERROR[unit]


def test_a_folder_that_cannot_be_made_is_reported(root, capsys):
    assert main(['--bags', str(root / 'bags'), '--out', str(root / 'setup.py')]) == 2
    assert '--out' in capsys.readouterr().err


@pytest.mark.parametrize('missing', ['validation', 'package.yaml'])
def test_a_missing_recording_is_reported(missing, root, tmp_path, capsys):
    """End with 2 and say what is not there, before anything is made."""
    bags = shutil.copytree(root / 'bags', tmp_path / 'bags', ignore=lambda *_: [missing])
    assert main(['--bags', str(bags), '--out', str(tmp_path / 'out')]) == 2
    out, err = capsys.readouterr()
    assert out == '' and str(bags / missing) in err
    assert not (tmp_path / 'out').exists()


@pytest.mark.parametrize('module', ['rclpy', 'matplotlib'])
def test_missing_software_is_reported(module, root, tmp_path, capsys, monkeypatch):
    """End with 2 and say what to install."""
    find = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, 'find_spec',
                        lambda name, *rest: None if name == module else find(name, *rest))
    assert main(['--bags', str(root / 'bags'), '--out', str(tmp_path / 'out')]) == 2
    out, err = capsys.readouterr()
    assert out == '' and module in err and 'pip install' in err
