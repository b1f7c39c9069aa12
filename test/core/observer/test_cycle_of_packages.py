"""Contact with a support, and what must not outlive a package or a camera's mistake."""

from bellows_ros.core.live.held_package import prepared
from bellows_ros.core.model.kernels import ORIGIN
from bellows_ros.core.observer import states
from bellows_ros.core.observer.states import CAMERA_ROWS, KNOWN_ROWS, ROWS_WITHOUT_SENSOR
from bellows_ros.core.observer.support import Support
from benchmarks import cycles
import numpy as np
import pytest

from .cases import Cell, CONDITIONS, CUP, observer, ORDINARY, PACKAGE, truth, values
from .contact_cell import ContactCell

STATE = states.STATE
KNOWN, CAMERA = (np.array([row for row in rows if row < ROWS_WITHOUT_SENSOR])
                 for rows in (KNOWN_ROWS, CAMERA_ROWS))


def carried(heights, aside=0.0, grips=False):
    """Tell at which samples of a motion a support may carry the package."""
    support = Support()
    support.use((0.0, 0.0, 1.0), 2e-3)
    if grips:
        support.grip()
    near = []
    for k, height in enumerate(heights):
        still = (aside * k, 0.0, height), *ORIGIN[1:]
        support.follow(k + 1, still)
        near.append(support.is_near)
    assert [support.at(k + 1) > 0 for k in range(len(near))][-1] == near[-1]
    return near


def test_support_carries_from_the_grip_to_the_lift_and_from_the_way_down():
    """Lift by 10 mm with a sag of 2 mm; go down by 40 mm; rise again."""
    up, down = np.linspace(0.0, 0.1, 101), np.linspace(0.1, 0.06, 41)
    near = carried([*up, *down, *down[::-1]], grips=True)
    assert near[:10] == [True] * 10 and not any(near[12:101])
    assert not any(near[101:130]) and all(near[134:142])
    assert not near[-1]


@pytest.mark.parametrize(('heights', 'aside', 'grips'), [
    ([0.0, *np.linspace(0.3, 0.1, 200)], 1e-3, True),
    ([0.0, *0.3 + 0.01 * np.sin(np.arange(400) / 10.0)], 0.0, True),
    (np.linspace(0.3, 0.1, 200), 0.0, False)])
def test_motion_aside_or_up_and_down_or_without_a_grip_needs_no_support(heights, aside, grips):
    near = carried(heights, aside, grips)
    assert near[0] == grips and not any(near[1:])


def events(heights):
    """Return the samples at which a tool meets or leaves a support, with heights each 10 ms."""
    support, found = Support(), {}
    support.use((0.0, 0.0, 1.0), 2e-3)
    support.grip()
    for k, height in enumerate(heights):
        speed = np.gradient(heights, 0.01)[k]
        if event := support.follow(10_000_000 * k + 1, (
                (0.0, 0.0, height), ORIGIN[1], (0.0, 0.0, speed), ORIGIN[3])):
            found.setdefault(event, []).append(k)
    return found


def moved_up(by, samples):
    """Return a smooth rise (m) from 0 within some samples."""
    s = np.linspace(0.0, 1.0, samples)
    return by * s**3 * (10.0 - 15.0 * s + 6.0 * s**2)


def test_tool_that_stops_on_its_way_down_meets_a_support():
    """Meet it less than 10 mm above the stop; leave it as the tool continues downwards."""
    way = [*moved_up(0.3, 50), *0.3 - moved_up(0.2, 50), *[0.1] * 20]
    found = events(way)
    (k,) = found['meets']
    assert 2e-3 < way[k] - 0.1 < 12e-3
    assert events([*way, *0.1 - moved_up(0.05, 30), *[0.05] * 9])['leaves'][1] > 120
    assert len(events([*way, *0.1 - moved_up(0.05, 30), *[0.05] * 9])['meets']) == 2


def frozen(cell, first, last, rng):
    """Let the tracker freeze between two samples, with noise below its resolution."""
    keys = [k for k in cell.seen if first <= k < last]
    (_, (place, q)), = cell.seen[keys[0]]
    for k in keys:
        (stamp_ns, _), = cell.seen[k]
        cell.seen[k] = [(stamp_ns, (tuple(np.add(place, 1e-6 * rng.normal(size=3))), q))]
    for k in [k for k in cell.seen if k >= last]:
        del cell.seen[k]


def test_frozen_tracker_does_not_outlive_itself():
    """Predict 3 s after it as without a camera, with the cup of the file after a reset."""
    cell = Cell(5, 10.0, CONDITIONS['all, small'])
    frozen(cell, 375, 875, np.random.default_rng(1))
    errors = []
    cell.run(lambda k: errors.append(
        np.linalg.norm(np.subtract(cell.made.body[0], cell.body[k][0]))))
    assert np.sqrt(np.mean(np.square(errors[-120:]))) < 2e-3
    cell.made.forget(CAMERA_ROWS)
    known = cell.made._known
    rest = np.setdiff1d(KNOWN, CAMERA)
    np.testing.assert_array_equal(known.theta[rest - STATE], 0.0)
    np.testing.assert_allclose(
        np.diag(known.covariance)[rest], cell.made._correction.prior[rest] ** 2)


