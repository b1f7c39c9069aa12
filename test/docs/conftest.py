"""Shared functions of the tests of the pages."""

import importlib.util
from pathlib import Path
import re
import sys

import numpy as np

DOCS = Path(__file__).resolve().parents[2] / 'docs'


def load(folder, name):
    """Import a script of docs, which is no package."""
    spec = importlib.util.spec_from_file_location(name, DOCS / folder / f'{name}.py')
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    spec.loader.exec_module(module)
    return module


PAGES = load('tools', 'pages')
"""The script that knows the commands on the pages."""

NUMBER = re.compile(r'-?\d+(?:\.\d+)?(?:e[-+]?\d+)?')
TOLERANCE = 0.02
"""Relative difference of a number in a description, by other versions of libraries."""


def show_the_same(new, stored):
    """Return whether two descriptions of a picture have equal texts, and numbers that agree."""
    now, before = (np.array(NUMBER.findall(text), float) for text in (new, stored))
    scale = np.maximum(np.abs(before), 0.02 * np.max(np.abs(before), initial=0.0))
    return NUMBER.sub('#', new) == NUMBER.sub('#', stored) and bool(
        np.all(np.abs(now - before) <= TOLERANCE * scale))
