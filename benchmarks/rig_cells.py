"""
Ordinary cells of an independent simulator, `../shared/cell/cycle_rig`, with faults.

Its C source is compiled into a temporary folder. It shares no line with the package.
"""

from collections.abc import Mapping
from functools import cache
import importlib
from pathlib import Path
import shutil
import subprocess
import sys
import tempfile
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from test.core.observer.contact_cell import CellCycle  # noqa: I100, I201

SOURCE = Path(__file__).parents[2] / 'shared/cell/cycle_rig'
EVERY = 2
"""Number of samples of 5 ms between two of the tool."""
HIT = 0.02
"""Duration of a collision, s."""


@cache
def world() -> Any:
    """Return the module of the simulator; raises FileNotFoundError without its source."""
    folder = Path(tempfile.mkdtemp())
    for file in ('cell.py', 'world.py', 'cell.c'):
        shutil.copy(SOURCE / file, folder)
    subprocess.run(['cc', '-O2', '-shared', '-fPIC', 'cell.c', '-o', 'libcell.so', '-lm'],
                   cwd=folder, check=True)
    sys.path.insert(0, str(folder))
    return importlib.import_module('world')


def cup() -> dict[str, Any]:
    """Return the parameters of the stated cup, with standard deviations."""
    rig, diagonal = world(), np.eye(6)
    return {'cup.stiffness': rig.K0.ravel().tolist(), 'cup.damping': rig.P0.ravel().tolist(),
            'cup.length': rig.L0, 'cup.stiffness_std': (0.03 * rig.K0 * diagonal).ravel().tolist(),
            'cup.damping_std': (0.2 * rig.P0 * diagonal).ravel().tolist()}


class RigCell:
    """A cell with its own errors, as `contact_cell.ContactCell`."""

    def __init__(self, seed: int) -> None:
        """Draw the cell."""
        self._draw, self._rng = world().Draw(seed), np.random.default_rng(seed)

    def cycle(
        self, fault: str = '', at_event: str = 'hold', after: float = 0.1, size: float = 1.0,
        gradual: float = 0.0,
    ) -> CellCycle:
        """Return a cycle with a fault, as `contact_cell.ContactCell.cycle` does."""
        rig, draw, g = world(), self._draw, self._rng
        path, t, stated, true = rig.cycle(draw, g)
        at = {'grip': t['held'], 'lift': t['lift'], 'move': t['move'], 'hold': t['hold'],
              'lower': t['lower'], 'low': t['placed'], 'valve': t['valve_off'],
              'release': t['released']}
        when = at['fault'] = at[at_event] + after
        way = np.r_[g.normal(size=2), g.normal() if fault in ('camera', 'collision') else 0.0]
        way *= size / np.linalg.norm(way)
        if fault == 'swap':
            true['m'], true['I'] = size * true['m'], size * true['I']
        if fault == 'drop':
            at['release'] = when + gradual + 0.05  # of the vacuum switch

        def slipped(y: np.ndarray, c: Any, given: Mapping[str, Any]) -> tuple[np.ndarray, Any]:
            y[:3] += y[3:12].reshape(3, 3) @ way
            return y, rig.cell(**{**given, 'com': given['com'] + way})

        def act(inputs: np.ndarray, times: np.ndarray) -> None:
            if fault == 'drop':
                fading = np.clip(1.0 - (times - when) / max(gradual, rig.H), 0.0, 1.0)
                inputs[:, :2] *= fading[:, None]
            elif fault == 'collision':
                arm = 0.5 * true['size'] * g.uniform(-1.0, 1.0, 3)
                hit = (times > when) & (times < when + HIT)
                inputs[hit, 4:] = np.r_[way, np.cross(arm, way)] / HIT

        times, E, Y = rig.simulate(draw, path, t, true, extra=act,
                                   hook={when: slipped} if fault == 'slip' else None)
        moved, size = way * (fault == 'camera'), size * (fault == 'latency')
        seen = rig.see(g, draw, times, Y, true, t, late=lambda t: size * (t > when),
                       bump=lambda t, o, R: (o + np.outer(t > when, moved), R))
        tool, truth = self._told(times, E), np.hstack([
            Y[:, :3], Rotation.from_matrix(Y[:, 3:12].reshape(-1, 3, 3)).as_quat()])
        return CellCycle(
            times[::EVERY], tool[::EVERY], truth[::EVERY],
            [(stamp, arrival, o, q) for stamp, o, q, arrival in seen], _stated(stated, draw.sd),
            at)

    def _told(self, times: np.ndarray, E: np.ndarray) -> np.ndarray:
        """Return the messages of the tool (N, 13), whose poses are late."""
        late = max(round(self._draw.lag / (times[1] - times[0])), 0)
        R = Rotation.from_matrix(E[:, 3:12].reshape(-1, 3, 3))
        pose = np.hstack([E[:, :3], R.as_quat()])[np.maximum(np.arange(len(E)) - late, 0)]
        tool = np.hstack([pose, R.apply(E[:, 12:15]), R.apply(E[:, 15:])])
        noise = [2e-5] * 3, [0.0] * 4, [5e-4] * 3, [1e-3] * 3
        return tool + np.concatenate(noise) * self._rng.normal(size=tool.shape)


def _stated(package: Mapping[str, Any], std: Mapping[str, Any]) -> dict[str, Any]:
    """Return the parameters package.* of the stated package."""
    inertia = np.diag(package['I'])
    return {
        'package.mass': float(package['m']), 'package.mass_std': std['mass'] * package['m'],
        'package.com': package['com'].tolist(),
        'package.com_std': [std['com'], std['com'], 0.5 * std['com']],
        'package.inertia': [*inertia.tolist(), 0.0, 0.0, 0.0],
        'package.inertia_std': [*(std['iner'] * inertia).tolist(), 0.0, 0.0, 0.0]}
