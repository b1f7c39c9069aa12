"""What is compiled where a node is configured is all that predicting needs."""

import subprocess
import sys

import pytest

SCRIPT = """
import math
import sys
from bellows_ros.core.live import LivePredictor, warm_up
from bellows_ros.core.live.load import Load
from bellows_ros.core.live.uncertainty import Uncertainty, warm_up_uncertainty
from bellows_ros.core.model.cup_package import cup_of, package_of
from bellows_ros.core.parameters.checks import resolve

values = resolve({
    'package.mass': 2.17, 'package.inertia': [0.0087, 0.0087, 0.0173, 0.0, 0.0, 0.0],
    'package.com': [0.0, 0.0, -0.03], 'cup.lip_radius': 0.02,
    'vacuum.holding': 6e4, 'tool_twist.frame': '%s'})
model = (cup_of(values), package_of(values), 9.81, values['tool_twist.frame'])
warm_up(*model)
live = LivePredictor(*model)
warm_up_uncertainty()


def kernels():
    found = {}
    for name, module in list(sys.modules.items()):
        if name.startswith('bellows_ros.'):
            for key, kernel in vars(module).items():
                if hasattr(kernel, 'nopython_signatures'):
                    found[f'{name}.{key}'] = len(kernel.nopython_signatures)
    return found


before = kernels()
load, uncertainty = Load(values), Uncertainty(live.model, values)
MS, UPRIGHT, stamp, out = 10**6, (0.0, 0.0, 0.0, 1.0), 10**18, []
for k in range(400):
    stamp += 2 * MS if k %% 100 else 700 * MS
    x = 0.05 * math.sin(0.01 * k)
    bad = math.nan if k %% 50 == 7 else 0.0
    frame = 'map' if k > 390 else 'base'
    out += live.on_pose(stamp, frame, (x, bad, 0.5), UPRIGHT, stamp)
    if 100 < k < 200 or k > 300:
        out += live.on_twist(stamp - MS * (k %% 3), (x, 0.0, 0.0), (0.0, 0.1, 0.0), 'base')
    out += live.coast(stamp + 50 * MS)
    if k == 250:
        live.set_model(*model[:2])
for prediction in out[::10]:
    load.watch_force(live.model, prediction)
    load.watch_deflection(live.model, prediction)
    uncertainty.covariance(prediction)
assert len(out) > 400 and live.coasted, len(out)
after = kernels()
assert before, 'no kernels found'
print([name for name in after if after[name] != before.get(name, 0)])
"""


@pytest.mark.timeout(400)
@pytest.mark.parametrize('frame', ['world', 'tool'])
def test_nothing_is_compiled_once_the_node_is_configured(root, user_environment, frame):
    pytest.importorskip('numba', reason='without numba nothing is compiled')
    done = subprocess.run(
        [sys.executable, '-c', SCRIPT % frame], env=user_environment, cwd=root,
        capture_output=True, text=True, timeout=300)
    assert (done.returncode, done.stdout) == (0, '[]\n'), done.stdout + done.stderr
