"""
What the prediction-error method minimises: whitened innovations as a function of free numbers.

The stretches of the recordings are kept in the form of the kernels. Derivatives are differences;
their columns are shared among the cores.
"""

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
import copy
from dataclasses import replace
import os
from typing import NamedTuple

from bellows_ros.core.equilibrium import static_equilibrium
from bellows_ros.core.identification.noise import Noise
from bellows_ros.core.identification.prediction.innovations import innovations, Observer, observer
from bellows_ros.core.identification.prediction.measured import Measured
from bellows_ros.core.identification.prediction.parametrisation import Chart
from bellows_ros.core.kernels import ModelTuple, State
from bellows_ros.core.lie import rotation_to_quaternion
from bellows_ros.core.linearisation import displaced, largest_step
from bellows_ros.core.model import Cup, model_tuple
from bellows_ros.core.resampling import resample
from bellows_ros.core.simulation import state_row, tool_rows
from bellows_ros.core.trajectory import NS_PER_S, Trajectory
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

SMALLEST_TOOL_PART = 1e-3
"""The tool's noise is taken as at least this part of the package's: the observer needs some."""

SMALLEST_NOISE = Noise(2e-7, 2e-6)
"""Noise (m, rad) below which a stream is not taken to be: interpolation and rounding."""

START_PERIOD = 0.01
"""Time (s) in which a pose's noise makes the scale of the first twist."""

STEP = 1e-4
"""Difference of the free numbers for derivatives; they are logarithms or near one."""

STEPS_PER_LARGEST = 0.4
"""Integration steps are longer than those of a simulation: 4e-5 of a motion is below noise."""

MOST_SUBSTEPS = 20
KEPT_ROWS = 8
KEPT_CUPS = 256
"""Cups whose observers are kept: as many as a full fit's derivatives and replicas ask for."""

SENSELESS = 1e4
"""What stands for an innovation that is not finite, in standard deviations."""


class Prepared(NamedTuple):
    """What a cup makes of a stretch before its innovations are computed."""

    model: ModelTuple
    filtering: Observer
    substeps: NDArray[np.int64]
    whitening: Array


class Stretch:
    """A stretch in the form of the kernels, with the state that its start is counted from."""

    def __init__(self, measured: Measured, cup: Cup) -> None:
        self.measured = measured
        package = measured.package
        self.package = np.hstack([package.position, rotation_to_quaternion(package.rotation)])
        self.durations = np.diff(package.stamps_ns) / NS_PER_S
        self.period = float(np.median(self.durations))
        self.noise = Noise(*map(max, measured.package_noise, SMALLEST_NOISE))
        pose = np.array([self.noise.position] * 3 + [self.noise.rotation] * 3)
        self.start_scale = np.concatenate([pose, pose / START_PERIOD])
        self._rows: dict[float, Array] = {}
        self._prepared: dict[tuple[bytes, bytes, float], Prepared] = {}
        row = self.tool_rows()[0]
        self.tool_start = state_row(row[:3], row[3:7], row[7:])
        self.rest = static_equilibrium(self.model(cup), self.tool_start)
        self.origin = self._first_state()

    def with_poses(self, tool: Trajectory, package: Trajectory) -> 'Stretch':
        """Return the stretch with other poses, but its start and observers."""
        other = copy.copy(self)
        other.measured = replace(self.measured, tool=tool, package=package)
        other.package = np.hstack([package.position, rotation_to_quaternion(package.rotation)])
        other._rows = {}
        return other

    def tool_rows(self, delay: float = 0.0) -> Array:
        """Return the tool's rows at the package's stamps plus a delay (s)."""
        if delay not in self._rows:
            if len(self._rows) > KEPT_ROWS:
                self._rows.clear()
            stamps = self.measured.package.stamps_ns + round(delay * NS_PER_S)
            self._rows[delay] = tool_rows(resample(self.measured.tool, stamps))
        return self._rows[delay]

    def model(self, cup: Cup) -> ModelTuple:
        """Return cup, package and gravity for the kernels."""
        return model_tuple(cup, self.measured.held, self.measured.gravity)

    def prepared(self, cup: Cup, inflation: float) -> Prepared:
        """Return model, observer and steps for this cup, with the tool's noise made larger."""
        key = (cup.stiffness.tobytes(), cup.damping.tobytes(), inflation)
        if key not in self._prepared:
            if len(self._prepared) > KEPT_CUPS:
                self._prepared.clear()
            self._prepared[key] = self._prepare(cup, inflation)
        return self._prepared[key]

    def _prepare(self, cup: Cup, inflation: float) -> Prepared:
        part = max(inflation, SMALLEST_TOOL_PART)
        tool = Noise(
            *(float(np.hypot(own, part * package))
              for own, package in zip(self.measured.tool_noise, self.noise, strict=True)))
        model = self.model(cup)
        filtering = observer(
            model, self.tool_start, self.rest, self.period, self.measured.tool_period, tool,
            self.noise,
        )  # fmt: skip
        longest = largest_step(model) / STEPS_PER_LARGEST
        substeps = np.clip(np.ceil(self.durations / longest - 1e-9), 1, MOST_SUBSTEPS)
        whitening = np.linalg.inv(np.linalg.cholesky(filtering.covariance))
        return Prepared(model, filtering, substeps.astype(np.int64), whitening)

    def whitened(self, prepared: Prepared, start: Array, delay: float) -> Array:
        """Return the innovations (6 n,) of the n poses that count, in units of their spread."""
        e = innovations(
            prepared.model, self.start(start), self.tool_rows(delay), self.package,
            self.measured.package.valid, self.durations, prepared.substeps, prepared.filtering,
        )  # fmt: skip
        # not a product of matrices: threads of linear algebra would fight for the cores here
        white = np.einsum('ij,nj->ni', prepared.whitening, e[self.measured.counted])
        white[~np.isfinite(white)] = SENSELESS
        return np.asarray(white.ravel())

    def start(self, offset: Array) -> State:
        """Return the first state, offset (12,) in units of the start scale from the guess."""
        d = (offset * self.start_scale).tolist()
        o, q, v, w = displaced(self.origin, (d[0], d[1], d[2]), (d[3], d[4], d[5]))
        return (
            o, q,
            (v[0] + d[6], v[1] + d[7], v[2] + d[8]),
            (w[0] + d[9], w[1] + d[10], w[2] + d[11]),
        )  # fmt: skip

    def _first_state(self) -> State:
        """Return a guess of the first state: the package as it is seen, or hangs, at rest."""
        if not self.measured.package.valid[0]:
            return self.rest
        return state_row(self.package[0, :3], self.package[0, 3:], np.zeros(6))


