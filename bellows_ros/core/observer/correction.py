"""Estimates of a held package: carried along with the tool, corrected, and judged."""

from __future__ import annotations

from collections.abc import Mapping
import math
from typing import Any, NamedTuple

from bellows_ros.core.geometry.arrays import Array
from bellows_ros.core.geometry.jit import as_inputs
from bellows_ros.core.model.grip import one_of
from bellows_ros.core.model.kernels import Blocks, model_row, ModelTuple, ORIGIN, State
from bellows_ros.core.model.simulation import first_after
from bellows_ros.core.model.structure import composition, is_single, maps, places_of, UPPER
from bellows_ros.core.observer.alarms import Alarm, Alarms, Likeliest, processed
from bellows_ros.core.observer.filter import (
    ALL_ROWS,
    body_ahead,
    CAMERA,
    COM,
    DAMPING,
    driving,
    Estimate,
    Evidence,
    INERTIA,
    LATENCY,
    LEAST_ROWS,
    MARKER,
    MASS,
    NO_EVIDENCE,
    NOISE,
    NOT_FOLLOWED,
    STATE,
    STIFFNESS,
    WRENCH,
)
from bellows_ros.core.observer.measurement import (
    changed_by,
    FIRST_MEMORY,
    Measurement,
    OUT_OF_REACH,
    OUTSIDE,
    PoseSensor,
)
import numpy as np

GATE = 27.86
"""Squared Mahalanobis distance that 1 in 10,000 good measurements exceeds (chi^2 of 6)."""

WRONG_GATE, WRONG_NS = 8, 100_000_000
"""Consecutive measurements outside the gate, and their time (ns), after which the filter restarts
from them."""

NOTHING_SEEN = Measurement(0, *ORIGIN[:2], np.zeros((6, 6)))
"""Stands for a measurement where there is none."""

LEAST_ROOM = 4096
"""Smallest buffer of tool samples: seconds of them."""


START = np.repeat([0.01, 0.1, 0.5, 1.0], 3)
"""Standard deviations at the start: m, rad, m/s, rad/s."""

MASS_SHARE, COM_UNCERTAIN = 0.1, 0.01
"""Default standard deviations of the payload: relative mass, centre of mass (m)."""

UNCALIBRATED = 0.03, 0.05, 0.05
"""Standard deviations of position (m), rotation and latency (s) of a camera to be calibrated."""

BIAS_WALK, WALK_ARM = 0.01, 0.02
"""Random walk of the wrench bias per second: fraction of the weight, and moment by force (m)."""

BIAS_SHARE = 0.1
"""Initial bias, relative to the effect of the default payload uncertainty."""

OF_MOTION = (*range(STATE), *range(WRENCH, STIFFNESS), *range(NOISE, NOISE + 6))
"""Rows that are forgotten at a fresh start with the same package, ..."""

OF_PACKAGE = (*range(MASS, COM + 3), *range(MARKER, MARKER + 6), *range(INERTIA, ALL_ROWS))
"""... and with another one, too."""

NUMBERS = 54
"""K and P (6, 6) of a cup, as the kernels' blocks."""

NO_CUPS: Array = np.zeros((0, NUMBERS))
"""A gripper of one cup: if that is lost, the package is."""


def bias_walk(model: ModelTuple) -> Array:
    """Return the variances (6,) that the wrench beside the cup's gains in 1 s."""
    weight = model[1][0] * math.hypot(*model[2])
    walk: Array = np.square(BIAS_WALK * weight * np.repeat([1.0, WALK_ARM], 3))
    return walk


def first_memory(time_constant: float) -> Array:
    """Return the memory (s) of the noise before the first measurement, see `correlations`."""
    seconds, squares = FIRST_MEMORY
    products = squares * math.exp(-seconds / time_constant)
    memory: Array = np.r_[seconds, squares, squares, products, products, np.zeros(6)]
    return memory


def prior_std(values: Mapping[str, Any], model: ModelTuple) -> Array:
    """Return the standard deviations (n,) of the error at the start."""
    (_, _, *blocks), (mass, *_), gravity = (model[0][:4], *model[1:])
    weight = mass * math.hypot(*gravity)
    C = np.square(composition(places_of(values))[UPPER[0] == UPPER[1]])
    K, P = (
        np.minimum(np.sqrt(C @ np.square(np.reshape(values[f'cup.{name}_std'], (6, 6))[UPPER]))
                   / np.maximum(np.r_[matrix[0][::4], matrix[2][::4]], 1e-12), 1.0)
        for name, matrix in zip(('stiffness', 'damping'), blocks, strict=True))
    inertia = np.array(values['package.inertia_std'][:3])
    std: Array = np.zeros(ALL_ROWS if P.any() or inertia.any() else LEAST_ROWS)
    std[:STATE] = START
    mass, com = values['package.mass_std'] / mass, values['package.com_std']
    if values['payload.estimate']:
        mass, com = mass or MASS_SHARE, [each or COM_UNCERTAIN for each in com]
    std[MASS], std[COM:COM + 3] = mass, com
    std[WRENCH:WRENCH + 6] = BIAS_SHARE * weight * np.repeat([MASS_SHARE, COM_UNCERTAIN], 3)
    std[STIFFNESS:STIFFNESS + 6] = K
    offset, latency = values['measured.offset_std'], values['measured.latency_std']
    std[MARKER:MARKER + 6] = np.repeat(offset, 3)
    if values['measured.calibrate']:
        offset, latency = np.maximum(offset, UNCALIBRATED[:2]), max(latency, UNCALIBRATED[2])
    std[CAMERA:CAMERA + 6], std[LATENCY] = np.repeat(offset, 3), latency
    std[NOISE:NOISE + 6] = 1.0
    if len(std) > LEAST_ROWS:
        std[DAMPING:INERTIA], std[INERTIA:] = P, inertia
    return std


