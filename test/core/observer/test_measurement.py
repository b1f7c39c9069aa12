"""Measured poses: the jitter of stamps."""

from bellows_ros.core.model.equilibrium import moved_by
from bellows_ros.core.observer.filter import JITTER
import numpy as np
import pytest

from .cases import at_once, follow, observer, tool_motion, truth, with_noise
from .cell import EXACT


@pytest.mark.parametrize('jitter', [1e-4, 5e-3, 1e-2])
def test_the_jitter_of_stamps_is_estimated(jitter):
    """From 2 ms, assumed at first: within half and twice the true one, or below 0.5 ms."""
    rng = np.random.default_rng(3)
    stamps, tool = tool_motion(rng, 12.0, size=0.15)
    body, std = truth(tool), np.repeat([3e-4, 2e-3], 3)
    made = observer(measured__noise=std[[0, 3]].tolist())
    came = {}
    for k in range(20, len(tool) - 20, 8):
        late = np.r_[jitter * rng.normal() * np.r_[body[k][2], body[k][3]], np.zeros(6)]
        came[k] = [(stamps[k], with_noise(rng, moved_by(body[k], late), std))]
    follow(made, stamps, tool, body[0], came)
    found = np.sqrt(made.estimate.memory[JITTER])
    assert 0.5 * jitter < found < max(2.0 * jitter, 5e-4)


@pytest.mark.parametrize(('late', 'verdict'), [(8e-3, 'used'), (14e-3, 'outlier')])
def test_stamp_off_by_some_ms_is_usual_from_the_first_motion_on(late, verdict):
    """Expect 2 ms: at 1 m/s the gate has a width of 5.3 standard deviations of the jitter."""
    stamps, tool = tool_motion(np.random.default_rng(3), 3.0, size=0.15)
    body = truth(tool)
    k = int(np.argmax([np.linalg.norm(each[2]) for each in body]))
    made = observer(measured__noise=[3e-4, 2e-3], alarm__false_per_hour=0.0, **EXACT)
    seen = moved_by(body[k], np.r_[late * np.r_[body[k][2], body[k][3]], np.zeros(6)])
    poses = {4: body[4][:2], 8: body[8][:2], k: seen[:2]}
    follow(made, stamps[:k + 1], tool[:k + 1], body[0], at_once(stamps, poses))
    assert made.counts['used'] == 2 + (verdict == 'used')
    assert made.counts['outlier'] == (verdict == 'outlier')
