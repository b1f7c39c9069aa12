"""Values from the command line, and what else the commands share."""

import argparse
import os

from bellows_ros.cli import options
from bellows_ros.cli.console import Output, progress_line
from bellows_ros.cli.options import parse_override
import pytest


@pytest.mark.parametrize(
    ('text', 'name', 'value'),
    [
        ('package.mass=1.8', 'package.mass', 1.8),
        ('package.mass=1e-1', 'package.mass', 0.1),
        ('package.com=[0, 0, -0.03]', 'package.com', (0.0, 0.0, -0.03)),
        ('package.com=0,0,-3e-2', 'package.com', (0.0, 0.0, -0.03)),
        ('topics.tool_twist=', 'topics.tool_twist', ''),
        ("topics.tool_twist=''", 'topics.tool_twist', ''),
        ('topics.tool_pose=/a=b', 'topics.tool_pose', '/a=b'),
        ('frames.package=7', 'frames.package', '7'),
        ('recording.align_at_rest=True', 'recording.align_at_rest', True),
        ("bags=['one', two]", 'bags', ('one', 'two')),
    ],
)
def test_overrides_are_read_in_the_kind_of_the_parameter(text, name, value):
    """Read numbers, lists, texts and truth values as one would write them."""
    got = parse_override(text)
    assert got == (name, value)
    assert type(got[1]) is type(value)


def test_an_output_that_is_a_hard_link_of_an_input_is_named(bellows, tmp_path):
    """Keep the input as it is."""
    text = '/**:\n  ros__parameters:\n    package.mass: 1.5\n'
    (tmp_path / 'in.yaml').write_text(text)
    os.link(tmp_path / 'in.yaml', tmp_path / 'out.yaml')
    arguments = argparse.Namespace(
        params=[tmp_path / 'in.yaml'], out=Output(tmp_path / 'out.yaml'), other=Output('new'))
    (sentence,) = options._hard_links(arguments)
    assert all(str(tmp_path / name) in sentence for name in ('in.yaml', 'out.yaml'))


@pytest.mark.parametrize(
    ('fraction', 'elapsed', 'line'),
    [
        (None, 3.0, 'reading ...'),
        (0.0, 0.0, f'[{"-" * 24}]   0%  reading'),
        (0.5, 6.0, f'[{"#" * 12}{"-" * 12}]  50%  reading, 6 s left'),
        (1.0, 9.0, f'[{"#" * 24}] 100%  reading, 0 s left'),
    ],
)
def test_progress_shows_fraction_and_remaining_time(fraction, elapsed, line):
    """Show a bar and the time left once it is known."""
    assert progress_line('reading', fraction, elapsed) == line
