"""Pages: complete, self-contained, the same bytes every time."""

from html.parser import HTMLParser
import json
import re

from bellows_ros.files.bag_folder import digests
from bellows_ros.files.parameter_files import read_parameters
from bellows_ros.files.results import format_json
from bellows_ros.report import motion, samples
from bellows_ros.report.build import identification_report, replay_report
from bellows_ros.report.cup import iteration_content
from bellows_ros.report.page import page, table, warnings
from bellows_ros.workflows.identify import identify
from bellows_ros.workflows.replay import replay
from bellows_ros.workflows.report import cup_values
import numpy as np
import pytest

VOID = {'meta', 'path', 'circle', 'rect'}


class Strict(HTMLParser):
    """Check that elements close in order; collect tags and text."""

    def __init__(self):
        super().__init__()
        self.open, self.tags, self.text = [], [], []

    def handle_starttag(self, tag, attrs):
        """Open an element."""
        self.tags.append((tag, dict(attrs)))
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag, attrs):
        """Note an empty element."""
        self.tags.append((tag, dict(attrs)))

    def handle_endtag(self, tag):
        """Close the element opened last."""
        assert self.open.pop() == tag

    def handle_data(self, data):
        """Keep the text."""
        self.text.append(data)


def parsed(html):
    """Return a checked page."""
    parser = Strict()
    parser.feed(html)
    parser.close()
    assert parser.open == []
    return parser


@pytest.fixture(scope='module')
def result(root):
    """Return the identification of a shipped recording, short for speed."""
    known = read_parameters(root / 'bags/package.yaml')
    return identify({**known, 'bags': [str(root / 'bags/validation')],
                     'output.report': 'page.html', 'fit.method': 'least_squares'}, None,
                    [root / 'bags/package.yaml'])


@pytest.fixture(scope='module')
def content(result):
    """Return it as its file holds it."""
    return json.loads(format_json(result.as_json()))


@pytest.fixture(scope='module')
def html(content, result):
    """Return its page."""
    return identification_report(content, result.recordings, result.excitation)


def test_the_page_is_well_formed_and_needs_nothing_else(html):
    """Load nothing: no script, no link, no picture from elsewhere."""
    found = parsed(html)
    tags = {tag for tag, _ in found.tags}
    assert {'svg', 'table', 'style'} <= tags
    assert not tags & {'script', 'link', 'img', 'iframe', 'object'}
    assert not any(name in ('src', 'href') for _, attrs in found.tags for name in attrs)
    assert 'url(' not in html and '@import' not in html and 'http' not in html


def test_the_same_numbers_give_the_same_bytes(html, content, result, root):
    """Have no time of making in it; make all numbers again from the file."""
    again = identify(result.values, None, [root / 'bags/package.yaml'])
    assert json.loads(format_json(again.as_json())) == content
    assert identification_report(content, again.recordings, again.excitation) == html


def test_every_part_is_there(html):
    """Show what a reader looks for."""
    text = ' '.join(parsed(html).text)
    for words in ('Stiffness K', 'Measured and simulated', 'Spectra', 'Whiteness', 'Excitation',
                  'Validity range', 'Samples of', 'Where this comes from', 'All settings',
                  '95 % interval'):
        assert words in text
    assert text.count('Measured and simulated') == 1


def test_files_and_versions_are_named(html, root):
    """Show the digests of recordings and parameter files, and NumPy's version."""
    for path in ('bags/validation', 'bags/package.yaml'):
        for file in digests(root / path):
            assert file['sha256'] in html
    assert np.__version__ in html


def test_light_and_dark(html):
    """Follow the reader's system: every colour is a variable with two meanings."""
    style = re.search(r'<style>(.*?)</style>', html, re.DOTALL).group(1)
    light, dark = re.findall(r':root\{(.*?)\}', style)
    assert re.findall(r'--(\w+):', light) == re.findall(r'--(\w+):', dark)
    rules = style.split('}}\n')[1]
    assert '#' not in rules
    assert not re.search(r'(fill|stroke)="', html)


