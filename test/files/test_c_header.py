"""The header in C: the very numbers of the kernels, and nothing that a strict compiler minds."""

import ctypes
from dataclasses import replace
import shutil
import subprocess

from bellows_ros.core.geometry.lie import exp_so3, rotation_to_quaternion
from bellows_ros.core.model import kernels
from bellows_ros.core.model.cup_package import Cup, model_tuple, Package
from bellows_ros.core.model.equilibrium import resting_on_tool, static_equilibrium
from bellows_ros.core.model.grip import least_factors
from bellows_ros.core.model.simulation import body_row, row_state, state_row
from bellows_ros.core.model.structure import composed
from bellows_ros.errors import BellowsError
from bellows_ros.files.exports import header
import numpy as np
import pytest

K = np.diag([5400.0, 5000.0, 9200.0, 4.2, 4.6, 1.35])
P = np.diag([55.0, 50.0, 24.0, 0.06, 0.05, 0.1])
K[0, 4] = K[4, 0] = 30.0
P[1, 3] = P[3, 1] = -0.2
CUP = Cup(K, P, 0.046)
INERTIA = [[0.0044, 1e-4, 0.0], [1e-4, 0.0065, -2e-4], [0.0, -2e-4, 0.0098]]
PACKAGE = Package(1.8, np.array(INERTIA), (0.004, -0.003, -0.03))
GRAVITY, GRIP = (0.1, -0.2, -9.81), (170.0, 0.03, 0.5)
RUBBER = replace(CUP, relaxation=(0.2, 0.15))
STRETCHED = replace(CUP, stretch=(-18e3, -5.0))
PLACES = np.array([[0.06, 0.04, 0.0, 0.0], [0.06, -0.04, 0.001, 1.0], [-0.05, 0.0, 0.0, 3.0]])
GRIPPER = replace(RUBBER, stiffness=composed(K, PLACES), damping=composed(P, PLACES))

LIBRARY = """
#include "cup.h"
#ifdef __cplusplus
extern "C" {
#endif
void step(const bellows_state *in, double h, int steps, bellows_state *out)
{ *out = bellows_step(&bellows_exported, &in[0], &in[1], &in[2], h, steps); }
void wrench(const bellows_state *in, bellows_wrench *out)
{ *out = bellows_lip_wrench(&bellows_exported, &in[1], &in[0]); }
double factor(const bellows_state *in)
{ return bellows_safety_factor(&bellows_exported, &bellows_exported_grip, &in[1], &in[0]); }
int rest(const bellows_state *tool, double load, bellows_state *out)
{
    bellows_model m = bellows_exported;
    m.package.mass *= load;
    return bellows_equilibrium(&m, tool, out);
}
#ifdef __cplusplus
}
#endif
"""
STRICT = ('-Wall', '-Wextra', '-Wpedantic', '-Wconversion', '-Wdouble-promotion', '-Werror',
          '-ffp-contract=off')


@pytest.fixture(scope='module', params=[
    ('gcc -std=c99 -O0', CUP), ('g++ -std=c++17 -O2', RUBBER), ('gcc -std=c11 -O3', GRIPPER),
    ('gcc -std=c99 -O2', STRETCHED), ('g++ -std=c++17 -O3', replace(RUBBER, stretch=(2e4, 4.0)))])
def library(request, tmp_path_factory):
    """Give the functions of the header, compiled with every warning an error."""
    command, cup = request.param
    compiler, *options = command.split()
    if shutil.which(compiler) is None:
        pytest.skip(f'{compiler} is not installed')
    folder = tmp_path_factory.mktemp('c')
    name = 'cup.c' if compiler == 'gcc' else 'cup.cpp'
    grip = (*GRIP, np.column_stack([PLACES, np.ones(3)])) if cup is GRIPPER else GRIP
    (folder / 'cup.h').write_text(header(cup, PACKAGE, GRAVITY, grip))
    (folder / name).write_text(LIBRARY)
    subprocess.run(
        [compiler, *options, *STRICT, '-shared', '-fPIC', '-o', 'cup.so', name, '-lm'],
        cwd=folder, check=True)
    loaded = ctypes.CDLL(str(folder / 'cup.so'))
    loaded.factor.restype = ctypes.c_double
    loaded.model, loaded.grip = model_tuple(cup, PACKAGE, GRAVITY), grip
    return loaded


def pointer(array):
    """Return where an array lies."""
    return array.ctypes.data_as(ctypes.c_void_p)


def states(rng, size, model):
    """Return a package that hangs on a tool, and the tool a little later; rows of 13 or 25."""
    R = exp_so3(rng.normal(size=3))
    o = rng.normal(size=3)
    tool = np.concatenate([o, rotation_to_quaternion(R), rng.normal(size=6)])
    later = np.concatenate([
        o + 0.01 * size * rng.normal(size=3),
        rotation_to_quaternion(R @ exp_so3(size * rng.normal(size=3))), rng.normal(size=6)])
    hangs = o + R @ (np.array(PACKAGE.com) + [0, 0, -CUP.length] + 0.003 * rng.normal(size=3))
    turned = R @ exp_so3(0.1 * size * rng.normal(size=3))
    body = np.concatenate([hangs, rotation_to_quaternion(turned), tool[7:] + rng.normal(size=6)])
    strains = 0.01 * rng.normal(size=(3, 6 * len(model[0][4:])))
    return np.hstack([[body, tool, later], strains])


