"""Cups for simulators: well-formed, with the right numbers in the right places."""

from dataclasses import replace
from xml.etree import ElementTree

from bellows_ros.core.model.cup_package import Cup, model_tuple, Package, STANDARD_GRAVITY
from bellows_ros.core.model.equilibrium import linearise, static_equilibrium
from bellows_ros.core.model.simulation import simulate, state_row
from bellows_ros.core.signals.trajectory import Trajectory
from bellows_ros.files.exports import limits, TARGETS
import numpy as np
import pytest

CUP = Cup.thesis()
ROUND = replace(CUP, stiffness=np.diag([5400.0, 5400.0, 9200.0, 4.2, 4.2, 1.35]))
PACKAGE = Package(2.17, np.diag([0.0087, 0.0088, 0.0173]), (0.0, 0.001, -0.03))
K, P = (np.diag(m).tolist() for m in (CUP.stiffness, CUP.damping))


def parsed(name):
    """Return a model's root."""
    return ElementTree.fromstring(TARGETS[name].write(CUP, PACKAGE))


def numbers(text):
    """Return the numbers in a text."""
    return [float(word) for word in (text or '').split()]


def test_mjcf_has_six_joints_in_the_middle_of_the_cup():
    """Slide before turning, each with its own spring and damper."""
    body = parsed('mjcf').find("worldbody/body/body[@name='package']")
    assert body is not None
    joints = body.findall('joint')
    assert [j.get('type') for j in joints] == ['slide'] * 3 + ['hinge'] * 3
    assert [float(j.get('stiffness', 0)) for j in joints] == K
    assert [float(j.get('damping', 0)) for j in joints] == P
    inertial = body.find('inertial')
    assert inertial is not None
    np.testing.assert_allclose(numbers(body.get('pos')), [0.0, 0.0, -CUP.length / 2])
    np.testing.assert_allclose(
        numbers(inertial.get('pos')), [0.0, 0.001, -0.03 - CUP.length / 2])


def test_sdf_is_a_chain_of_six_joints():
    """Lead from the tool to the package without a gap."""
    model = parsed('sdf').find('model')
    assert model is not None
    joints = model.findall('joint')
    ends = [(j.findtext('parent'), j.findtext('child')) for j in joints]
    assert ends[0][0] == 'tool' and ends[-1][1] == 'package'
    assert all(a[1] == b[0] for a, b in zip(ends, ends[1:], strict=False))
    springs = [float(j.findtext('axis/dynamics/spring_stiffness') or 0) for j in joints]
    assert springs == K


# What SDFormat 1.9 says of the elements used: their children, and those that are required.
SDF = {
    'sdf': 'model*', 'model': 'link* joint', 'link': 'pose inertial',
    'inertial': 'pose mass* inertia*', 'inertia': 'ixx* iyy* izz* ixy* ixz* iyz*',
    'joint': 'parent* child* axis', 'axis': 'xyz* dynamics limit*',
    'dynamics': 'damping spring_reference* spring_stiffness*', 'limit': 'lower* upper*'}


def test_sdf_holds_its_schema():
    """Use elements where SDFormat has them, with all that it requires, and name things once."""
    root = parsed('sdf')
    for element in root.iter():
        words = SDF.get(element.tag, '').split()
        children = [child.tag for child in element]
        assert set(children) <= {word.rstrip('*') for word in words}, element.tag
        assert {word[:-1] for word in words if word.endswith('*')} <= set(children), element.tag
        if not children and element.tag not in ('parent', 'child', 'link'):
            assert len(numbers(element.text)) == {'pose': 6, 'xyz': 3}.get(element.tag, 1)
    names = [element.get('name') for element in root.iter() if element.get('name')]
    assert len(set(names)) == len(names)
    masses = [float(mass.text or 0) for mass in root.iter('mass')]
    assert len(masses) == len(list(root.iter('link'))) and min(masses) > 0.0
    assert max(masses) == PACKAGE.mass


@pytest.mark.parametrize('name', TARGETS)
def test_losses_are_reported(name):
    """Name off-diagonal entries only where there are some, with their size."""
    assert not any(word in sentence for sentence in limits(TARGETS[name], CUP)
                   for word in ('off-diagonal', 'relaxation', 'stretch'))
    rubber = limits(TARGETS[name], replace(CUP, relaxation=(0.2, 0.1)))
    assert ('relaxation' in rubber[0]) == (name != 'c')
    stretched = limits(TARGETS[name], replace(CUP, stretch=(-1e4, 0.0)))
    assert ('cup.stretch' in stretched[0]) == (name != 'c')
    coupled = np.array(CUP.stiffness)
    coupled[0, 1] = coupled[1, 0] = 0.2 * coupled[0, 0]
    lost = limits(TARGETS[name], Cup(coupled, CUP.damping, CUP.length))
    if TARGETS[name].whole:
        assert lost == limits(TARGETS[name], CUP)
        return
    assert 'off-diagonal entries of K' in lost[0] and '20 %' in lost[0]


