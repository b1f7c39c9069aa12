"""All integrators that are compared solve one case, and the C kernel is the very same one."""

from bellows_ros.core.geometry.lie import log_so3, quaternion_to_rotation
from bellows_ros.core.model.simulation import simulate_rows
from bellows_ros.errors import BellowsError
from benchmarks import step, timing
from benchmarks.c_kernel import CKernel
from benchmarks.plain_numpy import PlainModel
from benchmarks.step import _plain_start, _pose
from benchmarks.step_case import CUP, MODEL, PACKAGE, shaken_tool, start, still_tool
import numpy as np
from numpy.testing import assert_allclose, assert_array_equal
import pytest


def ours(tool, duration):
    """Return this package's rows for a tool sampled at a constant rate."""
    count = len(tool) - 1
    return simulate_rows(
        MODEL, start(), tool, np.full(count, duration / count), np.ones(count, dtype=np.int64))


@pytest.mark.parametrize('options', [('-O3',), ('-O0',)])
def test_c_kernel_gives_the_same_motion(tmp_path, options):
    try:
        kernel = CKernel(tmp_path, options)
    except BellowsError as error:
        pytest.skip(str(error))
    tool = shaken_tool(361, 360.0)
    rows = kernel.simulate(MODEL, start(), tool, np.full(360, 1 / 360))
    assert_array_equal(rows, ours(tool, 1.0))


def test_plain_numpy_is_the_same_model():
    plain = PlainModel(CUP, PACKAGE, 9.81)
    position, rotation = _pose(plain.solve(_plain_start(), 0.25, 'DOP853', 1e-12)[0])
    row = ours(still_tool(1001), 0.25)[-1]
    assert_allclose(position, row[:3], atol=1e-9)
    assert_allclose(log_so3(rotation.T @ quaternion_to_rotation(row[3:7])), 0.0, atol=1e-8)


def test_accuracy_is_timed_in_turns(monkeypatch):
    turns = []
    monkeypatch.setattr(
        step, 'interleaved', lambda works, rounds: turns.append(list(works)) or
        timing.interleaved(works, rounds))
    rows = step._accuracy(short=True)
    assert len(turns) == 1 and len(turns[0]) == len(rows) == 5
    assert rows[1]['position_error'] < rows[0]['position_error'] < 1e-6


def test_plain_numpy_works_out_once_what_is_constant(monkeypatch):
    plain, state = PlainModel(CUP, PACKAGE, 9.81), _plain_start()
    for name in ('inv', 'solve'):
        monkeypatch.delattr(np.linalg, name)
    monkeypatch.delattr(np, 'block')
    assert np.isfinite(plain.rk4(state, 1 / 360, 2)).all()
