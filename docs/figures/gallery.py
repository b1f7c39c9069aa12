"""Draw the pictures of `bellows plot` that the pages show, from the recordings in bags/."""

import io
from pathlib import Path
import tempfile

from bellows_ros.cli import main as bellows
from bellows_ros.files.atomic import write_bytes
from PIL import Image

ROOT = Path(__file__).resolve().parents[2]
IMAGES = ROOT / 'docs' / 'images'
BAGS = ROOT / 'bags'
COLOURS = 64


def main() -> None:
    """Write the pictures, with fewer colours."""
    cup = ['--params', str(BAGS / 'package.yaml'), '--params', str(BAGS / 'cup.yaml')]
    with tempfile.TemporaryDirectory() as folder:
        picture = Path(folder) / 'deflection.png'
        bellows(['plot', 'deflection', str(BAGS / 'identification'), *cup, '--out', str(picture)])
        small = Image.open(picture).convert('RGB').resize((1100, 760))
        data = io.BytesIO()
        small.quantize(COLOURS, dither=Image.Dither.NONE).save(data, 'png', optimize=True)
        write_bytes(IMAGES / 'deflection.png', data.getvalue())
    bellows(['plot', 'animation', str(BAGS / 'validation'), *cup, '--from', '3', '--to', '7',
             '--out', str(IMAGES / 'replay.gif')])


if __name__ == '__main__':
    main()