def test_gravity_is_written_or_reported_as_missing():
    """Write gravity into MJCF; tell for SDF, whose models have none, the line for the world."""
    gravity = (4.0, 0.0, -9.0)
    option = ElementTree.fromstring(TARGETS['mjcf'].write(CUP, PACKAGE, gravity)).find('option')
    assert option is not None and numbers(option.get('gravity')) == list(gravity)
    assert numbers(parsed('mjcf').find('option').get('gravity')) == [0.0, 0.0, -9.81]
    assert '<gravity>4.0 0.0 -9.0</gravity>' in TARGETS['sdf'].write(CUP, PACKAGE, gravity)
    assert '<gravity>4 0 -9</gravity>' in limits(TARGETS['sdf'], CUP, gravity)[0]
    assert limits(TARGETS['sdf'], CUP) == limits(TARGETS['sdf'], CUP, (0.0, 0.0, -9.81))


@pytest.mark.extras
def test_mujoco_swings_as_the_model_does():
    """Pull the package 2 mm aside without gravity, let go, and compare half a second."""
    mujoco = pytest.importorskip('mujoco', reason='no MuJoCo here (pip install mujoco)')
    package = Package(2.17, PACKAGE.inertia, (0.0, 0.0, -0.03))
    model = mujoco.MjModel.from_xml_string(TARGETS['mjcf'].write(CUP, package))
    model.opt.gravity[:] = 0.0
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
    # 0.5 % of the amplitude: what `limits` names is of second order in it.
    np.testing.assert_allclose(theirs, ours.position, atol=1e-5)


@pytest.mark.extras
@pytest.mark.parametrize(('gravity', 'most'), [(4.0, 0.015), (STANDARD_GRAVITY, 0.09)])
def test_mujoco_on_a_wall_is_as_wrong_as_it_says(gravity, most):
    """The package bends the cup by 6 and 15 degrees: compare the natural frequencies there."""
    mujoco = pytest.importorskip('mujoco', reason='no MuJoCo here (pip install mujoco)')
    package = Package(2.17, np.diag([0.0087, 0.0087, 0.0173]), (0.0, 0.0, -0.03))
    down = (gravity, 0.0, 0.0)
    model = mujoco.MjModel.from_xml_string(
        TARGETS['mjcf'].write(ROUND, package, down))
    ours = model_tuple(ROUND, package, down)
    data, tool = mujoco.MjData(model), state_row(np.zeros(3), np.array([0.0, 0.0, 0.0, 1.0]))
    body = state_row(*map(np.array, static_equilibrium(ours, tool)[:2]))

    def acceleration(q):
        data.qpos[:], data.qvel[:] = q, 0.0
        mujoco.mj_forward(model, data)
        return data.qacc.copy()

    def slopes(q):
        return np.transpose([(acceleration(q + by) - acceleration(q - by)) / 2e-6
                             for by in 1e-6 * np.eye(6)])

    def frequencies(matrix):
        return np.sqrt(np.sort(np.linalg.eigvals(-matrix).real))

    q = np.zeros(6)
    for _ in range(20):
        q -= np.linalg.solve(slopes(q), acceleration(q))
    assert np.degrees(np.linalg.norm(q[3:])) == pytest.approx(1.5 * gravity, abs=0.5)
    right = frequencies(linearise(ours, tool, body).body_pose)
    off = np.abs(frequencies(slopes(q)) / right - 1.0).max()
    assert 0.5 * most < off < most


@pytest.mark.extras
def test_drake_lets_the_package_sag_as_far_as_it_should():
    """Load the SDF where Drake is installed, and wait until the package hangs still."""
    drake = pytest.importorskip('pydrake.all', reason='no Drake here (pip install drake)')
    builder = drake.DiagramBuilder()
    plant, _ = drake.AddMultibodyPlantSceneGraph(builder, 0.0)
    still = Package(2.17, PACKAGE.inertia, (0.0, 0.0, -0.03))
    drake.Parser(plant).AddModelsFromString(TARGETS['sdf'].write(CUP, still), 'sdf')
    plant.WeldFrames(plant.world_frame(), plant.GetFrameByName('tool'))
    plant.Finalize()
    simulator = drake.Simulator(builder.Build())
    simulator.AdvanceTo(2.0)
    context = plant.GetMyContextFromRoot(simulator.get_context())
    pose = plant.EvalBodyPoseInWorld(context, plant.GetBodyByName('package'))
    sag = 2.17 * plant.gravity_field().gravity_vector()[2] / K[2]
    # The dummy links of plain SDF weigh something too.
    np.testing.assert_allclose(pose.translation()[2], -CUP.length / 2 + sag, atol=1.5e-5)
