"""
Compare filtering two absolute motions with filtering the relative one (appendix J).

`python -m benchmarks.relative` simulates recordings with noise of several sizes and tool
rates, fits each by least squares both ways, and prints what is found over what is true. It is
seeded: the same numbers every time.
"""

from collections.abc import Iterator
from typing import NamedTuple

from bellows_ros.core.arrays import Array
from bellows_ros.core.identification.least_squares import least_squares
from bellows_ros.core.identification.reduction import statistics
from bellows_ros.core.identification.samples import Samples, samples_of
from bellows_ros.core.lie import exp_so3
from bellows_ros.core.model import Cup, Package
from bellows_ros.core.recording.preparation import prepare
from bellows_ros.core.recording.recording import PrepareSettings, Recording
from bellows_ros.core.simulation import simulate
from bellows_ros.core.structure import STRUCTURES
from bellows_ros.core.synthetic.motion import Motion, Oscillation, Pose
from bellows_ros.core.synthetic.sensing import sample_stamps
from bellows_ros.core.trajectory import PoseStream, Trajectory
import numpy as np

DURATION, REST = 20.0, 1.0
PACKAGE_RATE = 360.0
GRAVITY = 9.81
SEEDS = (1, 2, 3)
COLUMNS = ('K x', 'K z', 'K rx', 'K rz', 'P x', 'P z', 'P rx', 'P rz')
SHOWN = np.array([0, 2, 3, 5])

# Amplitudes (m, rad) and frequencies (Hz) of each axis of the tool.
LINES: tuple[tuple[tuple[float, ...], tuple[float, ...]], ...] = (
    ((0.05, 0.01, 0.002), (0.31, 1.07, 2.63)),
    ((0.05, 0.01, 0.002), (0.37, 1.19, 2.89)),
    ((0.05, 0.012, 0.004), (0.29, 1.31, 3.17)),
    ((0.15, 0.05, 0.012), (0.41, 1.37, 3.37)),
    ((0.15, 0.05, 0.012), (0.43, 1.49, 3.53)),
    ((0.20, 0.15, 0.05), (0.33, 1.43, 3.29)),
)


class Case(NamedTuple):
    """Noise of tool and package (m and rad per axis), the tool's rate, and half windows."""

    tool: tuple[float, float]
    package: tuple[float, float]
    tool_rate: float = PACKAGE_RATE
    half_windows: tuple[int, int] = (0, 0)


CASES = (
    Case((0.0, 0.0), (0.0, 0.0)),
    Case((0.0, 0.0), (0.0, 0.0), 500.0),
    Case((0.0, 0.0), (0.0, 0.0), 125.0),
    Case((0.0, 0.0), (0.0, 0.0), PACKAGE_RATE, (15, 30)),
    Case((5e-5, 2e-4), (5e-5, 2e-4)),
    Case((1e-4, 5e-4), (1e-4, 5e-4)),
    Case((2e-5, 5e-5), (1e-4, 5e-4), 500.0),
    Case((1e-4, 5e-4), (1e-4, 5e-4), PACKAGE_RATE, (15, 30)),
    Case((1e-5, 5e-5), (1e-3, 1e-3)),
    Case((1e-3, 1e-3), (1e-5, 5e-5)),
    Case((1e-3, 1e-3), (1e-3, 1e-3)),
)

PAYLOAD = Package(2.17, np.diag([0.0087, 0.0087, 0.0173]), np.array([0.0, 0.0, -0.03]))


def motion(seed: int) -> Motion:
    """Return a multi-sine that moves all six axes, with phases of its own."""
    axis = np.array([axis for axis, (sizes, _) in enumerate(LINES) for _ in sizes])
    amplitude = np.array([size for sizes, _ in LINES for size in sizes])
    frequency = np.array([f for _, frequencies in LINES for f in frequencies])
    phase = np.random.default_rng(seed).uniform(0.0, 2.0 * np.pi, len(axis))
    start = Pose(np.zeros(3), np.eye(3))
    return Oscillation(
        start, REST, 1.5, DURATION, amplitude, axis, np.stack([frequency, frequency], 1), phase
    )


def recording(case: Case, seed: int, relative: bool) -> Recording:
    """Return a simulated recording of the thesis' cup, prepared as parameters would have it."""
    moving = motion(seed)
    stamps = [sample_stamps(rate, DURATION, 0) for rate in (case.tool_rate, PACKAGE_RATE)]
    tool = moving.trajectory(np.unique(np.concatenate(stamps)), 0)
    package = simulate(Cup.thesis(), PAYLOAD, tool, gravity=GRAVITY)
    draw = np.random.default_rng((seed, 1))
    streams = [
        measured(name, body.select(np.searchsorted(body.stamps_ns, at)), noise, draw)
        for name, body, at, noise in zip(
            ('tool', 'package'), (tool, package), stamps, (case.tool, case.package), strict=True
        )
    ]
    windows = {'tool_half_window': case.half_windows[0],
               'package_half_window': case.half_windows[1]}
    return prepare(*streams, PrepareSettings(
        payload=PAYLOAD, gravity=GRAVITY, relative=relative, **windows))


def measured(
    name: str, body: Trajectory, noise: tuple[float, float], draw: np.random.Generator
) -> PoseStream:
    """Return poses with white noise on them."""
    position = body.position + noise[0] * draw.standard_normal((len(body), 3))
    turn = exp_so3(noise[1] * draw.standard_normal((len(body), 3)))
    return PoseStream(name, 'world', body.stamps_ns, position, body.rotation @ turn)


def ratios(samples: Samples) -> Array:
    """Return what least squares finds over what is true (8,), as in `COLUMNS`."""
    truth = Cup.thesis()
    fit = least_squares([statistics(samples, truth.length, STRUCTURES['axisymmetric'])])
    pairs = ((fit.stiffness, truth.stiffness), (fit.damping, truth.damping))
    return np.concatenate([np.diag(found)[SHOWN] / np.diag(true)[SHOWN] for found, true in pairs])


def both(case: Case, seed: int) -> tuple[Array, Array]:
    """Return the ratios with absolute and with relative filtering."""
    absolute, relative = (ratios(samples_of(recording(case, seed, way))) for way in (False, True))
    return absolute, relative


def table(cases: tuple[Case, ...] = CASES, seeds: tuple[int, ...] = SEEDS) -> Iterator[str]:
    """Yield the lines of a table in Markdown: mean ratios over the seeds, both ways."""
    yield '| noise: tool, package | tool rate, windows | filter | ' + ' | '.join(COLUMNS) + ' |'
    yield '|' + '---|' * (3 + len(COLUMNS))
    for case in cases:
        draws = seeds[:1] if case.package[0] == case.tool[0] == 0.0 else seeds
        means = np.mean([both(case, seed) for seed in draws], axis=0)
        for name, row in zip(('absolute', 'relative'), means, strict=True):
            cells = ' | '.join(f'{value:.3f}' for value in row)
            yield f'| {_noise(case)} | {_windows(case)} | {name} | {cells} |'


def _noise(case: Case) -> str:
    """Return the noise of both bodies in words."""
    return ', '.join(f'{o * 1e3:g} mm {r * 1e3:g} mrad' for o, r in (case.tool, case.package))


def _windows(case: Case) -> str:
    """Return the tool's rate and the half windows in words."""
    n = '' if case.half_windows == (0, 0) else ', n = {} and {}'.format(*case.half_windows)
    return f'{case.tool_rate:g} Hz{n}'


def main() -> None:
    """Print the table."""
    for line in table():
        print(line, flush=True)


if __name__ == '__main__':
    main()
