"""Pages: complete, self-contained, the same bytes every time."""

import dataclasses
from html.parser import HTMLParser

from bellows_ros.files.bag_folder import digests
from bellows_ros.files.parameter_files import read_parameters
from bellows_ros.report import build as pages
from bellows_ros.report.build import identification_report, replay_report
from bellows_ros.report.text import print_identification
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
                     'output.report': 'page.html', 'fit.method': 'least_squares'},
                    parameter_files=[root / 'bags/package.yaml'])


@pytest.fixture(scope='module')
def html(result):
    """Return its page."""
    return identification_report(result)


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


def test_the_same_numbers_give_the_same_bytes(html, result, root):
    """Have no time of making in it; make all numbers again."""
    again = identify(result.values, parameter_files=[root / 'bags/package.yaml'])
    assert identification_report(again) == html


def test_the_page_has_what_the_command_prints(html, result):
    """Hold each cell and sentence, escaped as HTML needs it."""
    printed = []

    class Writer:

        def line(self, text='', style=''):
            printed.append(text)

        def paragraph(self, *texts, style=''):
            printed.extend(texts)

        def table(self, rows, right=False, title=''):
            printed.extend([title, *(cell for row in rows for cell in row)])

        def warn(self, *texts):
            printed.extend(texts)

    print_identification(result, Writer())
    text = ' '.join(parsed(html).text)
    assert len(printed) > 30 and [own for own in printed if own not in text] == []


def test_files_and_versions_are_named(html, root):
    """Show the digests of recordings and parameter files, and NumPy's version."""
    for path in ('bags/validation', 'bags/package.yaml'):
        for file in digests(root / path):
            assert file['sha256'] in html
    assert np.__version__ in html


def test_a_validation_is_shown_before_the_fit(result, root, words_only):
    """Put what the fit has not seen first."""
    other = replay(root / 'bags/static', result.cup_values())
    html = identification_report(dataclasses.replace(result, validations=(other,)))
    assert html.index('Not used in the fit') < html.index('Used in the fit')
    for file in digests(root / 'bags/static'):
        assert file['sha256'] in html


def test_a_replay_has_a_page_of_its_own(result, root):
    """Make a page from a replay alone, the same twice."""
    found = replay(root / 'bags/validation', result.cup_values())
    html = replay_report(found)
    parsed(html)
    assert html == replay_report(found)
    assert found.validation.verdict() in html


def test_a_cup_that_cannot_be_simulated_still_has_its_page(result, words_only):
    """Say why there is no simulation."""
    soft = dataclasses.replace(result.fit, parameters=result.fit.parameters * 5e-3)
    html = identification_report(dataclasses.replace(result, fit=soft))
    assert 'cannot be simulated' in html
