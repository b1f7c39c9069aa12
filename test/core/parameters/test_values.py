"""Values of parameters by attribute."""

import pickle

from bellows_ros.core.parameters.checks import resolve
from bellows_ros.core.parameters.table import PARAMETERS
from bellows_ros.core.parameters.values import Values
from bellows_ros.errors import NotSetError
import pytest

VALUES = resolve({'package.mass': 1.8, 'cup.name': 'soft', 'cups.soft.length': 0.04})


def test_every_name_is_an_attribute():
    for name, value in VALUES.items():
        found = VALUES
        for part in name.split('.'):
            found = getattr(found, part)
        assert found == value
    assert set(VALUES) <= {*PARAMETERS, 'cups.soft.length'}


def test_a_parameter_without_a_value_names_itself():
    with pytest.raises(NotSetError, match=r"'package\.inertia' is not set"):
        VALUES.package.inertia  # noqa: B018
    assert 'package.inertia' not in VALUES


def test_values_reach_other_processes():
    copy = pickle.loads(pickle.dumps(VALUES))
    assert copy == VALUES and copy.cups.soft.length == VALUES.cups.soft.length
    assert isinstance(copy, Values)
