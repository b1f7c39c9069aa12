"""Cups for MuJoCo: the right numbers in the right places, and the swing of the model."""

from dataclasses import replace
from xml.etree import ElementTree

from bellows_ros.core.model.cup_package import Cup, Package
from bellows_ros.core.model.simulation import simulate
from bellows_ros.core.signals.trajectory import Trajectory
from bellows_ros.files.mjcf import mjcf
import numpy as np
import pytest

CUP = Cup.thesis()
PACKAGE = Package(2.17, np.diag([0.0087, 0.0088, 0.0173]), (0.0, 0.001, -0.03))
GRAVITY = np.array([4.0, 0.0, -9.0])


def test_six_joints_stand_in_the_middle_of_the_cup():
    """Slide before turning, each with its own spring and damper; gravity and body as given."""
    text, lacking = mjcf(CUP, PACKAGE, GRAVITY)
    root = ElementTree.fromstring(text)
    joints = root.findall('.//joint')
    assert [j.get('type') for j in joints] == ['slide'] * 3 + ['hinge'] * 3
    assert [j.get('axis') for j in joints] == 2 * ['1 0 0', '0 1 0', '0 0 1']
    for name, matrix in (('stiffness', CUP.stiffness), ('damping', CUP.damping)):
        assert [float(j.get(name)) for j in joints] == np.diag(matrix).tolist()
    assert lacking == []

    def numbers(path, name):
        return [float(word) for word in root.find(path).get(name).split()]

    assert numbers('option', 'gravity') == GRAVITY.tolist()
    com = [0.0, 0.001, -0.03 - CUP.length / 2]
    np.testing.assert_allclose(numbers('.//inertial', 'pos'), com)
    np.testing.assert_allclose(numbers(".//body[@name='package']", 'pos')[2], -CUP.length / 2)
    assert numbers('.//inertial', 'fullinertia') == [0.0087, 0.0088, 0.0173, 0.0, 0.0, 0.0]


def test_what_the_joints_lack_is_named():
    """Name off-diagonal entries, relaxation and stretch of a cup that has them."""
    K = np.array(CUP.stiffness)
    K[0, 1] = K[1, 0] = 0.2 * K[0, 0]
    cup = replace(CUP, stiffness=K, relaxation=(0.2, 0.1), stretch=(-1e4, 0.0))
    assert mjcf(cup, PACKAGE, GRAVITY)[1] == [
        'off-diagonal entries of K', 'cup.relaxation', 'cup.stretch']


@pytest.mark.extras
def test_mujoco_swings_as_the_model_does():
    """Pull the package 2 mm aside without gravity, let go, and compare half a second."""
    mujoco = pytest.importorskip('mujoco', reason='no MuJoCo here (pip install mujoco)')
    package = Package(2.17, PACKAGE.inertia, (0.0, 0.0, -0.03))
    model = mujoco.MjModel.from_xml_string(mjcf(CUP, package, np.zeros(3))[0])
    data = mujoco.MjData(model)
    count, step = round(0.5 / model.opt.timestep), round(1e9 * model.opt.timestep)
    tool = Trajectory(
        np.arange(1, count + 1) * step, np.zeros((count, 3)), np.tile(np.eye(3), (count, 1, 1)),
        np.zeros((count, 6)))
    zero = (0.0, 0.0, 0.0)
    start = (2e-3, 0.0, package.com[2] - CUP.length), (0.0, 0.0, 0.0, 1.0), zero, zero
    ours = simulate(CUP, package, tool, start, 0.0)
    data.qpos[0] = 2e-3
    theirs = []
    for _ in range(count):
        mujoco.mj_kinematics(model, data)
        theirs.append(data.site('B').xpos - [0.0, 0.0, 1.0])
        mujoco.mj_step(model, data)
    assert np.ptp(ours.position[:, 0]) > 2e-3
    # 0.5 % of the amplitude: linear springs differ in second order of it.
    np.testing.assert_allclose(theirs, ours.position, atol=1e-5)
