"""
Accuracy of K from recordings of a tag that was rendered and detected.

    python -m benchmarks.tags ../shared/cell/tag_rig --runs 12

The folder has the simulator `cell.py` with its own integrator and camera, which needs rosbags and
opencv-contrib-python-headless. Cups have 0.6 to 1.4 times its stiffness, cameras 20 to 60 Hz from
0.8 to 2 m, tags 40 to 80 mm, stamps -50 to 60 ms. A user states 1.80 kg for 1.83 kg, (0, 0, -30)
mm for (4, -2, -31) mm. Errors are relative to K times the ratio of the masses: a common factor of
masses and K is not observable. An entry that is not identifiable is nan.
"""

import argparse
from contextlib import redirect_stdout
import io
from pathlib import Path
import sys
from tempfile import TemporaryDirectory
from typing import Any

from bellows_ros.core.geometry.arrays import Array
from bellows_ros.errors import BellowsError
from bellows_ros.workflows.identify import identify
import numpy as np

from .worlds import SHOWN, VALUES

GIVEN: dict[str, Any] = {
    **VALUES, 'fit.free': ('package_marker', 'scale'), 'measured.model': 'tag',
    'topics.tool_pose': '/tcp_pose_broadcaster/pose', 'topics.package_pose': '/camera/box',
    'tool_pose.offset': '0 0 0 1 0 0 0', 'package.mass': 1.8, 'package.com': (0.0, 0.0, -0.03),
    'package.inertia': (0.00438, 0.00654, 0.00984, 0.0, 0.0, 0.0), 'cup.length': 0.046}

TAG = 0.55, -0.1, 0.52
"""Mean position of the tag, m."""


def record(rig: Any, motion: Any, seed: int, folder: Path) -> tuple[str, Array]:
    """Record with another cup, camera, tag and clock; return a description, and K (4,)."""
    rng = np.random.default_rng(seed)
    K = np.array(rig.CUP['K']) * rng.uniform(0.6, 1.4, 4)[[0, 0, 1, 2, 2, 3]]
    rate, distance, side, late = rng.uniform([20.0, 0.8, 0.04, -0.05], [60.0, 2.0, 0.08, 0.06])
    rig.OBJ, rig.S = rig.OBJ * (side / rig.S), side
    before = np.linalg.norm(rig.CAM_O - TAG)
    rig.CAM_O = rig.CAM_O + rig.CAM_R.apply([0.0, 0.0, before - distance])
    with redirect_stdout(io.StringIO()):
        rig.make(folder, motion.excite_fn(seed, 34.0), 34.0, seed, clock=late, npz=False,
                 rate=rate, cup={**rig.CUP, 'K': K.tolist()})
    return f'| {rate:.0f} Hz, {distance:.1f} m, {1e3 * side:.0f} mm, {1e3 * late:.0f} ms', K[SHOWN]


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('rig', help='folder of the simulator')
    parser.add_argument('--runs', type=int, default=12, help='recordings')
    parser.add_argument('--first', type=int, default=0, help='seed of the first')
    given = parser.parse_args()
    sys.path.insert(0, given.rig)
    import cell as rig
    import truth as motion

    rows = []
    print('| recording | K x, z, rx, rz off by % | by standard errors |\n|---|---|---|')
    for seed in range(given.first, given.first + given.runs):
        with TemporaryDirectory() as folder:
            text, K = record(rig, motion, seed, Path(folder) / 'bag')
            try:
                fit = identify({**GIVEN, 'bags': (f'{folder}/bag',)}).fit
            except BellowsError as error:
                print(f'{text} | refused: {str(error)[:70]} | |', flush=True)
                continue
        std = np.diag(fit.stiffness_std)[SHOWN]
        off = np.diag(fit.stiffness)[SHOWN] / K * rig.PKG['m'] / GIVEN['package.mass'] - 1.0
        off[~np.isfinite(std)] = np.nan
        z = off * K / std
        rows.append([100.0 * off, z])
        print(f'{text} | {np.round(100.0 * off, 1)} | {np.round(z, 1)} |', flush=True)
    off, z = np.nanmean(rows, axis=0)
    print(f'| mean of {len(rows)} | {np.round(off, 1)} | {np.round(z, 1)} |')


if __name__ == '__main__':
    main()
