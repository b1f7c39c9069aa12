"""Pictures of samples: what is drawn stands where the numbers say."""

from bellows_ros.plots.recording import spans
import numpy as np
import pytest

pytest.importorskip('matplotlib', reason="no matplotlib here (pip install '.[plot]')")


def test_runs_of_samples_begin_and_end_where_they_should():
    """Let a run last from its first sample to a step after its last one."""
    mask = np.array([True, True, False, False, True])
    assert spans(mask, np.arange(5) * 0.5, 0.5) == [(0.0, 1.0), (2.0, 0.5)]
    assert spans(~mask, np.arange(5) * 0.5, 0.5) == [(1.0, 1.0)]
    assert spans(np.zeros(3, bool), np.arange(3.0), 1.0) == []
