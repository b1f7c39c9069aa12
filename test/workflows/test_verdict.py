"""What is said of residuals: no doubt where a free simulation is as good as the poses."""

from bellows_ros.core.identification.hypotheses import Diagnosis, Finding
from bellows_ros.workflows.verdict import Simulated, Verdict
import numpy as np
import pytest


@pytest.mark.parametrize('off, said', [(1.02, 0), (1.5, 1)])
def test_what_filters_take_is_not_doubted(off: float, said: int) -> None:
    """Say that nothing explains what is left only where poses are predicted worse than noise."""
    noise = np.repeat([1e-4, 5e-4], 3)
    rms = noise * np.where(np.arange(6) == 4, off, 1.0)
    none = np.empty(0)
    finding = Finding('length', '', none, none, 0.93, 0.0, True, False, '')
    verdict = Verdict(
        (Simulated('recording', rms, noise, 100.0 * noise, ()),), Diagnosis(2.7, (finding,)), {})
    assert sum('no tested cause' in sentence for sentence in verdict.sentences) == said