class Objective:
    """
    The whitened innovations as a function of the free numbers.

    These are the chart's for K and P, 12 for the start of every stretch, and a delay (in ms) for
    every recording where delays are wanted.
    """

    def __init__(
        self, stretches: list[Stretch], cup_length: float, chart: Chart, delays: int
    ) -> None:
        self.stretches = stretches
        self.cup_length = cup_length
        self.chart = chart
        self.delays = delays
        self.inflation = 0.0
        self._pool = ThreadPoolExecutor(os.cpu_count() or 1)

    def with_stretches(self, stretches: list[Stretch]) -> 'Objective':
        """Return the same objective of other stretches, as many of them."""
        return Objective(stretches, self.cup_length, self.chart, self.delays)

    def with_chart(self, chart: Chart) -> 'Objective':
        """Return the same objective with K and P of other free numbers."""
        return Objective(self.stretches, self.cup_length, chart, self.delays)

    @property
    def size(self) -> int:
        """Number of free numbers."""
        return self._first_delay + self.delays

    @property
    def _first_delay(self) -> int:
        return self.chart.size + 12 * len(self.stretches)

    def cup(self, theta: Array) -> Cup:
        """Return the cup of the free numbers."""
        return Cup(*self.chart.matrices(theta[: self.chart.size]), self.cup_length)

    def start_of(self, theta: Array, i: int) -> Array:
        """Return the free numbers (12,) of a stretch's start."""
        begin = self.chart.size + 12 * i
        return theta[begin:begin + 12]

    def delay_of(self, theta: Array, i: int) -> float:
        """Return the delay (s) of a stretch."""
        if not self.delays:
            return 0.0
        return 1e-3 * float(theta[self._first_delay + self.stretches[i].measured.recording])

    def prepared(self, theta: Array) -> list[Prepared]:
        """Return what the cup of the free numbers makes of every stretch."""
        cup = self.cup(theta)
        return [stretch.prepared(cup, self.inflation) for stretch in self.stretches]

    def residuals(self, theta: Array) -> Array:
        """Return the whitened innovations of all stretches, one after the other."""
        prepared = self.prepared(theta)
        return np.concatenate(
            [self._of(i, prepared[i], theta) for i in range(len(self.stretches))])

    def jacobian(self, theta: Array, columns: Sequence[int] | None = None) -> Array:
        """Return the derivatives of the residuals by all free numbers, or by some of them."""
        wanted = range(self.size) if columns is None else columns
        base = self.prepared(theta)
        here = [self._of(i, base[i], theta) for i in range(len(self.stretches))]
        ends = np.cumsum([0, *map(len, here)])
        J = np.zeros((ends[-1], len(wanted)))

        def write(at: int, j: int, prepared: list[Prepared]) -> None:
            moved = _moved(theta, j)
            for i in self._touched(j):
                change = self._of(i, prepared[i], moved) - here[i]
                J[ends[i]:ends[i + 1], at] = change / STEP

        jobs = []
        for at, j in enumerate(wanted):  # observers here: the threads run compiled code only
            prepared = self.prepared(_moved(theta, j)) if j < self.chart.size else base
            jobs.append(self._pool.submit(write, at, j, prepared))
        for job in jobs:
            job.result()
        return J

    def _touched(self, j: int) -> list[int]:
        """Return the stretches that a free number has an effect on."""
        if j < self.chart.size:
            return list(range(len(self.stretches)))
        if j < self._first_delay:
            return [(j - self.chart.size) // 12]
        recording = j - self._first_delay
        return [i for i, s in enumerate(self.stretches) if s.measured.recording == recording]

    def _of(self, i: int, prepared: Prepared, theta: Array) -> Array:
        """Return the whitened innovations of one stretch."""
        return self.stretches[i].whitened(
            prepared, self.start_of(theta, i), self.delay_of(theta, i))


def _moved(theta: Array, j: int) -> Array:
    """Return the free numbers with one of them changed a little."""
    moved = theta.copy()
    moved[j] += STEP
    return moved
