"""
Twists at the poses' stamps: paired, interpolated or given up, at any two rates; or estimated.

The estimate is exact on quadratics, and of second order on smooth motions.
"""

from bellows_ros.core.geometry.lie import exp_so3, rotation_to_quaternion
from bellows_ros.core.geometry.tuples import ZERO
from bellows_ros.core.live.tool_twist import Pairing, ToolMotion, TwistSample
from bellows_ros.core.signals.screening import PoseSample
import numpy as np
from numpy.testing import assert_allclose
import pytest

from ...cell.motion import MS, ShakenTool, START, UPRIGHT


def pose(stamp_ns):
    return PoseSample(START + stamp_ns, ZERO, UPRIGHT)


def twist(stamp_ns):
    """Return a twist that grows steadily: interpolation is exact."""
    t = stamp_ns * 1e-9
    return TwistSample(START + stamp_ns, (t, 2 * t, 0.0), (0.0, 0.0, -t))


def run(pose_period, twist_period, offset=0):
    """Send a second of both in the order of their stamps; return what goes on, and delays."""
    pairing = Pairing()
    pairing.expect = True
    events = [(t, 0) for t in range(MS, 1000 * MS, pose_period)]
    events += [(t, 1) for t in range(MS + offset, 1000 * MS, twist_period)]
    out = []
    for now, is_twist in sorted(events):
        (pairing.add_twist(twist(now)) if is_twist else pairing.add_pose(pose(now)))
        out += [(p, v, now - (p.stamp_ns - START)) for p, v in pairing.ready()]
    return out


def check(out, pose_period):
    """Every pose once and in order, and each twist right for its stamp."""
    stamps = [p.stamp_ns - START for p, _, _ in out]
    assert stamps == list(range(MS, MS + len(out) * pose_period, pose_period))
    for p, v, _ in out:
        if v is not None:
            t = (p.stamp_ns - START) * 1e-9
            assert_allclose(v.linear, (t, 2 * t, 0.0), atol=1e-4)  # the pairing's tolerance
            assert_allclose(v.angular, (0.0, 0.0, -t), atol=1e-4)


@pytest.mark.parametrize('twist_period', [MS, 2 * MS, 4 * MS])
@pytest.mark.parametrize('offset', [0, MS // 3])
def test_twists_as_often_or_more_often_serve_every_pose(twist_period, offset):
    out = run(4 * MS, twist_period, offset=offset)
    check(out, 4 * MS)
    without = sum(v is None for _, v, _ in out)
    assert without <= 1  # the first may have nothing before it
    assert max(delay for _, _, delay in out) <= twist_period


@pytest.mark.parametrize(('poses', 'twists'), [(2 * MS, 8 * MS), (33 * MS, 33 * MS)])
def test_seldom_twists_do_not_hold_up_the_poses(poses, twists):
    """Of twists after several poses, or too far from each other for an interpolation."""
    out = run(poses, twists, offset=MS // 3)
    check(out, poses)
    delays = [delay for p, _, delay in out if p.stamp_ns - START > 2.5 * twists]
    assert max(delays) == 0
    assert len(out) == len(range(MS, 1000 * MS, poses))


@pytest.mark.parametrize('ahead_ns', [0, 3_600_000 * MS, 450 * MS, 50 * MS])
def test_a_lost_or_future_twist_does_not_block_poses(ahead_ns):
    pairing = Pairing()
    pairing.expect = True
    out = []
    for k in range(1, 50):
        pairing.add_pose(pose(k * MS))
        out += pairing.ready()  # one that does not wait goes on without its twist
        if k == 25 and ahead_ns:
            pairing.add_twist(twist(k * MS)._replace(stamp_ns=START + k * MS + ahead_ns))
        if k != 25 or ahead_ns:
            pairing.add_twist(twist(k * MS))
        out += pairing.ready()
    assert all(v is not None for _, v in out) and len(out) == 49
    assert pairing.refused['twist_stamp'] == bool(ahead_ns)


def test_random_arrivals_lose_no_pose_and_keep_the_order():
    rng = np.random.default_rng(3)
    for _ in range(50):
        pairing, out = Pairing(), []
        pairing.expect = bool(rng.integers(2))
        times = np.arange(1, 200) * MS
        events = [(t + rng.integers(0, 30 * MS), 1, t) for t in times if rng.random() > 0.1]
        events += [(t + 15 * MS, 0, t) for t in times]
        for _, is_twist, stamp in sorted(events):
            (pairing.add_twist(twist(int(stamp))) if is_twist else pairing.add_pose(
                pose(int(stamp))))
            out += pairing.ready()
        pairing.release_waiting_poses()
        out += pairing.ready()
        check([(p, v, 0) for p, v in out], MS)
        assert len(out) == 199


def filled(positions, rotations, stamps_ns):
    """Return a history that has seen these poses."""
    history = ToolMotion(in_world=True)
    for o, R, stamp in zip(positions, rotations, stamps_ns, strict=True):
        history.add(PoseSample(int(stamp), tuple(o), tuple(rotation_to_quaternion(R))))
    return history


@pytest.mark.parametrize('count', [3, 5, 9])
@pytest.mark.parametrize('back', [0, 1])
def test_exact_on_quadratics_even_with_uneven_stamps(count, back):
    rng = np.random.default_rng(count)
    stamps = 1_760_000_000_000_000_000 + np.cumsum(rng.integers(1_000_000, 9_000_000, count))
    t = (stamps - stamps[count - 1 - back]) * 1e-9
    a, b, c, d, e = rng.standard_normal((5, 3))
    R_now = exp_so3(a)
    positions = b + np.outer(t, c) + np.outer(t**2, d)
    rotations = R_now @ exp_so3(np.outer(t, e) + np.outer(t**2, a))
    o, _, v, w = filled(positions, rotations, stamps).state(back)
    assert_allclose(o, b, atol=1e-15)
    assert_allclose(v, R_now.T @ c, atol=1e-10)
    assert_allclose(w, e, atol=1e-10)


def lagging(late, noise, seed, seconds=6.0):
    """Yield the history of poses later than their twists, and the moved, seen and true place."""
    rng, motion = np.random.default_rng(seed), ShakenTool(np.random.default_rng(1))
    history = ToolMotion(in_world=False)
    for t in np.arange(0.0, seconds, 0.008):
        o, R, _ = motion.at(t - late)
        seen = PoseSample(START + round(t * 1e9), tuple(o + noise * rng.normal(size=3)),
                          tuple(rotation_to_quaternion(R)))
        true, _, V = motion.at(t)
        _, now = history.states(
            seen, TwistSample(seen.stamp_ns, tuple(V[:3]), tuple(V[3:])), True)
        yield history, now[0], seen.position, true


@pytest.mark.parametrize(('late', 'is_moved'), [(0.005, True), (0.0, False), (-0.005, False)])
def test_poses_that_lag_behind_their_twists_are_moved_ahead(late, is_moved):
    """Leave poses alone that are right, or earlier than twists of a filter."""
    errors = []
    for _, place, seen, true in (steps := list(lagging(late, 2e-5, 2))):
        errors.append([np.subtract(place, true), np.subtract(seen, true)])
        assert is_moved or place == seen
    moved, told = np.sqrt(np.mean(np.square(errors[-250:]), axis=(0, 2)))
    assert not is_moved or moved < 0.1 * told
    assert steps[-1][0]._lag == pytest.approx(late * is_moved, rel=0.1)
