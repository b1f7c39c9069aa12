"""Copy the demo's plot, as `make demo` has just written it, to where the README shows it."""

import io
from pathlib import Path

from bellows_ros.files.atomic import write_bytes
from PIL import Image

ROOT = Path(__file__).resolve().parents[2]
COLOURS = 64  # enough for lines on a plain ground, at a third of the size
NAMES = ('demo.png', 'demo_dark.png')


def main() -> None:
    """Write the pictures with fewer colours."""
    for name in NAMES:
        picture = Image.open(ROOT / 'demo_output' / name).convert('RGB')
        data = io.BytesIO()
        picture.quantize(COLOURS, dither=Image.Dither.NONE).save(data, 'png', optimize=True)
        write_bytes(ROOT / 'docs' / 'images' / name, data.getvalue())


if __name__ == '__main__':
    main()