def flat(state):
    """Return the numbers of a state or a wrench."""
    return np.hstack([np.ravel(part) for part in state]).tolist()


@pytest.mark.parametrize('size', [0.02, 0.5])
def test_step_wrench_and_safety_factor_are_the_kernels_bit_for_bit(library, size):
    """Near and far from zero, where series and libm take turns."""
    rng, model = np.random.default_rng(3), library.model
    for _ in range(60):
        rows = states(rng, size, model)
        tool, later = row_state(rows[1]), row_state(rows[2])
        body = body_row(rows[0], resting_on_tool(model, tool))
        out, f = np.empty(rows.shape[1]), np.empty(6)
        library.step(pointer(rows), ctypes.c_double(0.004), 3, pointer(out))
        assert out.tolist() == flat(kernels.advance(model, body, tool, later, 0.004, 3))
        library.wrench(pointer(rows), pointer(f))
        wrench = kernels.lip_wrench(model, tool, body)
        assert f.tolist() == flat(wrench)
        lip = kernels.lip_relative_to_tool(model[1][1], tool, body)
        factors = least_factors(library.grip, model[0], *lip, body[4:], *wrench)
        assert library.factor(pointer(rows)) == min(factors[:2])


def test_acceleration_at_rest_is_zero(library):
    """Find what Python finds, bit for bit; say so where the cup cannot carry the package."""
    rng, model = np.random.default_rng(4), library.model
    for _ in range(5):
        tool = states(rng, 0.1, model)[1]
        tool[3:7] = rotation_to_quaternion(exp_so3(0.3 * rng.normal(size=3)))
        out, still = np.empty(len(tool)), state_row(tool[:3], tool[3:7], np.zeros(6))
        assert library.rest(pointer(tool), ctypes.c_double(1.0), pointer(out)) == 0
        expected = static_equilibrium(model, still)
        found = body_row(out, expected)
        assert flat(found) == flat(expected)
        rates = kernels.body_acceleration(model, still, found)
        np.testing.assert_allclose(flat(rates), 0.0, atol=1e-8)
    assert library.rest(pointer(tool), ctypes.c_double(1000.0), pointer(out)) == 1


def test_a_grip_that_is_not_known_is_not_made_up():
    """Leave it out, so that asking for it does not compile, instead of one that holds nothing."""
    assert 'bellows_grip bellows_exported_grip =' in header(CUP, PACKAGE, grip=GRIP)
    text = header(CUP, PACKAGE)
    assert 'bellows_grip bellows_exported_grip =' not in text
    assert 'cup.lip_radius' in text


TWO = """
#include "left.h"
#include "right.h"
#include "left.h"
int main(void)
{
    bellows_state tool = {{0, 0, 0}, {0, 0, 0, 1}, {0, 0, 0}, {0, 0, 0}}, a, b;
    if (bellows_equilibrium(&left, &tool, &a) || bellows_equilibrium(&right_cup, &tool, &b))
        return 1;
    return a.o.z > b.o.z && left_longest > 0 && left_grip.radius > 0 ? 0 : 2;
}
"""


@pytest.mark.parametrize('how', ['gcc -std=c99', 'g++ -std=c++17'])
def test_two_cups_in_one_program(how, tmp_path):
    """Hang a package on each of two cups by their names; refuse two of one name."""
    compiler, standard = how.split()
    if shutil.which(compiler) is None:
        pytest.skip(f'{compiler} is not installed')
    soft = Cup(0.5 * CUP.stiffness, CUP.damping, CUP.length)
    for file, cup, name in (
        ('left', CUP, 'left'), ('right', soft, 'right_cup'), ('again', soft, 'left')
    ):
        (tmp_path / f'{file}.h').write_text(header(cup, PACKAGE, GRAVITY, GRIP, name))
    suffix = 'c' if compiler == 'gcc' else 'cpp'
    (tmp_path / f'two.{suffix}').write_text(TWO)
    subprocess.run([compiler, standard, *STRICT, '-o', 'two', f'two.{suffix}', '-lm'],
                   cwd=tmp_path, check=True)
    assert subprocess.run([tmp_path / 'two'], check=False).returncode == 0
    (tmp_path / f'clash.{suffix}').write_text('#include "left.h"\n#include "again.h"\n')
    clash = subprocess.run([compiler, standard, '-c', f'clash.{suffix}'], cwd=tmp_path,
                           check=False, capture_output=True)
    assert clash.returncode != 0


@pytest.mark.parametrize('name', ['', '2cups', 'left-cup', 'a b', 'ä'])
def test_name_that_c_does_not_have_is_refused(name):
    """Say so instead of writing what does not compile."""
    with pytest.raises(BellowsError, match='name'):
        header(CUP, PACKAGE, name=name)
