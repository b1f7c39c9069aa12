"""A cup is found with a camera that has a frame, a clock and a marker of its own."""

from benchmarks.sensors import CELLS, JUDGED, trial
import numpy as np


def test_all_that_the_recording_determines_is_told_with_its_error():
    found = trial(CELLS['robot, 30 Hz camera, 1 mm, apart'], 2, 30.0, 'axisymmetric')
    judged = found.bound < JUDGED
    assert judged[1]  # K z, by which the world's height is confounded
    assert found.converged and np.isfinite(found.std[judged]).all()
    assert np.all(np.abs(found.error[judged]) < 3.5 * found.std[judged])
    assert np.all(found.std[judged] < 2.0 * found.bound[judged])


def test_all_entries_of_a_full_cup_are_found_from_a_start_twice_too_large():
    found = trial(CELLS['motion capture, 0.3 mm'], 0, 8.0, 'full')
    judged = found.bound < JUDGED
    assert found.converged and np.count_nonzero(judged) > 21
    assert np.isfinite(found.std[judged]).all()
    assert np.all(np.abs(found.error[judged]) < 3.5 * found.std[judged])
