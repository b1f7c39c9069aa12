"""TUM, EuRoC and KITTI files."""

from bellows_ros.errors import BellowsError
from bellows_ros.files.trajectory_files import (
    read_euroc,
    read_trajectory,
    read_tum,
    write_euroc,
    write_tum,
)
import numpy as np
import pytest

STAMPS = np.array([1_700_000_000_123_456_789, 1_700_000_000_125_456_789])
VALUES = np.array([[1.0, -2.0, 0.5, 0.0, 0.0, 0.6, 0.8], [1e-3, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0]])


@pytest.mark.parametrize(('name', 'write'), [
    ('a.tum', write_tum),
    ('a.csv', lambda path, t, poses: write_euroc(path, t, np.pad(poses, ((0, 0), (0, 6)))))])
def test_what_is_written_is_read(tmp_path, name, write):
    """Keep every nanosecond, which floats of seconds would lose, and numbers to nine digits."""
    write(tmp_path / name, STAMPS, VALUES)
    stamps, values = read_trajectory(tmp_path / name)
    np.testing.assert_array_equal(stamps, STAMPS)
    np.testing.assert_allclose(values, VALUES, rtol=1e-8)


def test_tum_takes_exponents_and_comments(tmp_path):
    """Read what other tools write."""
    (tmp_path / 'a.txt').write_text('# a comment\n\n1.5e3 0 0 0 0 0 0 1\n1501 0 0 0 0 0 0 1\n')
    stamps, _ = read_tum(tmp_path / 'a.txt')
    np.testing.assert_array_equal(stamps, [1500 * 10**9, 1501 * 10**9])


def test_euroc_has_w_first(tmp_path):
    """Put the quaternion into the order x, y, z, w, and leave velocities alone."""
    (tmp_path / 'a.csv').write_text(
        '#timestamp [ns], p_RS_R_x [m], ...\n'
        '1403636580838555648,4.68,-1.78,0.78,0.8,0.1,0.2,0.3,-0.03,-0.02\n')
    stamps, values = read_euroc(tmp_path / 'a.csv')
    assert stamps[0] == 1403636580838555648
    np.testing.assert_allclose(values[0], [4.68, -1.78, 0.78, 0.1, 0.2, 0.3, 0.8])


@pytest.mark.parametrize(('read', 'text', 'words'), [
    (read_tum, '1 2 3\n', 'line 1: expected 8 numbers, got 3'),
    (read_tum, '1 0 0 0 0 0 zero 1\n', 'line 1'),
    (read_tum, '# nothing\n', 'no poses'),
    (read_tum, '-1 0 0 0 0 0 0 1\n', 'a time in s'),
    (read_euroc, '1.5,0,0,0,1,0,0,0\n', 'a time in ns'),
    (read_euroc, '1,0,0,0\n', 'at least 8 numbers'),
    (read_euroc, f'{2**63},0,0,0,1,0,0,0\n', 'a time in ns'),
    (read_euroc, '9' * 5000 + ',0,0,0,1,0,0,0\n', 'a time in ns'),
    (read_euroc, '²,0,0,0,1,0,0,0\n', 'a time in ns'),
    (read_tum, '9999999999 0 0 0 0 0 0 1\n', 'a time in s'),
    (read_tum, '9' * 5000 + '.5 0 0 0 0 0 0 1\n', 'a time in s'),
    (read_tum, '².1 0 0 0 0 0 0 1\n', 'line 1')])
def test_bad_lines_are_named(read, text, words, tmp_path):
    """Say which line, and what a line must be."""
    (tmp_path / 'a.txt').write_text(text)
    with pytest.raises(BellowsError, match=words):
        read(tmp_path / 'a.txt')  # type: ignore[operator]


KITTI = '0.8 -0.6 0 1\n 0.6 0.8 0 2 0 0 1 3\n'.replace('\n', ' ') + '\n1 0 0 4 0 1 0 5 0 0 1 6\n'


def test_kitti_takes_its_times_from_beside(tmp_path):
    """Read rows of matrices, distinguished from TUM by their count; both names of the times."""
    (tmp_path / '00.txt').write_text(KITTI)
    (tmp_path / 'times.txt').write_text('0.0\n1.5e-1\n')
    stamps, values = read_trajectory(tmp_path / '00.txt')
    np.testing.assert_array_equal(stamps, [0, 150_000_000])
    turn = np.sin(0.5 * np.arctan2(0.6, 0.8))
    np.testing.assert_allclose(values[0], [1, 2, 3, 0, 0, turn, np.sqrt(1 - turn**2)], atol=1e-12)
    (tmp_path / '00_times.txt').write_text('7.0\n')
    with pytest.raises(BellowsError, match=r'\b2\b.*\b1\b'):
        read_trajectory(tmp_path / '00.txt')


def test_kitti_that_is_none_is_refused(tmp_path):
    """Say which file the times belong into, and where no rotation is."""
    file = tmp_path / 'a.kitti'
    file.write_text(KITTI)
    with pytest.raises(BellowsError, match=r'a_times\.txt'):
        read_trajectory(file)
    (tmp_path / 'a_times.txt').write_text('0\n1\n')
    file.write_text(KITTI.replace('0.8 -0.6', '0.8 0.6'))
    with pytest.raises(BellowsError, match=r'\b1\b'):
        read_trajectory(file)