def test_a_validation_is_shown_before_the_fit(content, result, root):
    """Put what the fit has not seen first."""
    other = replay(root / 'bags/static', cup_values(content))
    html = identification_report(content, result.recordings, result.excitation, [other])
    assert html.index('Not used in the fit') < html.index('Used in the fit')
    for file in digests(root / 'bags/static'):
        assert file['sha256'] in html


def test_a_replay_has_a_page_of_its_own(content, root):
    """Make a page from a replay alone, the same twice."""
    found = replay(root / 'bags/validation', cup_values(content))
    html = replay_report(found)
    parsed(html)
    assert html == replay_report(found)
    assert 'One-step' in html or 'one step' in html
    assert 'White: a probability of 0.01 or more; nearly white: less, but' in html
    assert 'always coloured' not in html


def test_a_cup_that_cannot_be_simulated_still_has_its_page(content, result):
    """Say why there is no simulation."""
    soft = {**content, 'stiffness': np.diag([50.0, 50, 50, 0.01, 0.01, 0.01]).tolist()}
    html = identification_report(soft, result.recordings, result.excitation)
    assert 'cannot be simulated' in html


def test_parameters_that_are_not_identifiable_are_named(content, result):
    """Show no interval where there is none."""
    std = [row[:] for row in content['damping_std']]
    std[2][2] = None
    html = identification_report(
        {**content, 'damping_std': std}, result.recordings, result.excitation)
    assert 'not identifiable' in html and 'class="endless"' in html


def test_times_count_from_the_first_stamp_recorded(content, result, root, monkeypatch):
    """Show samples and motion at their times in the recording, before which filters know none."""
    strips, curves = [], []
    monkeypatch.setattr(samples, 'strip_chart', lambda rows, *rest: strips.extend(rows) or '')
    monkeypatch.setattr(motion, 'line_chart', lambda found, *_, **__: curves.extend(found) or '')
    validated = replay(root / 'bags/validation', cup_values(content))
    replay_report(validated)
    start_ns = validated.recording.aligned_package.stamps_ns[0]  # the tool begins with it
    used = validated.recording.package.stamps_ns[validated.recording.valid]
    assert strips[0][2][0][0] == pytest.approx((used[0] - start_ns) / 1e9) and used[0] > start_ns
    (measured, *_) = (curve for curve in curves if curve.label == 'measured')
    expected = (validated.validation.stamps_ns - start_ns) / 1e9
    np.testing.assert_allclose(measured.x, expected)


def test_the_iteration_is_drawn():
    """Draw cost and parameters over the steps."""
    steps = [{'stage': 0, 'number': i, 'chi2': 10.0 / (i + 1),
              'stiffness': np.diag([float(i + 1)] * 6).tolist(), 'damping': np.eye(6).tolist()}
             for i in range(5)]
    words, charts = iteration_content(steps)
    assert '5 steps' in words
    assert charts.count('<svg') == 3


def test_nothing_becomes_markup():
    """Escape titles, cells and warnings."""
    html = page('<b>', '&', [table(['<i>'], [['<u>']]), warnings(['<s>'])])
    found = parsed(html)
    assert not {tag for tag, _ in found.tags} & {'b', 'i', 'u', 's'}


def test_pages_open_with_their_verdict(content, result, root):
    """Say in the first sentence whether the cup can be used, or how it has predicted."""
    found = replay(root / 'bags/validation', cup_values(content))
    for html, verdict in (
        (identification_report(content, result.recordings, result.excitation),
         'The fit can be used.'),
        (identification_report(
            {**content, 'usable': False}, result.recordings, result.excitation),
         'The fit cannot be used'),
        (replay_report(found), 'All axes that move are predicted within 5 %'),
    ):
        assert html.partition('</h2>')[2].lstrip().startswith(f'<p>{verdict}')
