"""Sentences: numbers have their unit, foreign text is shown safely."""

from bellows_ros.errors import shown
from bellows_ros.report import sentences
from bellows_ros.report.sentences import formatted
import numpy as np
import pytest


@pytest.mark.parametrize('template, number, expected', [
    ('{x:.1f mm}', 0.0123, '12.3 mm'), ('{x:mm}', 1.23456, '1.23e+03 mm'),
    ('{x:.0f deg}', np.pi, '180 degrees'), ('{x:.0f %}', 0.256, '26 %'),
    ('{x:# pose}', 1, '1 pose'), ('{x:# measured pose}', 20, '20 measured poses'),
    ('{x:.2f} kg', 1.8, '1.80 kg'), ('{x} Hz', 30, '30 Hz'),
    ('{x:.1f mm}', None, '-'), ('{x:.1f mm}', np.inf, '-'), ('{x:.1f}', float('nan'), '-'),
    ('{x:.0f mm}', [0.001, 0.002, 0.003], '1 mm, 2 mm and 3 mm'),
    ('{x}', ('K z', 'K x'), 'K z and K x'), ('{x}', list('abcdefgh'), 'a, b, c, d, e and 3 more'),
])
def test_a_number_is_shown_in_the_unit_of_its_sentence(template, number, expected):
    """Take SI units."""
    assert formatted(template, x=number) == expected


@pytest.mark.parametrize('text', [
    '\x1b]0;title\x07', 'a\nb', 'a\tb', '\x00', '\u202egnp.exe', '\ud800', '\x9b31m', '\u2028'])
def test_shown_text_is_one_printable_line(text):
    """Keep what it says recognisable."""
    safe = shown(text)
    assert safe.isprintable() and safe.encode()
    assert shown(text, allowed=text) == text
    assert shown('a' * 81) == 'a' * 77 + '...' and shown('a' * 80) == 'a' * 80
    assert formatted("'{x}' is lost.", x='\x1b[2J\n\udce9') == "'\\x1b[2J\\n\\udce9' is lost."
    assert len(formatted('{name}', name='a' * 10_000)) == sentences.MAX_TEXT
