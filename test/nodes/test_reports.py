"""Counts in words; needs no ROS."""

from bellows_ros.core.live import LivePredictor, REFUSALS, RESTARTS
from bellows_ros.core.model import Cup, Package
from bellows_ros.nodes import reports
import numpy as np

MS = 1_000_000
START = 1_000_000_000
STILL, UPRIGHT = (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0)
NAN = float('nan')


def make_live(mass: float = 2.17, com: tuple[float, float, float] = (0.0, 0.0, -0.03)) -> (
        LivePredictor):
    """Return a predictor of a small plate, or of a heavier one."""
    return LivePredictor(Cup.thesis(), Package(mass, 0.01 * mass * np.eye(3), com), 9.81)


def test_quiet_when_all_is_well() -> None:
    """Say nothing about good input."""
    live = make_live()
    report = reports.InputReport(live)
    for step in range(5):
        live.on_pose(START + step * MS, 'world', STILL, UPRIGHT)
    assert report.take(twists_exist=False) == ([], [])


def test_refusals_are_counted_since_the_last_report() -> None:
    """Name number and reason, once each."""
    live = make_live()
    report = reports.InputReport(live)
    live.on_pose(START, 'world', STILL, UPRIGHT)
    for step in range(3):
        live.on_pose(START + step * MS, 'world', (NAN, 0.0, 0.0), UPRIGHT)
    live.on_pose(START + MS, 'elsewhere', STILL, UPRIGHT)
    live.on_twist(START, (NAN, 0.0, 0.0), STILL)

    assert report.take(twists_exist=False) == ([
        '3 poses refused: nan (a number in it is not finite).',
        "1 pose refused: frame_id is not 'world'.",
        '1 twist refused: nan (a number in it is not finite).',
    ], [])
    assert report.take(twists_exist=False) == ([], [])


def test_a_long_or_unprintable_frame_is_cut() -> None:
    """Keep a frame of a megabyte, and escape codes, out of the log."""
    live = make_live()
    report = reports.InputReport(live)
    for frame_id in ('\x1b[2J' + 'w' * 2**20, 'elsewhere'):
        live.on_pose(START, frame_id, STILL, UPRIGHT)
    (sentence,), _ = report.take(twists_exist=False)
    assert "frame_id is not '?[2Jwww" in sentence and len(sentence) < 200


def test_fresh_start_and_missing_twists_are_explained() -> None:
    """Say why the package was taken to be at rest, and that twists were lost."""
    live = make_live()
    report = reports.InputReport(live)
    live.on_pose(START, 'world', STILL, UPRIGHT)
    live.on_pose(START + 1000 * MS, 'world', STILL, UPRIGHT)

    assert report.take(twists_exist=True)[0] == [
        'Started again from static equilibrium: no usable pose arrived for more than 0.5 s.',
        '2 poses had no twist of the same stamp; it was estimated from the poses.',
    ]


def test_cup_that_cannot_hold_is_said_once_until_it_can() -> None:
    """Repeat the error only after predictions have come in between."""
    live = make_live(1e4, (5.0, 0.0, -5.0))
    report = reports.InputReport(live)
    errors = []
    for step in range(4):
        live.on_pose(START + step * MS, 'world', STILL, UPRIGHT)
        errors.append(report.take(twists_exist=False)[1])
    assert errors == [[reports.NO_EQUILIBRIUM], [], [], []]

    light, heavy = Package(2.0, 0.02 * np.eye(3), (0.0, 0.0, -0.03)), Package(
        1e4, 100.0 * np.eye(3), (5.0, 0.0, -5.0))
    for package, expected in ((light, []), (heavy, [reports.NO_EQUILIBRIUM])):
        live.set_model(Cup.thesis(), package)
        live.reset()
        live.on_pose(START, 'world', STILL, UPRIGHT)
        assert report.take(twists_exist=False)[1] == expected


def test_every_count_has_words() -> None:
    """Leave no reason of the predictor without a sentence."""
    said = {*reports._REFUSED_POSES, *reports._REFUSED_TWISTS}
    assert said == set(REFUSALS)
    assert {*reports._RESTARTS, 'no_equilibrium'} == set(RESTARTS)


def test_summary_holds_all_counts() -> None:
    """Put the totals into one sentence."""
    live = make_live()
    for step in range(3):
        live.on_pose(START + step * MS, 'world', STILL, UPRIGHT)
    live.on_pose(START, 'world', STILL, UPRIGHT)
    assert reports.summary(live) == (
        '4 poses and 0 twists in, 3 predictions out, 1 refused (1 backward_stamp), '
        '3 twists estimated.')
