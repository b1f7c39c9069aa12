"""The state of the held package: started at rest, carried along with the tool, extrapolated."""

from __future__ import annotations

import math
from typing import NamedTuple

from bellows_ros.core.equilibrium import static_equilibrium
from bellows_ros.core.integrator import advance
from bellows_ros.core.jit import kernel
from bellows_ros.core.kernels import held_wrench, ModelTuple, State, Wrench
from bellows_ros.core.linearisation import largest_step, substeps_for
from bellows_ros.core.live.samples import Prediction, ZERO
from bellows_ros.core.model import Cup, model_tuple, Package
from bellows_ros.core.tuples import (
    add_scaled,
    apply,
    apply_transposed,
    dot,
    exp_quaternion,
    quaternion_product,
    rotation_matrix,
    scale,
)
from bellows_ros.errors import BellowsError
import numpy as np

MOST_SUBSTEPS = 10_000
"""Of one advance; more is a cup so stiff, or a time so long, that it counts as diverged."""

RETRY_NS = 100_000_000
"""Time (ns) after which rest is sought again where there was none: that takes milliseconds."""


@kernel
def advance_and_hold(
    model: ModelTuple, body: State, before: State, now: State, duration: float, substeps: int
) -> tuple[State, Wrench, bool]:
    """Return the package at the newest tool sample, the cup's wrench, and if all are finite."""
    body = advance(model, body, before, now, duration, substeps)
    wrench = held_wrench(model, now, body)
    o, q, v, w = body
    f, m = wrench
    total = dot(o, o) + dot(v, v) + dot(w, w) + dot(f, f) + dot(m, m) + q[0] + q[3]
    return body, wrench, total - total == 0.0


@kernel
def extrapolated(tool: State, duration: float) -> State:
    """Return the tool a time later, its tip going on straight and its rotation steadily."""
    o, q, v, w = tool
    velocity = apply(rotation_matrix(q), v)
    q_later = quaternion_product(q, exp_quaternion(scale(duration, w)))
    return (
        add_scaled(o, duration, velocity), q_later,
        apply_transposed(rotation_matrix(q_later), velocity), w,
    )  # fmt: skip


class Sample(NamedTuple):
    """The tool and the package at one instant."""

    stamp_ns: int
    tool: State
    body: State


class HeldPackage:
    """
    A package on a cup, and the tool sample it was last computed for.

    Parameters
    ----------
    cup, package : Cup, Package
    gravity : float
        m/s^2, along -z of the world.

    Attributes
    ----------
    outcome : str
        What went wrong in the last call: 'diverged', 'no_equilibrium', or nothing.

    """

    def __init__(self, cup: Cup, package: Package, gravity: float) -> None:
        """Prepare the model; the package is nowhere yet."""
        self._gravity = gravity
        self.set_model(cup, package)
        self.forget()

    @property
    def model(self) -> ModelTuple:
        """The model as the kernels take it."""
        return self._model

    @property
    def is_held(self) -> bool:
        """Whether the package has a state from which it can be advanced."""
        return self._sample is not None

    def set_model(self, cup: Cup, package: Package) -> None:
        """Go on with another cup or package; pose and motion stay as they are."""
        self._model, self._longest_step = self.prepared(cup, package)
        self._retry_ns = -1

    def prepared(self, cup: Cup, package: Package) -> tuple[ModelTuple, float]:
        """
        Return the model of another cup or package, and the longest step (s) it is integrated with.

        Raises
        ------
        BellowsError
            If nothing can be computed with it: its numbers are too large or too small.

        """
        model = model_tuple(cup, package, self._gravity)
        try:
            with np.errstate(all='ignore'):
                return model, largest_step(model)
        except (ArithmeticError, ValueError) as error:
            raise BellowsError(
                f'Nothing can be computed with this cup and package ({error}). Check '
                'package.mass, package.inertia, cup.stiffness, cup.damping and their units.'
            ) from None

    def forget(self) -> None:
        """Let the next tool sample start from rest."""
        self._sample: Sample | None = None
        self._coasted: Sample | None = None
        self._retry_ns = -1
        self.outcome = ''

    def follow(self, stamp_ns: int, before: State | None, now: State) -> Prediction | None:
        """
        Advance to a tool sample, or start from rest there.

        Parameters
        ----------
        stamp_ns : int
            Of the sample.
        before : State, optional
            A better estimate of the tool at the sample before, where there is one.
        now : State
            Pose and body twist of the tool at the stamp.

        """
        self._coasted = None
        self.outcome = ''
        last = self._sample
        if last is None:
            return self._start(stamp_ns, now)
        result = self._advanced(
            last.body, before or last.tool, now, (stamp_ns - last.stamp_ns) * 1e-9)
        if result is None:
            self.outcome = 'diverged'
            return self._start(stamp_ns, now)
        body, (force, moment) = result
        self._sample = Sample(stamp_ns, now, body)
        return Prediction(stamp_ns, *body, force, moment, now)

    def coast(self, stamp_ns: int) -> Prediction | None:
        """
        Predict with the tool going on as it did; the state for the next sample stays as it is.

        Returns None when there is nothing to go on from.
        """
        base = self._coasted or self._sample
        if base is None or stamp_ns <= base.stamp_ns:
            return None
        duration = (stamp_ns - base.stamp_ns) * 1e-9
        tool = extrapolated(base.tool, duration)
        result = self._advanced(base.body, base.tool, tool, duration)
        if result is None:
            return None
        body, (force, moment) = result
        self._coasted = Sample(stamp_ns, tool, body)
        return Prediction(stamp_ns, *body, force, moment, tool, True)

    def _advanced(
        self, body: State, start: State, end: State, duration: float
    ) -> tuple[State, Wrench] | None:
        """Return the package and the wrench at the end, or None if they are not finite."""
        substeps = substeps_for(duration, self._longest_step)
        if substeps > MOST_SUBSTEPS:
            return None
        try:
            body, wrench, sound = advance_and_hold(
                self._model, body, start, end, duration, substeps)
        except (ArithmeticError, ValueError):  # interpreted kernels raise where compiled give nan
            return None
        return (body, wrench) if sound else None

    def _start(self, stamp_ns: int, tool: State) -> Prediction | None:
        """Let the package hang at rest from the tool, if it can."""
        self._sample = None
        is_due = stamp_ns >= self._retry_ns
        body = self._rest(tool) if is_due else None
        if body is None:
            self._retry_ns = stamp_ns + RETRY_NS if is_due else self._retry_ns
            self.outcome = 'no_equilibrium'
            return None
        force, moment = held_wrench(self._model, (tool[0], tool[1], ZERO, ZERO), body)
        self._sample = Sample(stamp_ns, tool, body)
        return Prediction(stamp_ns, *body, force, moment, tool)

    def _rest(self, tool: State) -> State | None:
        """Return the package at rest, or None if it cannot rest there with finite numbers."""
        try:
            body = static_equilibrium(self._model, tool)
            wrench = held_wrench(self._model, (tool[0], tool[1], ZERO, ZERO), body)
        except (BellowsError, ArithmeticError, ValueError):
            return None
        sound = all(map(math.isfinite, (*body[0], *body[1], *wrench[0], *wrench[1])))
        return body if sound else None
