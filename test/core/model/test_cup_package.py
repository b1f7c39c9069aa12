"""Inertias of packages: of a box, of no body, and rounded."""

from contextlib import nullcontext

from bellows_ros.core.model.cup_package import box_inertia
from bellows_ros.core.model.structure import check_inertia
from bellows_ros.core.parameters.checks import implausible, resolve
from bellows_ros.core.parameters.conversion import package_of
from bellows_ros.errors import BellowsError
import numpy as np
from numpy.testing import assert_allclose
import pytest


def test_a_box_is_its_two_halves():
    """Halves along x, each moved by a quarter of the depth: only 1/12 of the squares does so."""
    half = box_inertia(1.0, 0.15, 0.2, 0.1) + np.diag([0.0, 1.0, 1.0]) * 0.075**2
    assert_allclose(box_inertia(2.0, 0.3, 0.2, 0.1), 2.0 * half, rtol=1e-14)
    assert_allclose(box_inertia(2.0, 0.3, 0.2, 0.1).diagonal()[[1, 0, 2]],
                    box_inertia(2.0, 0.2, 0.3, 0.1).diagonal(), rtol=1e-14)


@pytest.mark.parametrize(('inertia', 'figures'), [
    (np.diag([1.0, 1.0, 3.0]), '1, 1, 3 kg m'), (np.diag([1.0, 1.0, -1.0]), '-1, 1, 1 kg m'),
    (np.array([[1.0, 0.1, 0], [0, 1, 0], [0, 0, 1]]), r'row 1, column 2\b.* 0\.1\b')])
def test_inertia_no_body_can_have_is_refused(inertia, figures):
    with pytest.raises(BellowsError, match=rf'package\.inertia.*{figures}'):
        check_inertia(inertia)


@pytest.mark.parametrize(('largest', 'std', 'is_taken'), [
    (2.003, 0.0, False), (2.1, -1.0, True), (2.15, -1.0, False),
    (2.15, 0.1, True)])
def test_an_inertia_impossible_within_its_uncertainty_becomes_the_nearest(largest, std, is_taken):
    values = resolve({
        'package.mass': 1.0, 'package.com': [0.0, 0.0, -0.03],
        'package.inertia': [1.0, 1.0, largest, 0.0, 0.0, 0.0],
        'package.inertia_std': [std] * 3 + [-1.0] * 3})
    with nullcontext() if is_taken else pytest.raises(BellowsError, match='No body'):
        found = package_of(values).inertia
        second = 0.5 * np.trace(found) - np.diag(found)
        assert_allclose(second[2], 1e-4 * second[0])
        assert_allclose(np.diag(found), values['package.inertia'][:3], rtol=0.08)
    assert any('nearest' in each for each in implausible(values))
