"""Pages: complete, self-contained, the same bytes every time."""

import dataclasses
from itertools import chain
import re
from types import SimpleNamespace
from xml.etree import ElementTree

from bellows_ros.files.bag_folder import digests
from bellows_ros.files.parameter_files import read_parameters
from bellows_ros.report import build as pages
from bellows_ros.report.build import identification_report
from bellows_ros.report.text import print_identification
from bellows_ros.workflows.identify import identify
from bellows_ros.workflows.replay import replay
import numpy as np
import pytest

pytest.importorskip('matplotlib', reason="no matplotlib here (pip install '.[plot]')")


def parsed(html):
    """Return the elements of a page, which must close in order as those of XML do."""
    text = re.sub('(<meta [^>]*)>', r'\1/>', html.replace('xlink:', 'xlink-'))
    text = text.replace(' class=number', ' class="number"')
    return ElementTree.fromstring(text.removeprefix('<!DOCTYPE html>\n'))


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
    tags = {element.tag for element in found.iter()}
    assert {'svg', 'table', 'style'} <= tags
    assert not tags & {'script', 'link', 'img', 'iframe', 'object'}
    assert not any(name in ('src', 'href') for element in found.iter() for name in element.keys())
    assert 'url(' not in html.replace('url(#', '')
    assert '@import' not in html and 'http' not in html


def test_the_same_numbers_give_the_same_bytes(html, result, root):
    """Have no time of making in it; make all numbers again."""
    again = identify(result.values, parameter_files=[root / 'bags/package.yaml'])
    assert identification_report(again) == html


def test_the_page_has_what_the_command_prints(html, result):
    """Hold each cell and sentence, escaped as HTML needs it."""
    printed = []

    print_identification(result, SimpleNamespace(
        line=lambda text='', style='': printed.append(text),
        paragraph=lambda *texts, style='': printed.extend(texts),
        table=lambda rows, right=False, title='': printed.extend([title, *chain(*rows)]),
        warn=lambda *texts: printed.extend(texts)))
    text = ' '.join(parsed(html).itertext())
    assert len(printed) > 30 and [own for own in printed if own not in text] == []


def test_why_a_cup_is_refused_comes_first_and_nothing_that_follows_from_it(result):
    """As that something is hardly identifiable, where the fit explains nothing."""
    fit = dataclasses.replace(result.fit, notes=('K z is not identifiable.',))
    assert 'K z is not identifiable.' in dataclasses.replace(result, fit=fit).warnings
    wrong = tuple(each._replace(rms=9.0 * (each.noise + each.motion), held_out=None)
                  for each in result.verdict.simulated)
    verdict = result.verdict._replace(simulated=wrong)
    refused = dataclasses.replace(result, fit=fit, verdict=verdict)
    assert refused.warnings == ()
    html = identification_report(refused)
    assert html.index(refused.refusals[0][:40]) < html.index('No cup identified')
    assert html.index('of the refused fit') < html.index('stiffness K')


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


def test_a_cup_that_cannot_be_simulated_still_has_its_page(result, words_only):
    """Say why there is no simulation."""
    soft = dataclasses.replace(result.fit, parameters=result.fit.parameters * 5e-3)
    html = identification_report(dataclasses.replace(result, fit=soft))
    assert 'cannot be simulated' in html


def test_the_card_sums_up_the_cup(html):
    """Begin with verdict, K and P, modes, validity range and what limits the accuracy."""
    card = ' '.join(parsed(html).iter('section').__next__().itertext())
    for words in ('This cup is usable', 'stiffness K', 'damping ratio', 'axial',
                  'Valid for 1.8 kg', 'The accuracy is limited by P', 'to scale'):
        assert words in card, words
    assert html.count('stiffness K') == 1 and 'made-up' not in html


def test_every_figure_has_a_caption(html):
    """Have one sentence below each, and both halves of six panels for narrow screens."""
    figures = list(parsed(html).iter('figure'))
    assert len(figures) >= 4
    for figure in figures:
        (caption,) = figure.iter('figcaption')
        assert caption.text.endswith('.')
        assert len([part for part in figure if part.tag == 'svg']) in (1, 3)


def test_foreign_names_do_no_harm(words_only):
    """Show control characters, mathematics and broken names as they are, in HTML."""
    section = pages.Section('run_$5_and_$6')
    section.paragraph('caf\udce9 \x1b[31m<b>', style='dim')
    section.table([('a\n', '<script>')])
    section.warn('\u202e')
    text = pages.page('a\udce9', '$\\frac{', [section.html()])
    assert text.encode() and '\x1b' not in text and '<script>' not in text and '<b>' not in text
    assert '\\xe9' in text or '\\udce9' in text
