"""Pages: complete, self-contained, the same bytes every time."""

import dataclasses
import io
import re

from bellows_ros.core.identification.verdict import verdict_of
from bellows_ros.errors import BellowsError
from bellows_ros.files.parameter_files import read_parameters
from bellows_ros.files.results import digests
from bellows_ros.report.build import page_of
from bellows_ros.report.text import print_identification, Writer
from bellows_ros.workflows.identify import identify
import pytest
from rich.console import Console

pytest.importorskip('matplotlib', reason="no matplotlib here (pip install '.[plot]')")


@pytest.fixture(scope='module')
def result(root):
    """Return the identification of a shipped recording, short for speed."""
    known = read_parameters(root / 'bags/package.yaml')
    return identify({**known, 'bags': [str(root / 'bags/validation')],
                     'output.report': 'page.html', 'fit.method': 'least_squares'})


def words(text):
    """Return text without elements and spaces."""
    return re.sub(r'\s+', '', re.sub(r'<[^>]*>', '', text)).replace('&#x27;', "'").replace(
        '&gt;', '>').replace('&lt;', '<').replace('&quot;', '"').replace('&amp;', '&')


def test_the_page_loads_nothing_and_has_what_the_command_prints(result, root):
    """Hold each line, and the digests of recordings and parameter files; the same bytes again."""
    html = page_of(result, [root / 'bags/package.yaml'])
    text = io.StringIO()
    print_identification(result, Writer(Console(file=text, width=110)))
    assert words(text.getvalue()) in words(html) and 'stiffness K' in html
    for path in ('bags/validation', 'bags/package.yaml'):
        assert all(file['sha256'] in html for file in digests(root / path))
    assert html.count('<svg ') == 1 and html.rstrip().endswith('</html>')
    assert not re.search(r'<(script|link|img|iframe|object)|@import|url\((?!#)', html)
    assert page_of(result, [root / 'bags/package.yaml']) == html


@pytest.mark.filterwarnings('ignore::bellows_ros.errors.UnitWarning')
def test_a_cup_that_cannot_be_simulated_still_has_its_page_and_no_picture(result):
    soft = dataclasses.replace(result.fit, parameters=result.fit.parameters * 5e-3)
    verdict = verdict_of(soft, result.recordings, result.cup_length, result.values)
    found = dataclasses.replace(result, fit=soft, verdict=verdict)
    assert '<svg ' not in page_of(found)
    with pytest.raises(BellowsError, match='no recording can be simulated'):
        found.plot()
