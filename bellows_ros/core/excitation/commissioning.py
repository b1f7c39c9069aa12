"""Recordings beside an exciting motion: standstills before it, and a validation after it."""

from collections.abc import Callable, Iterable, Sequence
import itertools

from bellows_ros.core.excitation.arm_limits import ArmLimits
from bellows_ros.core.excitation.motion_design import all_ratios
from bellows_ros.core.geometry.lie import exp_so3, log_so3
from bellows_ros.core.model.grip import Grip
from bellows_ros.core.model.kernels import ModelTuple
from bellows_ros.core.synthetic.motion import MoveAndHold, Pose, Waypoints
from bellows_ros.errors import BellowsError
import numpy as np

REST, HOLD, STOPS = 2.0, 3.0, (0.0, 0.3)
"""Durations (s): the initial rest, one standstill, and the stops between moves."""

WORKSPACE_SHARE = 0.9
"""Fraction of the workspace and of the rotations that the standstills cover."""

SMOOTH_STEP_PEAKS = (1.875, 5.7736, 60.0)
"""Peak speed, acceleration and jerk of the smooth step from 0 to 1 within one second."""

SLOWER, MOST_TRIES = 1.15, 30


def standstills(
    limits: ArmLimits, models: Sequence[ModelTuple], grip: Grip | None
) -> Waypoints:
    """Return standstills upright and tilted to both sides, within the limits with any model."""
    tilt = WORKSPACE_SHARE * limits.turn[:2]
    turns = [(0, 0), (1, 0), (-1, 0), (0, 1), (0, -1), (0, 0)]

    def slowed(factor: float) -> Waypoints:
        poses = [Pose(limits.start.position, limits.start.rotation @ exp_so3(
            [x * tilt[0] / factor, y * tilt[1] / factor, 0.0])) for x, y in turns]
        return _through(poses, limits, factor, itertools.repeat(HOLD))

    return _within(slowed, limits, models, grip)


def everyday(
    limits: ArmLimits, models: Sequence[ModelTuple], grip: Grip | None, duration: float, seed: int,
) -> Waypoints:
    """Return moves from pose to pose, as quick as the limits let them be, for about a time (s)."""
    rng = np.random.default_rng(seed)
    draws = rng.uniform(-1.0, 1.0, (500, 6))
    middle = 0.5 * (limits.lower + limits.upper)
    reach = 0.5 * (limits.upper - limits.lower)
    poses = [Pose(middle + WORKSPACE_SHARE * reach * draw[:3], limits.start.rotation @ exp_so3(
        WORKSPACE_SHARE * limits.turn * draw[3:])) for draw in draws]

    def slowed(factor: float) -> Waypoints:
        whole = _through(poses, limits, factor, itertools.cycle(STOPS))
        ends = REST + np.cumsum([s.move + s.hold for s in whole.segments])
        count = max(1, int(np.searchsorted(ends, duration - 1.0)))
        back = [*poses[:count], limits.start]
        return _through(back, limits, factor, itertools.chain(
            itertools.islice(itertools.cycle(STOPS), count), [1.0]))

    return _within(slowed, limits, models, grip)


def _through(
    poses: Sequence[Pose], limits: ArmLimits, factor: float, holds: Iterable[float]
) -> Waypoints:
    """Return moves from the start through poses, slower than the arm can by a factor."""
    segments, here = [], limits.start
    for pose, hold in zip(poses, holds, strict=False):
        way = float(np.linalg.norm(pose.position - here.position))
        angle = float(np.linalg.norm(log_so3(here.rotation.T @ pose.rotation)))
        shortest = max(
            (steep * size / most) ** (1.0 / order)
            for order, steep, size, most in zip(
                2 * (1, 2, 3), 2 * SMOOTH_STEP_PEAKS, [way] * 3 + [angle] * 3,
                limits.rates.values(),
                strict=True))
        segments.append(MoveAndHold(pose, max(0.05, 1.001 * factor * shortest), hold))
        here = pose
    return Waypoints(limits.start, REST, tuple(segments))


def _within(
    slowed: Callable[[float], Waypoints], limits: ArmLimits, models: Sequence[ModelTuple],
    grip: Grip | None,
) -> Waypoints:
    """Return the first of ever slower motions that is within the limits."""
    factor, ratios = 1.0, {'': 1.0}
    for _ in range(MOST_TRIES):
        motion = slowed(factor)
        ratios = all_ratios(motion, limits, models, grip)
        if max(ratios.values()) <= 1.0:
            return motion
        factor *= SLOWER
    worst = max(ratios, key=lambda name: ratios[name])
    raise BellowsError(
        f'No standstills or moves meet the limits: {worst} is {ratios[worst]:.3g} times its '
        'limit, even slowly. Raise the limit, or start in another pose.')
