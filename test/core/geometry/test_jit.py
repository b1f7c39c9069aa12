"""Compiled and interpreted kernels are one source; a changed source is compiled again."""

import ast
import contextlib
import importlib
import inspect
import json
import os
from pathlib import Path
import pkgutil
import shutil
import subprocess
import sys
import textwrap
import types

from bellows_ros import core
from bellows_ros.core.geometry import jit
from numpy.testing import assert_allclose
import pytest

PACKAGE = Path(jit.__file__).parents[2]

SCRIPT = """
import json
from bellows_ros.core.geometry import jit
from bellows_ros.core.model import kernels
from bellows_ros.core.model import cup_package as model
from bellows_ros.core.model import equilibrium, simulation
cup, package = model.Cup.thesis(), model.Package(
    2.0, [[.01, .001, 0], [.001, .01, 0], [0, 0, .012]], [.01, 0, -.05])
m = model.model_tuple(cup, package, 9.81)
tool = ((0., 0., 0.), (0., 0., 0., 1.), (.1, .2, 0.), (.3, 0., .5))
later = kernels.tool_at(kernels.tool_segment(tool, tool, .01), .5)
body = equilibrium.static_equilibrium(m, tool)
for _ in range(50):
    body = kernels.advance(m, body, tool, later, .005, 2)
print(json.dumps([jit.COMPILED, body]))
"""


def run(script, path=PACKAGE.parent, **environment):
    """Run a script in a new interpreter and return what it prints, from JSON."""
    env = {**os.environ, 'PYTHONPATH': str(path), **environment}
    out = subprocess.run(
        [sys.executable, '-c', script], cwd=path, env=env, capture_output=True, text=True,
        check=False)
    assert out.returncode == 0, out.stderr
    return json.loads(out.stdout)


@pytest.mark.skipif(not jit.COMPILED, reason='numba is not installed: nothing to compare')
def test_interpreted_kernels_give_the_same_numbers():
    (compiled, fast), (interpreted, slow) = run(SCRIPT), run(SCRIPT, NUMBA_DISABLE_JIT='1')
    assert compiled
    assert not interpreted
    for got, wanted in zip(fast, slow, strict=True):
        assert_allclose(got, wanted, rtol=0, atol=1e-13)


@pytest.mark.skipif(not jit.COMPILED, reason='numba is not installed: nothing is kept on disk')
def test_a_change_in_one_file_reaches_its_callers_in_others_and_no_more(tmp_path):
    shutil.copytree(PACKAGE, tmp_path / 'bellows_ros', ignore=shutil.ignore_patterns('*.nb?'))
    script = """
import json
from bellows_ros.core.model.grip import ratio
from bellows_ros.core.model.kernels import strain
first = strain((1., 0., 0.), (1., 0., 0., 0., 1., 0., 0., 0., 1.))[0][0]
second = ratio(4., 2.)
hits = [sum(kernel.stats.cache_hits.values()) for kernel in (strain, ratio)]
print(json.dumps([first, second, *hits]))
"""
    cache = {'NUMBA_CACHE_DIR': str(tmp_path / 'cache')}
    assert run(script, tmp_path, **cache) == [2.0, 2.0, 0, 0]
    assert run(script, tmp_path, **cache) == [2.0, 2.0, 1, 1]
    assert list((tmp_path / 'cache').rglob('*.nbi'))
    tuples = tmp_path / 'bellows_ros/core/geometry/tuples.py'
    text = tuples.read_text()
    line = 'return (a[0] + b[0], a[1] + b[1], a[2] + b[2])'
    assert line in text
    tuples.write_text(text.replace(line, 'return (a[0] + 5 * b[0], a[1] + b[1], a[2] + b[2])'))
    assert run(script, tmp_path, **cache) == [6.0, 2.0, 0, 1]


def kernels():
    """Return all kernels of the package, by module and name."""
    found = {}
    for module in pkgutil.walk_packages(core.__path__, f'{core.__name__}.'):
        for name, value in vars(importlib.import_module(module.name)).items():
            if hasattr(value, 'py_func') and value.py_func.__module__ == module.name:
                found[f'{module.name}.{name}'] = value
    return found


def used(function):
    """Return the kernels and constants that a function's source names, also as x of a module."""
    values, own = {}, function.__code__.co_varnames
    for node in ast.walk(ast.parse(textwrap.dedent(inspect.getsource(function))).body[0]):
        name = ast.unparse(node) if isinstance(node, ast.Attribute | ast.Name) else ''
        if name and name.split('.')[0] not in own:
            with contextlib.suppress(NameError, AttributeError):
                values[name] = eval(name, function.__globals__)
    return values


@pytest.mark.skipif(not jit.COMPILED, reason='numba is not installed: nothing is kept on disk')
def test_every_kernel_is_of_all_that_it_calls():
    calls = 0
    for name, kernel in kernels().items():
        before = jit._source_digest(kernel.py_func)
        for called, value in used(kernel.py_func).items():
            if hasattr(value, 'py_func') and value is not kernel:
                code = value.py_func.__code__
                value.py_func.__code__ = code.replace(co_consts=(*code.co_consts, 'changed'))
                jit._source_digest.cache_clear()
                assert jit._source_digest(kernel.py_func) != before, f'{name}: {called}'
                value.py_func.__code__ = code
                calls += 1
        jit._source_digest.cache_clear()
    assert calls > 300


@pytest.mark.parametrize(('line', 'change'), [
    ('LIMIT = 2.0', 'LIMIT = 3.0'), ('LIMIT = (1.0, 2.0)', 'LIMIT = (1.0, 3.0)'),
    ('module.LIMIT = 2.0', 'module.LIMIT = 3.0'),
    ('module.x.py_func = lambda y: y', 'module.x.py_func = lambda y: y + 1')])
def test_a_kernel_is_of_its_constants_and_of_what_it_names_in_modules(line, change):
    def digest(text):
        module = types.ModuleType('module')
        module.x, names = types.SimpleNamespace(), {'module': module}
        limit = 'LIMIT' if text.startswith('LIMIT') else 'module.LIMIT'
        exec('module.LIMIT = 1.0\nmodule.x.py_func = lambda y: 0.0\n'
             f'{text}\ndef kernel(y):\n    return module.x(y) > {limit}', names)
        jit._source_digest.cache_clear()
        return jit._source_digest(names['kernel'])

    assert digest(line) == digest(line) == digest(f'{line}\nOTHER = 3') != digest(change)


RELEASE = """
import json
import numpy
from bellows_ros.core.geometry import jit, tuples
def resident():
    lines = open('/proc/self/status').read().splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith('VmRSS'))
tuples.cross((1., 0., 0.), (0., 1., 0.))
before = resident()
jit.release_compiler()
after = resident()
twice = jit.kernel(lambda x: x + x)
print(json.dumps([before - after, twice(2.5), tuples.dot((1., 2., 3.), (1., 1., 1.))]))
"""


@pytest.mark.skipif(not jit.COMPILED, reason='numba is not installed: there is no compiler')
@pytest.mark.skipif(not Path('/proc/self/maps').exists(), reason='only Linux lists its pages')
def test_the_memory_of_the_compiler_is_returned_and_it_compiles_on():
    returned, *results = run(RELEASE)
    assert returned > 10_000  # kB
    assert results == [5.0, 6.0]
