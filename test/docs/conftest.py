"""What the tests of the pages share."""

import importlib.util
from pathlib import Path
import sys

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