def cups_of(model: ModelTuple, places: Array) -> Array:
    """
    Return K and P (n, 54) of each cup of a gripper for strains at the origin.

    The model is that of the gripper, its cups are at places (n, 4), as of `places_of`.
    """
    if len(places) < 2 or is_single(places):
        return NO_CUPS
    return np.hstack([_of_each(matrix, places) for matrix in model[0][2:4]])


def _of_each(gripper: Blocks, places: Array) -> Array:
    """Return A_i^T K_1 A_i of each cup as rows (n, 27) of blocks."""
    oo, oR, RR = (np.reshape(block, (3, 3)) for block in one_of(gripper, places))
    A = maps(places)
    M = np.swapaxes(A, 1, 2) @ np.block([[oo, oR], [oR.T, RR]]) @ A
    return np.stack([M[:, :3, :3], M[:, :3, 3:], M[:, 3:, 3:]], axis=1).reshape(-1, 27)


class Track:
    """
    The tool's samples of the last moments, the package at each, as the kernels take them.

    Attributes
    ----------
    count, newest_ns : int
        How many samples there are, and the stamp of the newest.

    """

    def __init__(self) -> None:
        """Start without samples."""
        self._make(LEAST_ROOM)
        self.newest_ns = 0

    def _make(self, room: int) -> None:
        """Make room for samples."""
        self.count = 0
        stamps, (starts, ends) = np.zeros(room, np.int64), np.zeros((2, room, 13))
        bodies = np.zeros((room, 25))  # with internal strains, if there are any
        self.rows = as_inputs(stamps, starts, ends, bodies)

    def begin(self, stamp_ns: int) -> None:
        """Discard all but the start of a motion."""
        self.rows[0][0] = self.newest_ns = stamp_ns
        self.count = 1

    def after(self, stamp_ns: int) -> int:
        """Return the number of the first sample after a stamp."""
        return int(first_after(self.rows[0], stamp_ns, self.count))

    def make_room(self, since_ns: int) -> None:
        """Make room for another sample; discard those before a stamp."""
        if self.count < len(self.rows[0]):
            return
        before, kept = self.rows, slice(self.after(since_ns) - 1, self.count)
        self._make(max(LEAST_ROOM, 4 * (kept.stop - kept.start)))
        self.count = kept.stop - kept.start
        for old, new in zip(before, self.rows, strict=True):
            new[:self.count] = old[kept]


class Outcome(NamedTuple):
    """What a measured pose makes of an estimate."""

    known: Estimate
    verdict: str
    """`used`, `recovered`, `gate` or `out_of_reach`."""
    alarm: Alarm | None = None


