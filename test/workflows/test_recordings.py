"""Recordings as they are read and prepared, with one clock and with two."""

from bellows_ros.core.parameters.checks import resolve
from bellows_ros.errors import BellowsError
from bellows_ros.files.bags import read_streams, write_bag
from bellows_ros.workflows.recordings import load
from numpy.testing import assert_allclose, assert_array_equal
import pytest

from ..cell.sensors import TOPICS
from ..files.recordings import again


@pytest.fixture(scope='module')
def values(known, true_cup):
    """Return the parameters of the shipped recordings with their cup."""
    return resolve({**true_cup, **known})


@pytest.fixture(scope='module')
def behind(root, tmp_path_factory):
    """Return the shipped validation with the tool stamped 12.3 ms late."""
    bag = tmp_path_factory.mktemp('late') / 'bag'
    streams = read_streams(root / 'bags/validation', TOPICS)
    write_bag(bag, [again(own, late_ns=12_300_000 * (role != 'package_pose'))
                    for role, own in streams.items()])
    return bag


def test_the_tool_comes_to_the_clock_of_the_package(root, values, behind):
    """Find poses and twists, in all forms they are kept in, where they were before."""
    there = load(root / 'bags/validation', values)
    moved = load(behind, values.replaced({'fit.free': ('time_offset',)}))
    offset = moved.report.time_offset
    assert abs(offset.value - 0.0123) < max(4.0 * offset.std, 2e-5)
    assert offset.std < 5e-5
    for stream in ('tool_pose', 'tool_twist', 'package_pose'):
        stamps, wanted = (getattr(loaded, stream).stamps_ns for loaded in (moved, there))
        assert_allclose(stamps, wanted, rtol=0.0, atol=1e9 * 5e-5)
    first = moved.tool.stamps_ns[0] - there.tool.stamps_ns[0]
    assert_array_equal(moved.tool.stamps_ns - there.tool.stamps_ns, first)
    assert_allclose(
        moved.tool.position, there.tool.position, rtol=0.0, atol=5e-5)


def test_a_recording_without_an_identifiable_offset_keeps_its_stamps(root, values):
    at_rest = values.replaced({'fit.free': ('time_offset',), 'recording.end': 1.9})
    recording = load(root / 'bags/static', at_rest)
    assert recording.report.time_offset is None
    assert any(each.code == 'not_identifiable' for each in recording.report.remarks)


def test_a_part_of_a_recording_is_what_lies_there(root, values):
    bag = root / 'bags/validation'
    whole = load(bag, values)
    part = load(bag, values.replaced({'recording.start': 2.0, 'recording.end': 5.0}))
    first = whole.tool_pose.stamps_ns[0]
    for stream in ('tool_pose', 'package_pose', 'tool_twist'):
        stamps = getattr(whole, stream).stamps_ns
        wanted = stamps[(stamps >= first + 2 * 10**9) & (stamps <= first + 5 * 10**9)]
        assert_array_equal(getattr(part, stream).stamps_ns, wanted)
    assert 2.5 < part.tool.seconds[-1] <= 3.0
    for start, end in ((3.0, 2.0), (1e5, 0.0)):
        with pytest.raises(BellowsError, match=r'recording\.start'):
            load(bag, values.replaced({'recording.start': start, 'recording.end': end}))
