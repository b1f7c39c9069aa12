"""
The Cramer-Rao bound of K and P for recordings of poses with known truth.

    python -m benchmarks.bound PATH

writes PATH/bounds/SEED.json for all set-ups of a population, see `benchmarks.calibration`.

The path of the tool is unknown and arbitrary. With the noise n_E of the tool, of covariance R_E,
and the response G of the package to small motions of the tool, the information on the unknowns is
J' (R_B + G R_E G')^-1 J, computed at each frequency: G is that of the cup at rest, in body axes.
"""

import argparse
from collections.abc import Mapping
import json
from pathlib import Path
from typing import NamedTuple

from bellows_ros.core.geometry import lie
from bellows_ros.core.geometry.arrays import Array
from bellows_ros.core.identification.unknowns import given_std
from bellows_ros.core.model.cup_package import Cup, Package, varied
from bellows_ros.core.model.simulation import simulate
from bellows_ros.core.parameters.conversion import package_of
from bellows_ros.core.parameters.values import Values
from bellows_ros.core.signals.trajectory import Trajectory
from bellows_ros.files.parameter_files import read_parameters
from bellows_ros.workflows.identify import resolved
from bellows_ros.workflows.recordings import load
import numpy as np

STEP = 1e-3
"""Size of differences: relative for K, P, mass and inertia; m for com and length."""

PULSE_STD, PULSE_RATE, PULSE_SIZE = 2e-3, 1000.0, 1e-4
"""Width of a pulse of the tool, s; its sampling rate, Hz; its size, m and rad."""

TAPERED = 1.0
"""Time over which the ends of the recording lose their weight, s."""

AXES = 0, 2, 3, 5
"""Indices of the numbers of an axisymmetric cup."""

GROUPS = np.array([[1, 1, 0, 0, 0, 0], [0, 0, 1, 0, 0, 0], [0, 0, 0, 1, 1, 0], [0, 0, 0, 0, 0, 1]])
"""Equal entries of each of these numbers (4, 6)."""

NONE = np.zeros(6)

GIVEN = 'mass', 'com', 'inertia', 'length', 'package_marker', 'time_offset', 'clock_rate'
"""Given quantities with errors that a fit also estimates."""


class SensorNoise(NamedTuple):
    """Rate (Hz) and standard deviations (6,) of the poses of a body."""

    rate: float
    std: Array


def tool_path(t: Array, poses: Array) -> Trajectory:
    """Return poses (n, 4, 4) at times t as a trajectory with twists."""
    stamps = np.rint(t * 1e9).astype(np.int64)
    R, o = poses[:, :3, :3], poses[:, :3, 3]
    turn = lie.log_so3(np.swapaxes(R[:-1], 1, 2) @ R[1:]) / np.diff(t)[:, None]
    turn = np.vstack([turn[:1], (turn[1:] + turn[:-1]) / 2.0, turn[-1:]])
    velocity = lie.apply(np.swapaxes(R, 1, 2), np.gradient(o, t, axis=0, edge_order=2))
    return Trajectory(stamps, o, R, np.hstack([velocity, turn]))


def change(poses: Trajectory, reference: Trajectory) -> Array:
    """Return changes of poses (n, 6) from the reference, in its axes."""
    back = np.swapaxes(reference.rotation, 1, 2)
    return np.hstack([lie.apply(back, poses.position - reference.position),
                      lie.log_so3(back @ poses.rotation)])


def response(cup: Cup, package: Package, seconds: float, gravity: float) -> Array:
    """Return G (f, 6, 6), package to tool, at all multiples of 1 / seconds."""
    t = np.arange(round(seconds * PULSE_RATE)) / PULSE_RATE
    pulse = np.exp(-0.5 * ((t - 0.1) / PULSE_STD) ** 2)
    still = tool_path(t, np.tile(np.eye(4), (len(t), 1, 1)))
    rest = simulate(cup, package, still, gravity=gravity)
    columns = []
    for axis in np.eye(6):
        poses = np.tile(np.eye(4), (len(t), 1, 1))
        poses[:, :3, :3] = lie.exp_so3(PULSE_SIZE * pulse[:, None] * axis[3:])
        poses[:, :3, 3] = PULSE_SIZE * pulse[:, None] * axis[:3]
        moved = simulate(cup, package, tool_path(t, poses), gravity=gravity)
        columns.append(np.fft.rfft(change(moved, rest), axis=0))
    spectrum = PULSE_SIZE * np.fft.rfft(pulse)
    return np.asarray(np.stack(columns, axis=2) / spectrum[:, None, None])


def noise_spectrum(G: Array, tool: SensorNoise, package: SensorNoise, count: int) -> Array:
    """Return the covariance (count, 6, 6) of the differences at each frequency of the poses."""
    limit = int(tool.rate / 2.0 * count / package.rate)
    total = np.zeros((count, 6, 6), dtype=complex)
    for k in range(-limit, limit + 1):  # the tool's noise beyond the package's rate is aliased
        gain = G[k] if k >= 0 else G[-k].conj()
        total[k % count] += (gain * tool.std**2) @ gain.conj().T
    return total * (package.rate / tool.rate) + np.diag(package.std**2)


