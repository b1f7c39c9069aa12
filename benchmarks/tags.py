"""
Accuracy of K from recordings of a tag that was rendered and detected.

    python -m benchmarks.tags ../shared/cell/tag_rig --first 900 --runs 12

The folder has the simulator `cell.py` with its own integrator and camera, which needs rosbags and
opencv-contrib-python-headless, and `apriltag.py` for the AprilTag library (pupil-apriltags). Cups
have 0.6 to 1.4 times its stiffness, cameras 20 to 60 Hz from 0.8 to 2 m, tags 40 to 80 mm, stamps
-50 to 60 ms. A user states 1.80 kg for 1.83 kg, (0, 0, -30) mm for (4, -2, -31) mm. Errors and
standard errors are relative to K times the ratio of the masses: a common factor of masses and K is
not observable. An entry that is not identifiable is nan.
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

SHOWN = [0, 2, 3, 5]
"""Indices of the shown entries on the diagonal of K."""
GIVEN: dict[str, Any] = {
    'bags': ('simulated',), 'fit.method': 'output_error',
    'recording.package_world': 'estimate', 'fit.free': ('time_offset', 'package_marker', 'scale'),
    'recording.package_frame': 'com', 'recording.world': 'z_up', 'recording.align_at_rest': False,
    'topics.tool_pose': '/tcp_pose_broadcaster/pose', 'topics.package_pose': '/camera/box',
    'tool_pose.offset': '0 0 0 1 0 0 0', 'package.mass': 1.8, 'package.com': (0.0, 0.0, -0.03),
    'package.inertia': (0.00438, 0.00654, 0.00984, 0.0, 0.0, 0.0), 'cup.length': 0.046}

TAG = 0.55, -0.1, 0.52
"""Mean position of the tag, m."""


def record(rig: Any, motion: Any, seed: int, folder: Path) -> tuple[float, float, float, Array]:
    """Record with OpenCV's detector; return rate, distance, side of the tag, and K (6,)."""
    rng = np.random.default_rng(seed)
    K = np.array(rig.CUP['K']) * rng.uniform(0.6, 1.4, 4)[[0, 0, 1, 2, 2, 3]]
    rate, distance, side, late = rng.uniform([20.0, 0.8, 0.04, -0.05], [60.0, 2.0, 0.08, 0.06])
    rig.OBJ, rig.S = rig.OBJ * (side / rig.S), side
    before = np.linalg.norm(rig.CAM_O - TAG)
    rig.CAM_O = rig.CAM_O + rig.CAM_R.apply([0.0, 0.0, before - distance])
    rig.make(folder / f'{seed}', motion.excite_fn(seed, 34.0), 34.0, seed, clock=late, npz=False,
             rate=rate, cup={**rig.CUP, 'K': K.tolist()})
    return rate, distance, side, K


def recorded(seed: int, folder: Path, detector: str) -> tuple[float, float, float, Array]:
    """Record with another cup, camera, tag and clock; see `record`."""
    import cell as rig
    import truth as motion

    with redirect_stdout(io.StringIO()):
        if detector == 'opencv':
            return record(rig, motion, seed, folder)
        import apriltag

        apriltag.record(folder, seed)
    known = np.load(folder / f'{seed}_truth.npz')
    return (*(float(known[name]) for name in ('rate', 'distance', 'side')), known['K'])


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('rig', help='folder of the simulator')
    parser.add_argument('--runs', type=int, default=12, help='recordings')
    parser.add_argument('--first', type=int, default=900, help='seed of the first')
    parser.add_argument('--detector', choices=('apriltag', 'opencv'), default='apriltag')
    parser.add_argument('--focal', type=float, default=920.0, help='of the camera, pixels')
    given = parser.parse_args()
    sys.path.insert(0, given.rig)
    rows = []
    print('| recording | K x, z, rx, rz off by % | standard errors % | by standard errors |\n'
          '|---|---|---|---|')
    for seed in range(given.first, given.first + given.runs):
        with TemporaryDirectory() as folder:
            rate, distance, side, K = recorded(seed, Path(folder), given.detector)
            text = (f'| {seed}: {rate:.0f} Hz, {distance:.1f} m, {1e3 * side:.0f} mm, '
                    f'{given.focal * side / distance:.0f} px')
            try:
                found = identify({**GIVEN, 'measured.tag_size': side,
                                  'bags': (f'{folder}/{seed}',)})
            except BellowsError as error:
                print(f'{text} | refused: {str(error)[:70]} | | |', flush=True)
                continue
        fit = found.fit
        own = np.sqrt(np.diag(fit.covariance))[:4] / K[SHOWN]
        off = np.diag(fit.stiffness)[SHOWN] / K[SHOWN] * 1.83 / GIVEN['package.mass'] - 1.0
        off[~np.isfinite(own)] = np.nan
        rows.append([100.0 * off, 100.0 * own, off / own])
        shown = ' | '.join(str(np.round(each, 1 + (n == 1))) for n, each in enumerate(rows[-1]))
        print(f'{text}{", REFUSED" * bool(found.refusals)} | {shown} |', flush=True)
    off, own, z = np.moveaxis(np.array(rows), 1, 0)
    print(f'| {len(rows)} of {given.runs}: mean, mean, RMS '
          f'| {np.round(np.nanmean(off, axis=0), 2)} | {np.round(np.nanmean(own, axis=0), 2)}'
          f' | {np.round(np.sqrt(np.nanmean(z**2, axis=0)), 2)} |')


if __name__ == '__main__':
    main()
