"""What the methods of fitting make of prepared recordings."""

from contextlib import nullcontext
from dataclasses import replace

from bellows_ros.core.identification import fitting
from bellows_ros.core.identification.fitting import fit
from bellows_ros.core.identification.result import Cause
from bellows_ros.core.model.structure import STRUCTURES
from bellows_ros.core.parameters.checks import resolve
from bellows_ros.errors import BellowsError
import numpy as np
import pytest

from ...cell.cup import PLATE, THESIS
from ...cell.motion import shake
from ...cell.sensors import record

ROUND = STRUCTURES['axisymmetric']
VALUES = resolve({'fit.method': 'least_squares', 'cup.length': THESIS.length,
                  'package.mass': PLATE.mass})


TOO_LITTLE = pytest.raises(BellowsError, match='K rz')


@pytest.mark.parametrize(('chi2', 'certain', 'std', 'ends'), [
    (1.0, False, np.inf, TOO_LITTLE), (5.0, False, np.inf, nullcontext()),
    (3.9, True, np.inf, nullcontext()), (1.0, False, 0.3, TOO_LITTLE),
    (1.0, False, 0.2, nullcontext())])
def test_motion_is_too_little_where_neither_a_misfit_nor_noise_hides_the_damping(
    chi2, certain, std, ends, monkeypatch
):
    """Noise may hide the damping of a stiff cup that no weight turns: then its K rz is known."""
    recording = record(shake(seed=3))
    found = fitting.fitted([recording], VALUES)
    unknown = replace(
        found, method='output_error', robust_chi2=chi2,
        causes=(Cause('length', '', certain=certain),), covariance=np.diag([
            (std * x) ** 2 if label == 'K rz' else np.inf
            for label, x in zip(found.labels, found.parameters, strict=True)]))
    monkeypatch.setattr(fitting, 'fitted', lambda *own, **more: unknown)
    with ends:
        assert fit([recording], VALUES) is unknown
