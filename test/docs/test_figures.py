"""The pictures of the pages show what their scripts draw today."""

import pytest

from .conftest import load, show_the_same

PICTURES = load('tools', 'pictures')
SLOW = {'camera.png', 'exciting.png', 'filter_found.svg', 'relaxation.svg', 'replay.gif',
        'steer.gif', 'tag.png', 'toss.png'}
DECLARED = [(script, name) for script in PICTURES.SCRIPTS
            for name, *_ in PICTURES.declared(script)]


@pytest.mark.lane
@pytest.mark.parametrize(('script', 'name'), [
    pytest.param(*each, id=each[1], marks=[pytest.mark.stress] if each[1] in SLOW else [])
    for each in DECLARED])
def test_a_picture_shows_what_its_script_draws(script, name, tmp_path):
    """Draw it again, and compare the descriptions."""
    pytest.importorskip('matplotlib')
    PICTURES.draw(script, tmp_path, (name,))
    new, stored = (PICTURES.content(folder / name) for folder in (tmp_path, PICTURES.IMAGES))
    assert show_the_same(new, stored), (
        f'run: python docs/tools/pictures.py {name}\n{stored}\n{new}')


def test_every_picture_has_a_script():
    """Find no other picture than these and the demo's."""
    assert {name for _, name in DECLARED} | {'demo.png'} == {
        path.name for path in PICTURES.IMAGES.iterdir()}
