"""What is said of residuals: no doubt where a free simulation is as good as the poses."""

from bellows_ros.core.identification.hypotheses import Diagnosis, Finding
from bellows_ros.workflows.verdict import FitVerdict, Simulated
import numpy as np
import pytest


@pytest.mark.parametrize(('off', 'left', 'said'), [
    (1.02, 0.93, ''), (1.02, 0.6, ''), (1.5, 0.93, 'no tested cause'), (1.5, 0.6, 'Likely')])
def test_what_filters_take_is_not_doubted(off, left, said):
    """Doubt what was given, or the cup, only where poses are predicted worse than noise."""
    noise = np.repeat([1e-4, 5e-4], 3)
    rms = noise * np.where(np.arange(6) == 4, off, 1.0)
    none = np.empty(0)
    finding = Finding('structure', 'full', none, none, left, 0.0, False, False, '')
    verdict = FitVerdict(
        (Simulated('recording', rms, noise, 100.0 * noise, ()),), Diagnosis(2.7, (finding,)), {})
    assert len(verdict.cause) == bool(said) and said in ' '.join(verdict.cause)
