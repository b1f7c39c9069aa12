"""Pages: complete, self-contained, the same bytes every time."""

from html.parser import HTMLParser
import json

from bellows_ros.files.bag_folder import digests
from bellows_ros.files.parameter_files import read_parameters
from bellows_ros.files.results import format_json
from bellows_ros.report import page as pages
from bellows_ros.report.build import cup_values, identification_report, replay_report
from bellows_ros.workflows.identify import identify
from bellows_ros.workflows.replay import replay
import numpy as np
import pytest

pytest.importorskip('matplotlib', reason="no matplotlib here (pip install '.[plot]')")

VOID = {'meta'}


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
    return identification_report(content, result.recordings)


@pytest.fixture
def words_only(monkeypatch):
    """Leave the pictures out, which take long."""
    monkeypatch.setattr(pages, 'inline_svg', lambda figure: '')


def test_the_page_is_well_formed_and_needs_nothing_else(html):
    """Load nothing: no script, no link, no picture from elsewhere."""
    found = parsed(html)
    tags = {tag for tag, _ in found.tags}
    assert {'svg', 'table', 'style'} <= tags
    assert not tags & {'script', 'link', 'img', 'iframe', 'object'}
    assert not any(name in ('src', 'href') for _, attrs in found.tags for name in attrs)
    assert 'url(' not in html.replace('url(#', '')
    assert '@import' not in html and 'http' not in html


def test_the_same_numbers_give_the_same_bytes(html, content, result, root):
    """Have no time of making in it; make all numbers again from the file."""
    again = identify(result.values, None, [root / 'bags/package.yaml'])
    assert json.loads(format_json(again.as_json())) == content
    assert identification_report(content, again.recordings) == html


def test_every_part_is_there(html):
    """Show what a reader looks for."""
    text = ' '.join(parsed(html).text)
    for words in ('Stiffness K', 'Measured and simulated', 'Spectra', 'Whiteness', 'Excitation',
                  'Validity range', 'Samples of', 'Provenance', 'All settings',
                  '95 % interval'):
        assert words in text
    assert text.count('Measured and simulated') == 1


def test_files_and_versions_are_named(html, root):
    """Show the digests of recordings and parameter files, and NumPy's version."""
    for path in ('bags/validation', 'bags/package.yaml'):
        for file in digests(root / path):
            assert file['sha256'] in html
    assert np.__version__ in html


def test_a_validation_is_shown_before_the_fit(content, result, root, words_only):
    """Put what the fit has not seen first."""
    other = replay(root / 'bags/static', cup_values(content))
    html = identification_report(content, result.recordings, [other])
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


def test_a_cup_that_cannot_be_simulated_still_has_its_page(content, result, words_only):
    """Say why there is no simulation."""
    soft = {**content, 'stiffness': np.diag([50.0, 50, 50, 0.01, 0.01, 0.01]).tolist()}
    html = identification_report(soft, result.recordings)
    assert 'cannot be simulated' in html


def test_parameters_that_are_not_identifiable_are_named(content, result):
    """Show no interval where there is none."""
    std = [row[:] for row in content['damping_std']]
    std[2][2] = None
    html = identification_report(
        {**content, 'damping_std': std}, result.recordings)
    assert 'P z, not identifiable' in html
