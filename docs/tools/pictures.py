"""
The pictures of the pages.

`python docs/tools/pictures.py [NAME ...]` draws them into docs/images/, all without a name. A
script of docs/figures/ declares `FIGURES`, functions from a theme to a figure, and `FILES`,
functions that write a file in a theme. The demo's picture is copied from demo_output/.
"""

from collections.abc import Iterator
import importlib.util
import io
from pathlib import Path
import sys
from typing import Any

from bellows_ros.files.atomic import write_bytes
from bellows_ros.plots.style import THEMES, write_figure
from PIL import Image
from PIL.PngImagePlugin import PngInfo

ROOT = Path(__file__).resolve().parents[2]
IMAGES = ROOT / 'docs' / 'images'
SCRIPTS = sorted((ROOT / 'docs' / 'figures').glob('*.py'))
COLOURS = 64
"""Colours of a PNG: enough for lines on a plain ground, at a third of the size."""


def declared(script: Path) -> Iterator[tuple[str, str, Any]]:
    """Yield name, kind of declaration (FIGURES or FILES) and function of each picture."""
    sys.path.insert(0, str(script.parent))
    spec = importlib.util.spec_from_file_location(script.stem, script)
    assert spec and spec.loader
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    for kind in ('FIGURES', 'FILES'):
        for name, function in getattr(module, kind, {}).items():
            yield name, kind, function


def draw(script: Path, folder: Path, names: tuple[str, ...] = ()) -> None:
    """Draw the pictures of a script, or those with some names."""
    for name, kind, function in declared(script):
        if names and name not in names:
            continue
        path = folder / name
        if kind == 'FIGURES':
            write_figure(path, function(THEMES['light']))
        else:
            function(path, 'light')
        if path.suffix == '.png':
            reduce(path, path)
        print(f'drew {path.name}')


def reduce(source: Path, target: Path) -> None:
    """Write a PNG with fewer colours, and its description."""
    picture, text, data = Image.open(source), PngInfo(), io.BytesIO()
    text.add_text('Description', picture.text['Description'])
    picture.convert('RGB').quantize(COLOURS, dither=Image.Dither.NONE).save(
        data, 'png', optimize=True, pnginfo=text)
    write_bytes(target, data.getvalue())


def content(path: Path) -> str:
    """Return the description in a PNG or SVG; of a film its size and its number of pictures."""
    if path.suffix == '.svg':
        return path.read_text().split('<dc:description>')[1].split('</dc:description>')[0]
    picture: Any = Image.open(path)
    return picture.text['Description'] if path.suffix == '.png' else (
        f'{picture.n_frames} pictures of {picture.size}')


def main(names: tuple[str, ...]) -> None:
    """Draw all pictures, or those with some names."""
    for script in SCRIPTS:
        draw(script, IMAGES, names)
    if not names or 'demo.png' in names:
        reduce(ROOT / 'demo_output' / 'demo.png', IMAGES / 'demo.png')


if __name__ == '__main__':
    main(tuple(sys.argv[1:]))
