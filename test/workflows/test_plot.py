"""What pictures are made of, against the cup that a recording was simulated with."""


from bellows_ros.workflows.plot import loads, motion, recorded, spectra, with_bodies, within
from bellows_ros.workflows.replay import predicted_live
from bellows_ros.workflows.simulate import simulate_recording
import numpy as np
import pytest


@pytest.fixture(scope='module')
def settings(known, true_cup):
    """Give the true cup, and how the recordings in bags/ are to be read."""
    return {**known, **true_cup}


def test_loads_lie_on_the_cups_stiffness(root, settings):
    """Find K again as the slope of load over deflection, where damping averages out."""
    found = loads(*recorded(root / 'bags' / 'identification', settings, True))
    x, y = found.deflection[found.valid], found.load[found.valid]
    slope = [np.polyfit(a, b, 1)[0] for a, b in zip(x.T, y.T, strict=True)]
    # Damping, noise and the sine in the strain leave some percent.
    np.testing.assert_allclose(slope, found.stiffness, rtol=0.04)
    np.testing.assert_allclose(
        found.stiffness, np.diag(np.reshape(settings['cup.stiffness'], (6, 6))))
    assert np.all(np.std(found.residual[found.valid], axis=0) < 0.08 * np.std(y, axis=0))


def test_spectra_show_the_noise_floor(root, settings):
    """Hold the density of white noise of 0.1 mm at 360 Hz, and a prediction error at it."""
    found = spectra(*recorded(root / 'bags' / 'validation', settings, True), cup=True)
    floor = 1e-4 / np.sqrt(180.0)
    high = found.frequency_hz > 60.0
    np.testing.assert_allclose(np.median(found.measured[high, :3], axis=0), floor, rtol=0.15)
    assert found.error is not None
    low = (found.frequency_hz > 0.5) & (found.frequency_hz < 5.0)
    assert np.all(found.error[low, :3] < 0.2 * found.measured[low, :3].max(axis=0))


def test_a_part_of_a_replay_has_its_own_scores(root, settings):
    """Pick all that belongs to the time, and judge the prediction by that."""
    values, recording = recorded(root / 'bags' / 'validation', settings, True)
    whole = with_bodies(values, recording, predicted_live(recording, values))
    part = within(whole, 3.0, 4.0)
    picked = (whole.seconds >= 3.0) & (whole.seconds <= 4.0)
    for name in ('seconds', 'deflection'):
        np.testing.assert_array_equal(getattr(part, name), getattr(whole, name)[picked])
    for name in ('tool', 'package', 'outline'):
        np.testing.assert_array_equal(
            getattr(part, name).position, getattr(whole, name).position[picked])
    error = whole.live.error[picked]
    np.testing.assert_allclose(part.live.scores.rms, np.sqrt(np.nanmean(error**2, axis=0)))
    assert part.live.scores.samples == np.count_nonzero(np.isfinite(error[:, 0]))
    assert len(part.seconds) == np.count_nonzero(picked)
    np.testing.assert_array_equal(part.box, whole.box)


def test_a_slow_camera_is_drawn_at_its_own_stamps(true_cup, known, tmp_path):
    bag = tmp_path / 'slow'
    simulate_recording(true_cup, {
        'kind': 'static', 'rest_duration': 1.0, 'seed': 2,
        'static': {'move': 0.5, 'hold': 0.5, 'poses': [{'rpy': [0.3, 0.0, 0.0]}]},
        'tool': {'rate_hz': 125.0}, 'package': {'rate_hz': 30.0}}, bag)
    values, recording = recorded(bag, {**known, **true_cup}, True)
    found = with_bodies(values, recording, predicted_live(recording, values))
    assert len(found.seconds) == len(found.tool) == len(found.outline) > 20


def test_without_a_package_the_tracked_point_is_shown(root, settings):
    """Put B where the poses are, in whichever frame they are taken."""
    bag = root / 'bags' / 'validation'
    unknown = {name: value for name, value in settings.items() if not name.startswith('package.')}
    of_b = recorded(bag, settings, True)[1]  # which is tracked here
    expected = motion(of_b).package_position
    for frame in ('com', 'lip'):
        found = recorded(bag, {**unknown, 'recording.package_frame': frame}, False)[1]
        np.testing.assert_array_equal(motion(found).package_position, expected)
