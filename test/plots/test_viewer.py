"""The view in Rerun, read back with Rerun's own reader."""

from bellows_ros.core.geometry.lie import exp_so3
from bellows_ros.core.signals.residuals import AXES, DISPLAY_FACTORS
from bellows_ros.plots.animation import bellows_rings
from bellows_ros.plots.viewer import write_view
import numpy as np
import pytest


def read(path):
    """Return what a file of Rerun holds, by entity and component; the longest of each."""
    chunk = pytest.importorskip('rerun.chunk', reason="no Rerun here (pip install '.[view]')")
    found = {}
    for part in chunk.RrdReader(path).stream():
        batch = part.to_record_batch()
        for name in batch.schema.names:
            column = batch.column(name)
            if len(column) >= len(found.get((part.entity_path, name), [])):
                found[part.entity_path, name] = column
    return found


@pytest.mark.extras
def test_what_is_written_is_what_was_replayed(replayed, tmp_path):
    """Hold every sample: poses in m, time series in mm and degrees, time in ns from the start."""
    pytest.importorskip('rerun', reason="no Rerun here (pip install '.[view]')")
    write_view(tmp_path / 'a.rrd', replayed, 'a recording')
    found = read(tmp_path / 'a.rrd')
    for axis, name in enumerate(AXES):
        for path, values in (
            (f'/package/{name}/measured', replayed.live.measured),
            (f'/package/{name}/predicted', replayed.live.predicted),
            (f'/error/{name}', np.full((51, 6), 5e-3)),
            (f'/deflection/{name}', replayed.deflection),
        ):
            (shown,) = zip(*found[path, 'Scalars:scalars'].to_pylist(), strict=True)
            np.testing.assert_allclose(shown, DISPLAY_FACTORS[axis] * values[:, axis])
    position = np.array(found['/world/predicted', 'Transform3D:translation'].to_pylist())
    np.testing.assert_allclose(position[:, 0], replayed.package.position, atol=1e-7)  # float32
    times = found['/deflection/x', 'time'].cast('int64').to_pylist()
    np.testing.assert_allclose(times, 1e9 * replayed.seconds, atol=1.0)


def test_a_bellows_begins_at_the_tool_and_ends_at_the_lip():
    """Leave along one z axis and arrive along the other."""
    R = exp_so3([0.2, 0.1, 0.0])
    lip = np.array([0.005, 0.0, -0.045])
    rings = bellows_rings(np.zeros(3), np.eye(3), lip, R)
    centres = rings[:, :-1].mean(axis=1)
    np.testing.assert_allclose(centres[[0, -1]], [np.zeros(3), lip], atol=1e-12)
    np.testing.assert_allclose((rings[-1] - lip) @ R[:, 2], 0.0, atol=1e-12)