def test_camera_stays_known_over_packages_and_parameters():
    """Keep its pose and latency with another package and with other values."""
    cell = Cell(7, 10.0, {'late': 0.005, 'offset': (1e-3, 0.0)})
    cell.run()
    made, rows = cell.made, CAMERA
    before = np.diag(made._estimates[-1].covariance)[rows]
    made.use_values(values(**ORDINARY, package__mass=1.5))
    made.set_model(*prepared(CUP, PACKAGE, 9.81)[:3])
    made.forget()
    assert (np.diag(made._known.covariance)[rows] <= before * (1.0 + 1e-9)).all()
    assert np.abs(made._known.theta[rows - STATE]).max() > 0.0


def test_support_turns_a_lowered_package_flat():
    """Follow it at the touch and the set-down to 25 and 15 mrad, without a force sensor."""
    squares = []
    for seed in range(3):
        cell = ContactCell(seed)
        run = cycles.followed([cell.cycle() for _ in range(6)])
        squares.append(run.by_phase(run.errors)[4:, 1])
    assert (np.sqrt(np.mean(squares, axis=0)) < (0.025, 0.015)).all()


@pytest.mark.parametrize('has_camera', [True, False])
def test_regions_hold_while_a_support_carries_a_lowered_package(has_camera):
    """Find 95 % regions of set-down packages to have 70 %, a third if its wrench is known."""
    shares = []
    for seed in range(2):
        cell = ContactCell(seed, 'white')
        run = cycles.followed(
            [cell.cycle() for _ in range(6)], 'white', has_camera=has_camera)
        is_set_down = run.phases == cycles.PHASES.index('set down')
        shares.append([cycles.coverage(run.nees[is_set_down, part])[1] for part in (1, 2)])
    assert (np.mean(shares, axis=0) > 0.7).all()


@pytest.mark.parametrize(('event', 'after'), [('lower', 0.05), ('lower', 0.25), ('move', 0.05)])
def test_drop_on_the_way_is_a_loss_without_the_switch(event, after):
    """See a package fall before a support, or lie below the way before it was ever in reach."""
    found = 0
    for seed in range(70000, 70010):
        cell = ContactCell(seed)
        made = [cell.cycle(), cell.cycle('drop', at_event=event, after=after)]
        run = cycles.followed(made, has_switch=False)
        found += 'lost' in [alarm.kind for _, _, alarm in run.alarms] or (
            sum(t > made[1].at['fault'] for t, *_ in made[1].seen) < 3)
    assert found >= 9


def test_package_at_its_grip_is_at_rest_on_a_support():
    """Also after a package whose support the tool has not left; not after a gap in the air."""
    made, (body,) = observer(), truth([ORIGIN])
    raised = (0.0, 0.0, 0.1), *ORIGIN[1:]
    for stamp_ns in (1_000_000_000, 2_000_000_000):
        made.forget()
        made.grip()
        made.start(stamp_ns, ORIGIN, body)
        assert made._support.is_near
        assert np.sqrt(np.diag(made.estimate.covariance)[:STATE]).max() < 0.03
    made.follow(2_010_000_000, ORIGIN, raised)
    made.start(3_000_000_000, raised, truth([raised])[0])
    assert not made._support.is_near
    assert np.sqrt(np.diag(made.estimate.covariance)[STATE - 1]) == pytest.approx(1.0, rel=1e-3)


def test_tag_seen_from_the_move_on_does_not_make_the_swing_worse():
    """Compare the rotation of the first packages of five cells with and without the camera."""
    total = np.zeros(2)
    for seed in range(82200, 82205):
        cell = ContactCell(seed, 'view')
        made = [cell.cycle() for _ in range(3)]
        total += [run.by_phase(run.errors)[1, 1] for run in (
            cycles.followed(made, 'view', False, camera) for camera in (True, False))]
    assert total[0] < 1.1 * total[1]


def test_package_that_sinks_after_its_release_is_no_loss():
    """Raise no alarm where a package sinks by 12 mm at the end of the vacuum, the tool at rest."""
    alarms, count = [], 0
    for seed in range(70000, 70005):
        cell = ContactCell(seed)
        first, second = cell.cycle(), cell.cycle()
        sinks = [(t, a, (x, y, z - 0.012 * (t > second.at['release'])), q)
                 for t, a, (x, y, z), q in second.seen]
        count += second.seen[-1][1] > second.at['up']
        alarms += cycles.followed([first, second._replace(seen=sinks)]).alarms
    assert alarms == [] and count >= 2


def test_package_left_at_the_target_is_no_loss():
    """Raise no alarm while the camera shows the previous package before the held one."""
    for seed in range(70000, 70005):
        cell = ContactCell(seed)
        first, second = cell.cycle(), cell.cycle()
        o, q = first.truth[-1, :3] + [0.0, 0.2, 0.0], first.truth[-1, 3:]
        earlier = [(t, t + 0.05, tuple((o + 1e-6 * t).tolist()), tuple(q.tolist()))
                   for t in np.arange(second.at['move'], second.seen[0][0] - 0.02, 0.03)]
        run = cycles.followed(
            [first, second._replace(seen=earlier + second.seen)], has_switch=False)
        assert run.alarms == []
