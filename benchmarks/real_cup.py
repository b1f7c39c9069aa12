"""
The spring law on poses and wrenches of a real suction cup at rest.

    python -m benchmarks.real_cup PATH

PATH is `scripts_control/vc_calibration_Nmm.json` of the public repository
CaptainCabbage/suctioncup_cal (GitHub; no licence, so no copy is kept here): 1,697 poses of an arm
that holds one small cup on a fixed plate, each with the wrench of a six-axis sensor, in mm, N and
N mm. Every band of cup lengths is fitted on one half of its poses and judged on the other half,
for 20 random halves, by the spring law and by any linear map from pose to wrench (42 numbers).
The wrench at rest is a constant at the lip and a constant at the sensor (12 numbers), as a
vacuum, its hose and the zero of the sensor are constant there; with K the law has 33 numbers.
"""

import argparse
import json
from pathlib import Path
from typing import NamedTuple

from bellows_ros.core.geometry import lie
from bellows_ros.core.geometry.arrays import Array
from bellows_ros.core.model.cup_package import regressor
from bellows_ros.core.model.structure import STRUCTURES
import numpy as np

BANDS = (8.0, 11.0), (10.0, 13.0), (11.0, 15.0), (13.0, 17.0), (15.0, 19.0), (18.0, 22.0)
"""Ranges of the cup's length, mm."""

ALL = 7.0, 22.0
"""Range of all lengths, mm."""

MAX_TILT = np.radians(12.0)
"""Largest rotation of the lip in the tool, rad."""

HALVES = 20
"""Random halves of each band."""

SCALE = np.repeat([1.0, 100.0], 3)
"""Weights of forces (1/N) and moments (1/(N m)): their scatter is 1 N and 0.01 N m."""


class Poses(NamedTuple):
    """Poses E_o_S (n, 3), m, and E_R_S (n, 3, 3) with wrenches (n, 6) on the package at S."""

    o: Array
    R: Array
    wrench: Array

    def chosen(self, places: Array) -> 'Poses':
        """Return the poses at these places."""
        return Poses(self.o[places], self.R[places], self.wrench[places])


def read(path: Path) -> Poses:
    """
    Read the poses and the wrenches at the contact.

    The file has the pose of the tool in the contact frame, with z away from the arm.
    """
    data = {name: np.array(rows, dtype=float).T
            for name, rows in json.loads(path.read_text()).items()}
    axes = np.diag([1.0, -1.0, -1.0])
    quaternion = data['ref_cartesians'][:, [4, 5, 6, 3]]
    R_S_E = lie.quaternion_to_rotation(
        quaternion / np.linalg.norm(quaternion, axis=1, keepdims=True))
    R_E_S = np.swapaxes(R_S_E, 1, 2)
    o = -lie.apply(axes @ R_E_S, 1e-3 * data['ref_cartesians'][:, :3])
    force, moment = np.split(data['ref_contact_wrenches'], 2, axis=1)
    return Poses(o, axes @ R_E_S @ axes, np.hstack([force @ axes, 1e-3 * moment @ axes]))


def law_columns(poses: Poses) -> Array:
    """Return the columns (n, 6, 33) of K, a constant at the lip, and a constant at the sensor."""
    at_rest, count = np.zeros((len(poses.o), 6)), len(poses.o)
    length = float(-poses.o[:, 2].mean())
    springs = regressor(
        length, STRUCTURES['full'].basis, poses.o, poses.R, at_rest)[:, :, :21]
    sensor = np.swapaxes(lie.adjoint(lie.transform(poses.R, poses.o)), 1, 2)
    return np.concatenate([springs, np.broadcast_to(np.eye(6), (count, 6, 6)), sensor], axis=2)


def linear_columns(poses: Poses) -> Array:
    """Return the columns (n, 6, 42) of a linear map of the pose, with a constant."""
    x = np.hstack([
        poses.o - poses.o.mean(axis=0), lie.log_so3(poses.R), np.ones((len(poses.o), 1))])
    return np.einsum('ij,nk->nijk', np.eye(6), x).reshape(len(x), 6, 42)


def explained(columns: Array, wrench: Array, train: Array, test: Array) -> tuple[Array, Array]:
    """Return the explained part (6,) of the variance of held-out wrenches, and the numbers."""
    A, y = columns * SCALE[:, None], wrench * SCALE
    numbers = np.linalg.lstsq(A[train].reshape(-1, A.shape[2]), y[train].ravel(), rcond=None)[0]
    residual = y[test] - A[test] @ numbers
    return 1.0 - residual.var(axis=0) / y[test].var(axis=0), numbers


def row(poses: Poses, band: tuple[float, float], seed: int = 0) -> str:
    """Return the line of a table for one band of lengths, mm: medians over random halves."""
    length, tilt = -1e3 * poses.o[:, 2], np.linalg.norm(lie.log_so3(poses.R), axis=1)
    inside = poses.chosen(np.flatnonzero(
        (length >= band[0]) & (length <= band[1]) & (tilt <= MAX_TILT)))
    law, linear, random = law_columns(inside), linear_columns(inside), np.random.default_rng(seed)
    parts, stiffness = [], []
    for _ in range(HALVES):
        train, test = np.array_split(random.permutation(len(inside.o)), 2)
        by_law, numbers = explained(law, inside.wrench, train, test)
        parts.append((by_law, explained(linear, inside.wrench, train, test)[0]))
        stiffness.append(numbers[[0, 6, 11]])
    (fx, fy, fz, *_), (lx, ly, lz, *_) = 100.0 * np.median(parts, axis=0)
    kx, ky, kz = np.median(stiffness, axis=0)
    return (f'| {band[0]:.0f} to {band[1]:.0f} mm | {len(inside.o)} '
            f'| {fx:.0f}, {fy:.0f}, {fz:.0f} % | {lx:.0f}, {ly:.0f}, {lz:.0f} % '
            f'| {kx:.0f}, {ky:.0f} | {kz:.0f} |')


def main() -> None:
    """Print the table of docs/evidence.md."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('path', type=Path, help='vc_calibration_Nmm.json')
    poses = read(parser.parse_args().path)
    print('| length | poses | spring law: force x, y, z | linear map | K x, y (N/m) | K z |')
    print('|---|---|---|---|---|---|')
    for band in (*BANDS, ALL):
        print(row(poses, band))


if __name__ == '__main__':
    main()
