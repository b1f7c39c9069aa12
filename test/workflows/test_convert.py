"""Trajectory files to recordings and back."""

from dataclasses import replace

from bellows_ros.errors import BellowsError
from bellows_ros.files.bags import read_streams, topics
from bellows_ros.files.trajectory_files import read_tum, write_tum
from bellows_ros.workflows.convert import bodies_in_files, to_bag, to_tum
import numpy as np
import pytest

from ..files.test_trajectory_files import export, layout, pose, V24

STAMPS = 1_700_000_000_000_000_000 + np.arange(20) * 2_000_000
VALUES = np.hstack([np.arange(60.0).reshape(20, 3), np.tile([0.0, 0.0, 0.6, 0.8], (20, 1))])


@pytest.mark.parametrize('form, kept', [
    ('%.9f', 400), ('%.18e', 400), ('%.13g', 400), ('%.10g', None), ('%g', None)])
def test_times_with_too_few_digits_are_refused(tmp_path, form, kept):
    """As numpy.savetxt writes them."""
    rows = np.tile([1.0, 2.0, 3.0, 0.0, 0.0, 0.6, 0.8], (400, 1))
    seconds = 1.7e9 + 2e-3 * np.arange(400)
    lines = [' '.join([form % t, *map(str, row)]) for t, row in zip(seconds, rows, strict=True)]
    (tmp_path / 'a.tum').write_text('\n'.join(lines))
    if kept is None:
        with pytest.raises(BellowsError, match=r'of 400 lines .* %\.9f'):
            bodies_in_files([tmp_path / 'a.tum'])
    else:
        (body,) = bodies_in_files([tmp_path / 'a.tum'])
        assert (body.poses, dict(body.left_out)) == (kept, {})


def test_lines_that_are_no_pose_are_left_out_and_counted(tmp_path):
    lines = [f'{t / 1e9:.9f} 1 2 3 0 0 0.6 0.8' for t in STAMPS]
    lines[3:5] = [f'{STAMPS[i] / 1e9:.9f} {bad}' for i, bad in (
        (3, 'nan 2 3 0 0 0.6 0.8'), (4, '1 2 3 0 inf 0.6 0.8'))]
    lines.insert(8, lines[7])
    (tmp_path / 'a.tum').write_text('\n'.join(lines))
    (body,) = bodies_in_files([tmp_path / 'a.tum'])
    assert (body.poses, dict(body.left_out)) == (18, {'not finite': 2, 'repeated stamp': 1})


def test_a_take_becomes_topics_of_its_bodies(tmp_path):
    """Write what can be used, and say what was not and how the world lies."""
    done = to_bag(bodies_in_files([export(tmp_path / 'take.csv')]), tmp_path / 'bag')
    assert [body.topic for body in done.bodies] == ['/tool/pose', '/plate/pose']
    assert done.bodies[0].left_out == {'too few markers': 1}
    assert done.bodies[1].left_out == {'not tracked': 1}
    assert done.world == 'motive_y_up'
    assert [(t.name, t.messages) for t in topics(tmp_path / 'bag')] == [
        ('/plate/pose', 3), ('/tool/pose', 3)]


def test_unusual_properties_of_a_take_are_reported(tmp_path):
    """Name a body that was never tracked and a take without a date; refuse one without poses."""
    never = [replace(column, cells=('', '')) for column in pose('Plate')]
    undated = V24.replace('Capture Start Time', 'Started')
    file = layout(tmp_path / 'take.csv', pose('Tool') + never, undated)
    done = to_bag(bodies_in_files([file]), tmp_path / 'bag')
    assert [body.poses for body in done.bodies] == [2, 0]
    assert done.notes == (
        f'{file} (Plate) was never tracked; its topic is empty.',
        f'{file} (Tool): the file has no date; the stamps start near zero.',
    )
    with pytest.raises(BellowsError, match=r'take\.csv.*2'):
        to_bag(bodies_in_files([layout(file, never, V24)]), tmp_path / 'other')


def test_tum_survives_a_round_trip_through_a_bag(tmp_path):
    """Keep stamps exactly, and numbers to the digits of a TUM file."""
    write_tum(tmp_path / 'tool.tum', STAMPS, VALUES)
    to_bag(
        bodies_in_files([tmp_path / 'tool.tum'], ['tool_arm/pose']), tmp_path / 'bag', 'sqlite3')
    done = to_tum(tmp_path / 'bag', tmp_path / 'again.tum')
    assert done.bodies[0].topic == '/tool_arm/pose'
    stamps, values = read_tum(tmp_path / 'again.tum')
    np.testing.assert_array_equal(stamps, STAMPS)
    np.testing.assert_allclose(values, VALUES, rtol=1e-8, atol=1e-12)


def test_a_part_is_cut_equally_from_all_streams(tmp_path):
    """Count from the first stamp of all, and leave out what is earlier and later."""
    later = STAMPS + 6_000_000
    for name, stamps in (('tool', STAMPS), ('plate', later)):
        write_tum(tmp_path / f'{name}.tum', stamps, VALUES)
    span = {'recording.start': 0.01, 'recording.end': 0.03}
    done = to_bag(bodies_in_files([tmp_path / 'tool.tum', tmp_path / 'plate.tum']),
                  tmp_path / 'bag', span=span)
    assert [body.poses for body in done.bodies] == [11, 11]
    streams = read_streams(tmp_path / 'bag', {
        'tool_pose': '/tool/pose', 'package_pose': '/plate/pose'})
    np.testing.assert_array_equal(streams['tool_pose'].stamps_ns, STAMPS[5:16])
    np.testing.assert_array_equal(streams['package_pose'].stamps_ns, later[2:13])
    to_tum(tmp_path / 'bag', tmp_path / 'part.tum', '/tool/pose', {'recording.start': 0.005})
    stamps, values = read_tum(tmp_path / 'part.tum')
    np.testing.assert_array_equal(stamps, STAMPS[8:16])
    np.testing.assert_allclose(values, VALUES[8:16], rtol=1e-8, atol=1e-12)
    with pytest.raises(BellowsError, match=r'recording\.start.*1'):
        to_tum(tmp_path / 'bag', tmp_path / 'part.tum', '/tool/pose', {'recording.start': 1.0})


def test_topics_must_differ_and_be_as_many_as_bodies(tmp_path):
    """Refuse both."""
    for folder in ('a', 'b'):
        (tmp_path / folder).mkdir()
        write_tum(tmp_path / folder / 'x.tum', STAMPS, VALUES)
    sources = [tmp_path / 'a' / 'x.tum', tmp_path / 'b' / 'x.tum']
    with pytest.raises(BellowsError):
        bodies_in_files(sources)
    with pytest.raises(BellowsError, match=r'\b1\b.*\b2\b'):
        bodies_in_files(sources, ['/one'])


def test_which_topic_must_be_clear(tmp_path):
    """List those that could be meant."""
    to_bag(bodies_in_files([export(tmp_path / 'take.csv')]), tmp_path / 'bag')
    with pytest.raises(BellowsError, match='/plate/pose.*/tool/pose'):
        to_tum(tmp_path / 'bag', tmp_path / 'a.tum')
    with pytest.raises(BellowsError):
        bodies_in_files([tmp_path / 'none.csv'])
