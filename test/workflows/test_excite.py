"""What a designed motion does not identify, and what would."""

import re
from types import SimpleNamespace

from bellows_ros.core.excitation.motion_design import Design
from bellows_ros.core.model.structure import STRUCTURES
from bellows_ros.core.parameters.values import Values
from bellows_ros.workflows.excite import DesignedMotion
from bellows_ros.workflows.plan import NO_FACTOR
import numpy as np

STRUCTURE = STRUCTURES['axisymmetric']
GUESS = np.array([5400.0, 9200.0, 4.2, 1.35, 55.0, 24.0, 0.06, 0.1])

PACKAGE = {'package.mass': 1.8, 'package.inertia': (4e-3, 6e-3, 9e-3, 0.0, 0.0, 0.0),
           'package.com': (0.0, 0.0, -0.03)}


def warnings_of(relative, more=1.0):
    """Give the warnings by relative standard errors, with so many times the information."""
    information = more * np.diag(1.0 / np.square(GUESS * relative))
    design = Design(SimpleNamespace(hold=0.0), {}, {'jerk': 0.7, 'bending': 0.3}, information)
    return DesignedMotion(design, STRUCTURE, GUESS, {}, Values(PACKAGE), 0.0).warnings


def test_number_that_is_not_identifiable_is_named_with_what_would_make_it_so():
    """Name the entry alone, and a factor of noise and time that is enough, and not too large."""
    relative = np.array([1e-3] * 5 + [1.4] + [1e-3] * 2)
    general, found = warnings_of(relative)
    assert general == NO_FACTOR
    assert found.startswith('P z is not identifiable')
    assert 'a higher limit of jerk helps most' in found
    quieter, longer = map(float, re.search('([0-9.]+) times lower.* ([0-9.]+) times longer',
                                           found).groups())
    assert warnings_of(relative / quieter) == warnings_of(relative, longer) == (NO_FACTOR,)
    assert len(warnings_of(relative / (0.9 * quieter))) == 2
    assert len(warnings_of(relative, 0.9 * longer)) == 2
