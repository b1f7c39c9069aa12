"""
Measure the speed of this package: the node, its start, and a camera.

    python -m benchmarks                # some minutes on an idle machine
    python -m benchmarks --only node    # one section
"""

import argparse
from collections.abc import Callable, Mapping, Sequence
import platform
import tempfile
import time

from bellows_ros.core.live import Predictor
from bellows_ros.core.model.cup_package import Cup, Package
from bellows_ros.core.parameters.checks import resolve
import numpy as np

from . import live
from .processes import IMPORTS, in_process, READY

Figures = dict[str, Sequence[float]]
"""Times in s by name; their median is printed."""


def start(short: bool) -> Figures:
    """Return times from the start of an interpreter with an empty and with a filled cache."""
    imports, cold, warm = list[float](), list[float](), list[float]()
    repeats = 1 if short else 3
    for _ in range(repeats):
        with tempfile.TemporaryDirectory() as folder:
            for code, times in [(READY, cold), *[(READY, warm), (IMPORTS, imports)] * repeats]:
                begin = time.monotonic()
                done = in_process(code, environment={'NUMBA_CACHE_DIR': folder})['done']
                times.append(done - begin)
    return {'numba, numpy and rclpy imported': imports, 'node ready': warm,
            'node ready, nothing compiled': cold}


def camera(short: bool) -> Figures:
    """Return times of a pose of the tool at 500 Hz, and of a measured pose at 30 Hz."""
    t = np.arange(500, 1500 if short else 10_500) / 500.0
    speed, size = 2.0 * np.pi * np.array([1.1, 1.3, 1.7]), np.array([0.02, 0.02, 0.01])
    positions = (size * np.sin(speed * t[:, None])).tolist()
    velocities = (size * speed * np.cos(speed * t[:, None])).tolist()
    model = Cup.thesis(), Package(2.17, np.diag([0.0087, 0.0087, 0.0173]), (0.0, 0.0, -0.03))
    predictors = [Predictor(*model, 9.81, 'tool') for _ in range(2)]
    predictors[1].package.observer.use_values(resolve({}, ()))
    predictors[1].package.set_model(*model)
    alone, both, measured = times = list[float](), list[float](), list[float]()
    for k, (position, linear) in enumerate(zip(positions, velocities, strict=True)):
        stamp_ns = (k + 500) * 2_000_000
        for predictor, of_pose in zip(predictors, (alone, both), strict=True):
            predictor.expect_twists(True)
            predictor.on_twist(stamp_ns, tuple(linear), (0.0, 0.0, 0.0))
            begin = time.perf_counter()
            (prediction,) = predictor.on_pose(
                stamp_ns, 'world', tuple(position), (0.0, 0.0, 0.0, 1.0))
            of_pose.append(time.perf_counter() - begin)
        if k % 17 == 16:
            begin = time.perf_counter()
            predictor.on_measured(
                stamp_ns, 'world', prediction.position, prediction.quaternion_xyzw)
            measured.append(time.perf_counter() - begin)
    names = 'pose without a camera', 'pose with one', 'measured pose'
    return {name: each[len(each) // 4:] for name, each in zip(names, times, strict=True)}


SECTIONS: Mapping[str, Callable[[bool], Figures]] = {
    'node': live.run, 'start': start, 'camera': camera}


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(
        prog='python -m benchmarks', description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('--only', choices=SECTIONS, metavar='SECTION', help=', '.join(SECTIONS))
    only = parser.parse_args().only
    print(f'{platform.processor()} {platform.system()}, Python {platform.python_version()}')
    for section in [only] if only else SECTIONS:
        for name, times in SECTIONS[section](False).items():
            print(f'{1e3 * np.median(times):10.3f} ms  {name}', flush=True)


if __name__ == '__main__':
    main()