class Correction:
    """
    The filter of one model: each method takes an estimate, and returns another.

    Parameters
    ----------
    values : mapping
        Parameters by name, as of `Observer`.
    sensor : PoseSensor
    model : tuple
        Nominal.
    longest, reach : float
        The longest step (s) of the model, and how far (m) a lip can be.

    Attributes
    ----------
    alarms : Alarms or None

    """

    def __init__(
        self, values: Mapping[str, Any], sensor: PoseSensor, model: ModelTuple, longest: float,
        reach: float,
    ) -> None:
        """Know what is uncertain."""
        self.nominal, self.longest, self.reach = model, longest, reach
        self.branches = model[0][4:]
        self._row = model_row(model)
        self.prior, self._walk = prior_std(values, model), bias_walk(model)
        self._marker, places = sensor.marker, places_of(values)
        self._cups = cups_of(model, places)
        allowed = values['alarm.false_per_hour']
        self.alarms = Alarms(
            allowed, len(self.prior), self._marker[2], places) if allowed > 0.0 else None
        self._steps = self.alarms.steps if self.alarms else NOT_FOLLOWED
        self.first_memory = first_memory(values['measured.memory'])
        self._tool_noise = np.repeat(
            [values['tool_noise.position'], values['tool_noise.rotation']], 3)

    def start(
        self, stamp_ns: int, tool: State, body: State, initial: tuple[Array, Array, Array],
        opened: tuple[int, ...],
    ) -> Estimate:
        """Return the estimate of a package at rest, with an initial theta, covariance, memory."""
        self._drive = driving(self.nominal, tool, body, self._tool_noise)
        return Estimate(
            stamp_ns, tool, body, *initial, self._evidence(stamp_ns, opened), opened)

    def row(self, opened: tuple[int, ...]) -> Any:
        """Return the `model_row` without those cups that are lost."""
        if not opened:
            return self._row
        row = np.array(self._row)
        row[2:2 + NUMBERS] -= self._cups[list(opened)].sum(axis=0)
        return row

    def _holding(self, opened: tuple[int, ...]) -> Array:
        """Return the cups, see `cups_of`, that hold; none where the last would be."""
        cups = np.delete(self._cups, list(opened), axis=0) if opened else self._cups
        return cups if len(cups) > 1 else NO_CUPS

    def _evidence(
        self, stamp_ns: int, opened: tuple[int, ...], is_first: bool = True
    ) -> Evidence:
        """Return that of no fault yet."""
        return NO_EVIDENCE if self.alarms is None else self.alarms.start(
            stamp_ns, len(self._holding(opened)), is_first)

    def _processed(
        self, known: Estimate, track: Track, stamp_ns: int, is_known: bool,
        seen: Measurement = NOTHING_SEEN, gate: float = 0.0,
    ) -> tuple[int, Estimate, Likeliest]:
        """Return verdict, estimate and faults by `processed`; a gate of zero sees nothing."""
        opened, evidence = known.opened, known.evidence
        verdict, tool, body, theta, P, memory, E, numbers, onsets, outcome = processed(
            self.row(opened), self.branches, known.theta, known.tool, known.body,
            known.covariance, known.memory, *track.rows, is_known, track.count, known.stamp_ns,
            stamp_ns, self.longest, self._drive, self._walk, evidence.signatures,
            evidence.numbers, evidence.onsets, evidence.is_first, self._steps,
            self._holding(opened), gate > 0.0, *seen[1:], self._marker, self.reach, gate)
        evidence = Evidence(E, numbers, onsets, evidence.half_way, evidence.is_first)
        return verdict, Estimate(
            stamp_ns, tool, body, theta, P, memory, evidence, opened, known.refused,
            known.away_ns), outcome

    def carried(
        self, known: Estimate, track: Track, stamp_ns: int, with_evidence: bool = True
    ) -> Estimate:
        """Return an estimate carried along with the tool, where the package has been before."""
        if not with_evidence:
            known = known._replace(evidence=NO_EVIDENCE)
        return self._processed(known, track, stamp_ns, True)[1]

    def body_at_end(self, known: Estimate, track: Track) -> State:
        """Return the package at the newest sample of the tool, and write it into the samples."""
        if known.stamp_ns == track.newest_ns:
            return known.body
        return body_ahead(
            self.row(known.opened), self.branches, known.theta, known.tool, known.body,
            *track.rows, track.count, known.stamp_ns, track.newest_ns, self.longest)

    def updated(
        self, before: Estimate, track: Track, seen: Measurement, is_known: bool
    ) -> Outcome:
        """Return the estimate after a measurement: the one before it where that is no package."""
        stamp_ns, opened, half_way = seen.stamp_ns, before.opened, before.evidence.half_way
        verdict, after, outcome = self._processed(before, track, stamp_ns, is_known, seen, GATE)
        if verdict == OUT_OF_REACH:
            return Outcome(before, 'out_of_reach')
        refused = (*before.refused, stamp_ns) if verdict == OUTSIDE else ()
        name = 'used' if not refused else 'recovered' if (
            len(refused) >= WRONG_GATE and stamp_ns - refused[0] >= WRONG_NS) else 'gate'
        if self.alarms is not None:  # what came back within the gate confirms nothing before
            is_back = before.refused and not refused
            half_way = self.alarms.half_way(() if is_back else half_way, stamp_ns, outcome[0])
        after = after._replace(
            evidence=after.evidence._replace(half_way=half_way), refused=refused,
            away_ns=before.away_ns if refused else 0)
        if self.alarms is not None and (
                fault := self.alarms.found(after.evidence, stamp_ns, outcome, opened)):
            opened += (fault.cup,) if fault.cup >= 0 else ()
            body, theta = changed_by(after.body, after.theta, fault.error)
            return Outcome(after._replace(  # the fault was taken for noise, too
                body=body, theta=theta, memory=self.first_memory, refused=(), opened=opened,
                evidence=self._evidence(stamp_ns, opened, False),
                covariance=after.covariance + fault.spread @ fault.spread.T), name, fault.alarm)
        if name == 'recovered':
            return Outcome(self._restarted(after, before.memory, track, seen), name)
        return Outcome(after, name)

    def _restarted(
        self, known: Estimate, memory: Array, track: Track, seen: Measurement
    ) -> Estimate:
        """Return an estimate as uncertain as at the start, corrected with what is seen there."""
        rows = np.r_[:STATE, WRENCH:WRENCH + 6]
        P = known.covariance.copy()
        P[rows, rows] += np.square(self.prior[rows])
        restarted = known._replace(covariance=P, memory=memory, evidence=NO_EVIDENCE)
        _, after, _ = self._processed(restarted, track, seen.stamp_ns, True, seen, math.inf)
        return after._replace(
            memory=memory, refused=(), away_ns=0,
            evidence=self._evidence(seen.stamp_ns, known.opened, False))
