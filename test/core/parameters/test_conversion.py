"""Objects of core from values of parameters."""

import ast
from pathlib import Path

ROOT = Path(__file__).parents[3] / 'bellows_ros'


def test_one_function_makes_a_cup_of_numbers():
    """Others replace numbers of a cup: none forgets its stretch, relaxation or their times."""
    makers = {
        file.name for file in ROOT.rglob('*.py') for node in ast.walk(ast.parse(file.read_text()))
        if isinstance(node, ast.Call) and ast.unparse(node.func).split('.')[-1] == 'Cup'}
    assert makers == {'conversion.py'}
