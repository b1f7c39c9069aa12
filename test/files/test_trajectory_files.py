"""TUM files."""

from bellows_ros.errors import BellowsError
from bellows_ros.files.trajectory_files import read_tum, write_tum
import numpy as np
import pytest

STAMPS = np.array([1_700_000_000_123_456_789, 1_700_000_000_125_456_789])
VALUES = np.array([[1.0, -2.0, 0.5, 0.0, 0.0, 0.6, 0.8], [1e-3, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0]])


def test_what_is_written_is_read(tmp_path):
    """Keep every nanosecond, which floats of seconds would lose, and numbers to nine digits."""
    write_tum(tmp_path / 'a.tum', STAMPS, VALUES)
    stamps, values = read_tum(tmp_path / 'a.tum')
    np.testing.assert_array_equal(stamps, STAMPS)
    np.testing.assert_allclose(values, VALUES, rtol=1e-8)


def test_tum_takes_exponents_and_comments(tmp_path):
    """Read what other tools write."""
    (tmp_path / 'a.txt').write_text('# a comment\n\n1.5e3 0 0 0 0 0 0 1\n1501 0 0 0 0 0 0 1\n')
    stamps, _ = read_tum(tmp_path / 'a.txt')
    np.testing.assert_array_equal(stamps, [1500 * 10**9, 1501 * 10**9])


@pytest.mark.parametrize(('text', 'figures'), [
    ('1 2 3\n', r'line 1: .*\b8 numbers\b.*\b3\b'), ('# nothing\n', ''),
    ('1 0 0 0 0 0 zero 1\n', 'line 1'), (12 * '1 ', r'line 1: .*\b8 numbers\b.*\b12\b'),
    *((f'{time} 0 0 0 0 0 0 1\n', 'line 1: .* in s,')
      for time in ('-1', '9999999999', '9' * 5000 + '.5', '².1'))])
def test_bad_lines_are_named(text, figures, tmp_path):
    """Name the line, and what a line must be."""
    (tmp_path / 'a.txt').write_text(text)
    with pytest.raises(BellowsError, match=rf"a\.txt'.*{figures}"):
        read_tum(tmp_path / 'a.txt')
