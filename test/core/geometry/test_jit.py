"""
Compiled and interpreted kernels are one source; a changed source is compiled again.

The cache of compiled code is shared by processes that start at once, and is not needed.
"""

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

pytestmark = pytest.mark.timeout(600)
compiled = pytest.mark.skipif(not jit.COMPILED, reason='numba is not installed')

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

ONE_KERNEL = """
import json
from bellows_ros.core.model.kernels import strain
R = (0.0, -1.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0)
print(json.dumps([strain((1.0, 2.0, 3.0), R), sum(strain.stats.cache_hits.values())]))
"""
NO_COMPILER = "import sys; assert 'numba.np.arrayobj' not in sys.modules"
STRAIN = [[3.0, 1.0, 6.0], [0.0, 0.0, 2.0]]


def copied(folder, ignored='__pycache__', package=PACKAGE):
    """Copy the package into a folder, by default never compiled, and return the folder."""
    shutil.copytree(package, folder / 'bellows_ros', ignore=shutil.ignore_patterns(ignored))
    return folder


@pytest.fixture
def copy(tmp_path):
    """Return a folder with a copy of the package, never compiled."""
    return copied(tmp_path)


def started(path, script=ONE_KERNEL, **environment):
    """Start a script on a copy of the package."""
    env = {name: value for name, value in os.environ.items() if name != 'NUMBA_CACHE_DIR'}
    env |= {'PYTHONPATH': str(path), 'PYTHONDONTWRITEBYTECODE': '1', **environment}
    return subprocess.Popen(
        [sys.executable, '-P', '-c', script], cwd=path, env=env, text=True,
        stdout=subprocess.PIPE, stderr=subprocess.PIPE)


def ended(process):
    """Return what a process has printed, and its errors."""
    out, err = process.communicate(timeout=1000)
    assert process.returncode == 0, err
    return json.loads(out), err


def run(script, path=PACKAGE.parent, **environment):
    """Return what a script prints in a new interpreter."""
    return ended(started(path, script, **environment))[0]


@pytest.fixture(scope='module')
def shared(tmp_path_factory):
    """Return a folder with a copy that two processes compiled at once, and their results."""
    folder = copied(tmp_path_factory.mktemp('shared'))
    return folder, [ended(process) for process in [started(folder), started(folder)]]


@compiled
def test_processes_that_start_at_once_share_the_cache(shared):
    folder, results = shared
    assert [out[0] for out, _ in results] == [STRAIN, STRAIN]
    assert list((folder / 'bellows_ros/core/model/__pycache__').glob('*.nbi'))
    assert ended(started(folder, ONE_KERNEL + NO_COMPILER)) == ([STRAIN, 1], '')


@compiled
def test_damaged_cache_is_said_and_made_anew(shared, tmp_path):
    folder = copied(tmp_path, '', shared[0] / 'bellows_ros') / 'bellows_ros/core'
    files = sorted(folder.rglob('*.nbi'))
    spoilt = b'', files[1].read_bytes()[:60], b'\x93NUMPY' * 100
    for path, content in zip(files, spoilt, strict=True):  # of the kernel and what it calls
        path.write_bytes(content)
    out, err = ended(started(tmp_path))
    assert out == [STRAIN, 0]
    assert f'Compiled code in {folder}/model/__pycache__ cannot be used' in err
    assert ended(started(tmp_path)) == ([STRAIN, 1], '')


@compiled
def test_interpreted_kernels_give_the_same_numbers():
    (is_compiled, fast), (is_interpreted, slow) = run(SCRIPT), run(SCRIPT, NUMBA_DISABLE_JIT='1')
    assert is_compiled and not is_interpreted
    for got, wanted in zip(fast, slow, strict=True):
        assert_allclose(got, wanted, rtol=0, atol=1e-13)


@compiled
def test_a_change_in_one_file_reaches_its_callers_in_others_and_no_more(copy):
    script = """
import json
from bellows_ros.core.model.grip import ratio
from bellows_ros.core.model.kernels import strain
first = strain((1., 0., 0.), (1., 0., 0., 0., 1., 0., 0., 0., 1.))[0][0]
second = ratio(4., 2.)
hits = [sum(kernel.stats.cache_hits.values()) for kernel in (strain, ratio)]
print(json.dumps([first, second, *hits]))
"""
    cache = {'NUMBA_CACHE_DIR': str(copy / 'cache')}
    assert run(script, copy, **cache) == [2.0, 2.0, 0, 0]
    assert list((copy / 'cache').rglob('*.nbi'))
    tuples = copy / 'bellows_ros/core/geometry/tuples.py'
    text = tuples.read_text()
    line = 'return (a[0] + b[0], a[1] + b[1], a[2] + b[2])'
    assert line in text
    tuples.write_text(text.replace(line, 'return (a[0] + 5 * b[0], a[1] + b[1], a[2] + b[2])'))
    assert run(script, copy, **cache) == [6.0, 2.0, 0, 1]


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