def jacobian(
    cup: Cup, package: Package, tool: Trajectory, gravity: float, given: Mapping[str, Array]
) -> Array:
    """
    Return the derivatives (n, 6, 8 + u) of the package's poses, in its axes.

    By the relative changes of K x, z, rx and rz, then of P, then by the given quantities.
    """
    reference = simulate(cup, package, tool, gravity=gravity)
    seconds = (tool.stamps_ns - tool.stamps_ns.mean())[:, None] * 1e-9

    def difference(K: Array = NONE, P: Array = NONE, length: float = 0.0, **body: Array) -> Array:
        ahead, behind = (
            change(simulate(
                Cup(cup.stiffness * np.exp(np.diag(step * K)),
                    cup.damping * np.exp(np.diag(step * P)), cup.length + step * length),
                varied(package, **{name: step * value for name, value in body.items()}),
                tool, gravity=gravity), reference)
            for step in (STEP, -STEP))
        return np.asarray((ahead - behind) / (2.0 * STEP))

    columns = [difference(K=group) for group in GROUPS] + [difference(P=group) for group in GROUPS]
    for name, std in given.items():
        for one in np.eye(len(std)):
            if name == 'package_marker':
                columns.append(np.tile(one, (len(reference), 1)))
            elif name == 'time_offset':
                columns.append(reference.twist)
            elif name == 'clock_rate':
                columns.append(reference.twist * seconds)
            elif name == 'length':
                columns.append(difference(length=1.0))
            else:
                columns.append(difference(**{name: one}))
    return np.stack(columns, axis=2)


def bound_of(
    values: Values, truth: Mapping[str, Array], tool: SensorNoise, package: SensorNoise
) -> tuple[Array, Array]:
    """
    Return the bounds (4,) of K x, z, rx, rz and of P, SI units, with the errors of given values.

    `truth` has K, P, times t (n,) and poses of the tool (n, 4, 4).
    """
    cup = Cup(truth['K'], truth['P'], values.cup.length)
    payload, gravity = package_of(values), values.gravity.magnitude
    given = {name: std for name, std in given_std(values).items() if name in GIVEN}
    path = tool_path(truth['t'], truth['tool'])
    every = round((len(path) - 1) / (truth['t'][-1] - truth['t'][0]) / package.rate)
    J = jacobian(cup, payload, path, gravity, given)[::every]
    count = len(J)
    from_end = np.minimum(np.arange(count), np.arange(count)[::-1]) / package.rate
    window = np.sin(0.5 * np.pi * np.minimum(from_end / TAPERED, 1.0)) ** 2
    spectrum = np.fft.fft(window[:, None, None] * J, axis=0)
    G = response(cup, payload, count / package.rate, gravity)
    whitened = np.linalg.solve(noise_spectrum(G, tool, package, count), spectrum)
    information = np.einsum('fiu,fiv->uv', spectrum.conj(), whitened).real / count
    information[np.diag_indices_from(information)] += np.concatenate(
        [np.zeros(8), *(std**-2.0 for std in given.values())])
    relative = np.sqrt(np.diag(np.linalg.inv(information)))
    sizes = np.concatenate([np.diag(M)[list(AXES)] for M in (cup.stiffness, cup.damping)])
    K, P = np.split(relative[:8] * sizes, 2)
    return K, P


def sensors_of(path: Path, values: Values) -> tuple[SensorNoise, SensorNoise]:
    """Return the sensors of tool and package of a recording."""
    recording = load(path, values)
    tool, package = (
        SensorNoise(float(1e9 / np.median(np.diff(poses.stamps_ns))), noise.std)
        for poses, noise in zip((recording.tool_pose, recording.package_pose),
                                recording.body_noise, strict=True))
    return tool, package


def write_bound(path: Path, seed: int) -> None:
    """Write the bound of a set-up whose truth has the path of the tool, unless it is there."""
    file, truth = path / 'bounds' / f'{seed}.json', np.load(path / f'{seed}_truth.npz')
    if file.exists() or truth['P'].ndim != 2 or 'tool' not in truth or truth['tool'].ndim != 3:
        return
    values = resolved({**read_parameters(path / f'{seed}.yaml'), 'bags': (str(path / str(seed)),)})
    K, P = bound_of(values, truth, *sensors_of(path / str(seed), values))
    file.parent.mkdir(exist_ok=True)
    file.write_text(json.dumps({'K': K.tolist(), 'P': P.tolist()}))
    print(seed, str(truth['kind']), 100.0 * K / np.diag(truth['K'])[list(AXES)],
          100.0 * P / np.diag(truth['P'])[list(AXES)], '%', flush=True)


def main() -> None:
    """Write the bounds of a population."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('path', type=Path, help='folder of the population')
    path = parser.parse_args().path
    for seed in sorted(int(each.stem) for each in path.glob('*.yaml')):
        write_bound(path, seed)


if __name__ == '__main__':
    main()
