"""TUM and EuRoC files."""

from pathlib import Path

from bellows_ros.errors import BellowsError
from bellows_ros.files.trajectory_files import read_euroc, read_tum, write_tum
import numpy as np
import pytest

STAMPS = np.array([1_700_000_000_123_456_789, 1_700_000_000_125_456_789])
VALUES = np.array([[1.0, -2.0, 0.5, 0.0, 0.0, 0.6, 0.8], [1e-3, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0]])


def test_tum_goes_out_and_comes_back(tmp_path: Path) -> None:
    """Keep every nanosecond, which floats of seconds would lose."""
    write_tum(tmp_path / 'a.tum', STAMPS, VALUES)
    stamps, values = read_tum(tmp_path / 'a.tum')
    np.testing.assert_array_equal(stamps, STAMPS)
    np.testing.assert_allclose(values, VALUES, rtol=1e-8)


def test_tum_takes_exponents_and_comments(tmp_path: Path) -> None:
    """Read what other tools write."""
    (tmp_path / 'a.txt').write_text('# a comment\n\n1.5e3 0 0 0 0 0 0 1\n1501 0 0 0 0 0 0 1\n')
    stamps, _ = read_tum(tmp_path / 'a.txt')
    np.testing.assert_array_equal(stamps, [1500 * 10**9, 1501 * 10**9])


def test_euroc_has_w_first(tmp_path: Path) -> None:
    """Put the quaternion into the order x, y, z, w, and leave velocities alone."""
    (tmp_path / 'a.csv').write_text(
        '#timestamp [ns], p_RS_R_x [m], ...\n'
        '1403636580838555648,4.68,-1.78,0.78,0.8,0.1,0.2,0.3,-0.03,-0.02\n')
    stamps, values = read_euroc(tmp_path / 'a.csv')
    assert stamps[0] == 1403636580838555648
    np.testing.assert_allclose(values[0], [4.68, -1.78, 0.78, 0.1, 0.2, 0.3, 0.8])


@pytest.mark.parametrize(
    ('read', 'text', 'words'),
    [
        (read_tum, '1 2 3\n', 'line 1: expected 8 numbers, got 3'),
        (read_tum, '1 0 0 0 0 0 zero 1\n', 'line 1'),
        (read_tum, '# nothing\n', 'no poses'),
        (read_tum, '-1 0 0 0 0 0 0 1\n', 'a time in s'),
        (read_euroc, '1.5,0,0,0,1,0,0,0\n', 'a time in ns'),
        (read_euroc, '1,0,0,0\n', 'at least 8 numbers'),
    ],
)
def test_bad_lines_are_named(read: object, text: str, words: str, tmp_path: Path) -> None:
    """Say which line, and what a line must be."""
    (tmp_path / 'a.txt').write_text(text)
    with pytest.raises(BellowsError, match=words):
        read(tmp_path / 'a.txt')  # type: ignore[operator]


def test_a_missing_file_is_an_error(tmp_path: Path) -> None:
    """Name it."""
    with pytest.raises(BellowsError, match=r'none\.tum'):
        read_tum(tmp_path / 'none.tum')
