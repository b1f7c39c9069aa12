"""Draw the pictures that `bellows` draws for the pages, from recordings and plans in bags/."""

from contextlib import chdir
import io
from pathlib import Path
import tempfile

from bellows_ros import read_parameters, steer
from bellows_ros.cli import main as bellows
from bellows_ros.files.atomic import write_bytes
from bellows_ros.plots.animation import write_steering
from PIL import Image

ROOT = Path(__file__).resolve().parents[2]
IMAGES = ROOT / 'docs' / 'images'
CUP = ('--params', 'bags/package.yaml', '--params', 'bags/cup.yaml')
COLOURS = 64
SPEED = 0.25
"""Seconds of the transport per second of its film."""


def main() -> None:
    """Write the pictures, with fewer colours; their captions name recordings as a reader would."""
    with chdir(ROOT), tempfile.TemporaryDirectory() as folder:
        picture = Path(folder) / 'deflection.png'
        bellows(['plot', 'deflection', 'bags/identification', *CUP, '--out', str(picture)])
        small = Image.open(picture).convert('RGB').resize((1100, 807))
        data = io.BytesIO()
        small.quantize(COLOURS, dither=Image.Dither.NONE).save(data, 'png', optimize=True)
        write_bytes(IMAGES / 'deflection.png', data.getvalue())
        bellows(['plot', 'animation', 'bags/validation', *CUP, '--from', '3', '--to', '4', '--out',
                 str(IMAGES / 'replay.gif')])
        plan = ('bags/transport.yaml', '--params', 'bags/tossing.yaml', '--plot')
        bellows(['plan', *plan, str(IMAGES / 'plan.png')])
        bellows(['steer', '--method', 'inverse', *plan, str(IMAGES / 'steer.png')])
        report = steer(plan[0], read_parameters(plan[2]), method='inverse')
        for theme, name in (('light', 'steer'), ('dark', 'steer_dark')):
            write_steering(IMAGES / f'{name}.gif', report, '0.6 m in 0.5 s, with 1.84 kg', SPEED,
                           theme)


if __name__ == '__main__':
    main()
