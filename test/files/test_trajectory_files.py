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


@pytest.mark.parametrize(('read', 'text', 'figures'), [
    (read_tum, '1 2 3\n', r'line 1: .*\b8 numbers\b.*\b3\b'), (read_tum, '# nothing\n', ''),
    (read_tum, '1 0 0 0 0 0 zero 1\n', 'line 1'),
    (read_euroc, '1,0,0,0\n', r'line 1: .*\b8 numbers\b.*\b4\b'),
    *((read_tum, f'{time} 0 0 0 0 0 0 1\n', 'line 1: .* in s,')
      for time in ('-1', '9999999999', '9' * 5000 + '.5', '².1')),
    *((read_euroc, f'{time},0,0,0,1,0,0,0\n', 'line 1: .* in ns,')
      for time in ('1.5', 2**63, '9' * 5000, '²'))])
def test_bad_lines_are_named(read, text, figures, tmp_path):
    """Name the line, and what a line must be."""
    (tmp_path / 'a.txt').write_text(text)
    with pytest.raises(BellowsError, match=rf"a\.txt'.*{figures}"):
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
    with pytest.raises(BellowsError, match='line 1'):
        read_trajectory(file)
