"""Links on the pages lead somewhere, pictures are there, and generated pages are current."""

import re

import pytest

from .conftest import load, PAGES

LINK = re.compile(r'\]\(([^)\s]+)\)|(?:src|srcset)="([^"]+)"')


def anchors(page):
    """Return the anchors that GitHub and Sphinx make of a page's headings."""
    heads = re.findall(r'^#+ (.*)$', page.read_text(), re.MULTILINE)
    return {re.sub(r'[^\w\- ]', '', head.lower()).replace(' ', '-') for head in heads}


@pytest.mark.parametrize('page', PAGES.pages(), ids=lambda page: page.name)
def test_links_lead_somewhere(page):
    """Find every file and heading that a page links to."""
    text = re.sub(r'```.*?```', '', page.read_text(), flags=re.DOTALL)
    for found in LINK.finditer(text):
        link = found[1] or found[2]
        if link.startswith(('http://', 'https://')):
            continue
        name, _, anchor = link.partition('#')
        target = (page.parent / name).resolve() if name else page
        assert target.exists(), link
        if anchor:
            assert anchor in anchors(target), link


def test_every_picture_is_shown(root):
    """Keep no picture that no page shows."""
    text = ''.join(page.read_text() for page in PAGES.pages())
    unused = [path.name for path in (root / 'docs' / 'images').iterdir()
              if path.name not in text]
    assert unused == []


@pytest.mark.parametrize('name', ['parameters.md', 'topics.md', 'commands.md'])
def test_reference_is_current(name, root):
    """Say what the declarations say; `make reference` writes the pages."""
    reference = load('tools', 'reference')
    page = root / 'docs' / 'reference' / name
    assert page.read_text() == reference.text_of(name), 'run: make reference'


def test_the_first_page_leads_to_every_page(root):
    """Link each in the text of the index, where GitHub shows no table of contents."""
    docs = root / 'docs'
    text = (docs / 'index.md').read_text()
    pages = [path for path in PAGES.pages() if docs in path.parents and path.name != 'index.md']
    links = {str(path.relative_to(docs)) for path in pages}
    assert [link for link in links if f']({link})' not in text] == []


def test_guides_name_every_command(root):
    """Lead to each command from a page other than the reference."""
    from bellows_ros.cli import app

    docs = root / 'docs'
    text = ''.join(page.read_text() for page in [root / 'README.md', *docs.glob('*.md')])
    assert [name for name in app.commands if f'bellows {name}' not in text] == []