@compiled
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
    ('module.LIMIT = 2.0', 'module.LIMIT = 3.0')])
def test_a_kernel_is_of_its_constants_and_of_those_it_names_in_modules(line, change):
    def digest(text, before_code=''):
        names = {'module': types.ModuleType('module')}
        exec(f'{text}\ndef kernel(y):\n{before_code}    return y > {text.split(" = ")[0]}', names)
        jit._source_digest.cache_clear()
        return jit._source_digest(names['kernel'])

    assert digest(line) == digest(line) == digest(f'{line}\nOTHER = 3') != digest(change)
    assert digest(line, '    "A docstring."\n') == digest(line, '    """Another\n    one."""\n')


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


@compiled
@pytest.mark.skipif(not Path('/proc/self/maps').exists(), reason='only Linux lists its pages')
def test_the_memory_of_the_compiler_is_returned_and_it_compiles_on():
    returned, *results = run(RELEASE)
    assert returned > 10_000  # kB
    assert results == [5.0, 6.0]


@compiled
def test_package_that_cannot_be_written_is_cached_for_the_user_or_not_at_all(copy):
    for room in ('geometry', 'model'):
        (copy / f'bellows_ros/core/{room}/__pycache__').write_text('in the way, for root too')
    user, blocked = copy / 'user', copy / 'no folder'
    blocked.write_text('')
    for home, hits in ((user, 0), (user, 1), (blocked, 0)):
        out = run(ONE_KERNEL, copy, XDG_CACHE_HOME=str(home), HOME=str(home))
        assert out == [STRAIN, hits]
    assert list(user.rglob('*.nbi'))


TWO_KINDS = """
import json
from bellows_ros.core.geometry.tuples import add
print(json.dumps([add((1, 2, 3), (4, 5, 6)), add((0.5, 2.0, 3.0), (4.0, 5.0, 6.0))]))
"""


@compiled
def test_code_for_other_arguments_is_not_used(copy):
    """Two processes that start at once can leave one's code under the name of the other's."""
    first = ended(started(copy, TWO_KINDS))
    one, two = sorted((copy / 'bellows_ros/core/geometry/__pycache__').glob('tuples.add.*.nbc'))
    both = one.read_bytes(), two.read_bytes()
    two.write_bytes(both[0])
    one.write_bytes(both[1])
    out, err = ended(started(copy, TWO_KINDS))
    assert out == [[5, 7, 9], [4.5, 7.0, 9.0]]
    assert first == (out, '') and 'cannot be used (ValueError)' in err


BY_NAME = """
import json
import numpy as np
from bellows_ros.core.geometry.tuples import product
A = np.arange(26.0).reshape(2, 13)
found = product(A, A.T.copy(), np.empty((2, 2)))
print(json.dumps([(found - A @ A.T).tolist(), sum(product.stats.cache_hits.values())]))
"""


@compiled
def test_code_whose_called_kernel_is_not_on_disk_compiles_that_alone(copy):
    equal = [[0.0, 0.0], [0.0, 0.0]]
    assert run(BY_NAME, copy) == [equal, 0]
    files = list((copy / 'bellows_ros/core/geometry/__pycache__').glob('tuples._add_from.*'))
    assert files
    for file in files:
        file.unlink()
    assert run(BY_NAME, copy) == [equal, 1]
    assert all(file.exists() for file in files)


def test_work_aside_is_done_in_another_process(tmp_path, capfd):
    """Call the function with its arguments; fail without a word, as its kernels come later."""
    assert jit.compile_aside(os.mkdir, str(tmp_path / 'made')).wait(600) == 0
    assert (tmp_path / 'made').is_dir()
    assert jit.compile_aside(os.mkdir, str(tmp_path / 'made')).wait(600) != 0
    assert capfd.readouterr() == ('', '')
