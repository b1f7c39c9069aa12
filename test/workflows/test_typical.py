"""The accuracy along a typical motion, against draws from the fit's covariance."""

from dataclasses import replace

from bellows_ros.core.model.cup_package import Cup, package_of
from bellows_ros.core.model.simulation import simulate
from bellows_ros.core.model.structure import structure_named
from bellows_ros.core.parameters.checks import resolve
from bellows_ros.files.parameter_files import read_parameters
from bellows_ros.workflows.identify import identify
from bellows_ros.workflows.plan import read_plan
from bellows_ros.workflows.typical import typical
import numpy as np
from numpy.testing import assert_allclose
import pytest


@pytest.fixture(scope='module')
def found(root):
    values = read_parameters(root / 'bags/package.yaml')
    return identify({**values, 'bags': [str(root / 'bags/identification')],
                     'fit.method': 'least_squares'})


@pytest.fixture(scope='module')
def plan(root, found):
    return read_plan(root / 'bags/transport.yaml', resolve(found.cup_values()))


def test_is_the_spread_of_predictions_with_drawn_cups(found, plan):
    """Draw K and P with their correlations, and simulate plainly."""
    accuracy = typical(plan, found)
    fit, structure = found.fit, structure_named(found.fit.structure)
    x = structure.parameters(fit.stiffness, fit.damping)
    package, rng = package_of(found.cup_values()), np.random.default_rng(3)
    draws = rng.multivariate_normal(x, fit.covariance, 150)
    positions = np.array([
        simulate(Cup(*structure.matrices(each), found.cup_length), package, plan.tool).position
        for each in draws])
    spread = np.sqrt(np.var(positions, axis=0).sum(axis=1))
    # of 150 draws of mainly one number a standard deviation is known to 6 %
    assert_allclose(accuracy.position[0], np.sqrt(np.mean(spread**2)), rtol=0.15)
    assert_allclose(accuracy.position[1], spread.max(), rtol=0.2)
    assert sum(accuracy.shares.values()) == pytest.approx(1.0)


def test_says_what_to_record_again(found, plan):
    """Count what is not identifiable with all of itself, and name how it is found."""
    fit = found.fit
    covariance = fit.covariance.copy()
    i = fit.labels.index('K rx')
    covariance[i], covariance[:, i] = 0.0, 0.0
    covariance[i, i] = np.inf
    less = replace(found, fit=replace(fit, covariance=covariance))
    accuracy, before = typical(plan, less), typical(plan, found)
    assert accuracy.unknown == ('K rx',) and next(iter(accuracy.shares)) == 'K rx'
    assert accuracy.position[0] > 20.0 * before.position[0]
    assert 'record again: tilt the tool about x' in accuracy.sentence
    assert 'counted with 100 %: K rx.' in accuracy.sentence
    assert f'{1e3 * before.position[0]:.2g} mm' in before.as_json()['sentence']
