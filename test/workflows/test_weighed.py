"""Recordings with a force-torque sensor, from files to the cup and the cell."""

from dataclasses import replace

from bellows_ros.core.geometry import lie
from bellows_ros.core.parameters.checks import resolve
from bellows_ros.core.sensors.weighing import Wrenches
from bellows_ros.core.synthetic.motion import MoveAndHold, Pose, Waypoints
from bellows_ros.errors import BellowsError
from bellows_ros.files import bags, messages
from bellows_ros.files.bag_writer import as_messages, write_bag
from bellows_ros.files.parameter_files import read_parameters
from bellows_ros.workflows.identify import identify
from bellows_ros.workflows.pressed import pressed_check, save_stiffness
from bellows_ros.workflows.recordings import load
import numpy as np
import pytest

from ..core.identification import felt, test_pressed

TOPICS = {'tool_pose': '/tool', 'package_pose': '/package', 'tool_wrench': '/wrench'}


@pytest.fixture(scope='module')
def cell(tmp_path_factory):
    """Return settings with recordings of a package and of the empty gripper."""
    folder = tmp_path_factory.mktemp('cell')
    for name, package in (('held', felt.PACKAGE), ('empty', None)):
        *poses, wrenches = felt.streams(1, 'ATI', 6.0, package=package)
        write_bag(folder / name, [
            *(as_messages(f'/{each.name}', messages.POSE, each.stamps_ns, np.hstack([
                each.position, lie.rotation_to_quaternion(each.rotation)])) for each in poses),
            as_messages(TOPICS['tool_wrench'], messages.WRENCH, wrenches.stamps_ns, np.hstack(
                [wrenches.linear, wrenches.angular]), 'sensor')])
    values = felt.settings('ATI')
    stated = {name: values[name] for name in values if name.startswith(('wrench.', 'package.'))}
    return {**stated, **{f'topics.{role}': topic for role, topic in TOPICS.items()},
            'package.mass': 1.1 * felt.PACKAGE.mass, 'cup.length': felt.CUP.length,
            'fit.structure': 'axisymmetric', 'recording.package_frame': 'com',
            'fit.method': 'output_error', 'bags': [str(folder / 'held')],
            'gripper.bags': [str(folder / 'empty')]}


def test_identify_weighs_the_package(cell):
    """Mass, gripper and sensor are in the cell file; the mass is within three deviations."""
    result = identify(cell)
    mass, std, _ = result.found['package.mass']
    assert abs(mass - felt.PACKAGE.mass) < 3.0 * np.max(std) < 0.05 * mass
    written = result.cell_parameters()
    assert abs(written['gripper.mass'] - 0.6) < 0.01
    assert written['wrench.frame'] == cell['wrench.frame']
    assert written['package.mass'] == mass


def test_wrenches_in_axes_of_the_world_are_turned(cell):
    """A message with the frame of the tool's poses gives the same readings."""
    values = resolve(cell)
    recording = load(cell['bags'][0], values, held=True)
    stream = bags.read_streams(cell['bags'][0], {'tool_wrench': '/wrench'})['tool_wrench']
    tool = recording.aligned_tool
    inside = stream.stamps_ns <= tool.stamps_ns[-1]
    R = tool.rotation[np.searchsorted(tool.stamps_ns, stream.stamps_ns[inside])]
    turned = replace(
        stream, frame_id='world', stamps_ns=stream.stamps_ns[inside],
        **{name: lie.apply(R, getattr(stream, name)[inside]) for name in ('linear', 'angular')})
    found = Wrenches.of(turned, tool, 'world', np.eye(3), values)
    np.testing.assert_allclose(found.values, recording.further[0].values, atol=1e-6)


def test_identify_needs_no_poses_of_the_package(cell):
    """K about x and mass are of wrenches alone, within their standard errors, and no P is sure."""
    result = identify({**cell, 'topics.package_pose': ''})
    K, std = (np.diag(each)[3] for each in (result.fit.stiffness, result.fit.stiffness_std))
    assert abs(K - felt.CUP.stiffness[3, 3]) < 3.0 * std < 0.1 * K
    mass, std, _ = result.found['package.mass']
    assert abs(mass - felt.PACKAGE.mass) < 3.0 * np.max(std) < 0.05 * mass
    assert 'measured.offset' not in result.found and 'P may be off' in str(result.fit.notes)
    with pytest.raises(BellowsError, match='name the topic of one'):
        identify({**cell, 'topics.package_pose': '', 'topics.tool_wrench': ''})
    with pytest.raises(BellowsError, match="topics.package_pose is ''"):
        load(cell['bags'][0], resolve({**cell, 'topics.package_pose': ''}))


def test_a_topic_of_another_type_is_named(cell):
    """Poses are no wrenches; the topic of wrenches is proposed."""
    with pytest.raises(BellowsError, match='topics.tool_wrench to one of: /wrench'):
        load(cell['bags'][0], resolve({**cell, 'topics.tool_wrench': '/tool'}), held=True)


def test_a_pressed_cup_is_found_from_a_recording(cell, tmp_path):
    """Poses at rest and their wrenches are means of standstills; K goes to a file."""
    tool, shown, *_ = test_pressed.pressed(2)
    poses = [Pose(*each) for each in zip(tool.position, tool.rotation, strict=True)]
    motion = Waypoints(poses[0], 1.0, tuple(
        MoveAndHold(pose, 0.5, 1.0) for pose in poses[1:])).at_rate(100.0, 1_000_000_000)
    places = np.minimum((motion.seconds / 1.5).astype(int), len(poses) - 1)
    write_bag(tmp_path / 'pressed', [
        as_messages('/tool', messages.POSE, motion.stamps_ns, np.hstack([
            motion.position, lie.rotation_to_quaternion(motion.rotation)])),
        as_messages('/wrench', messages.WRENCH, motion.stamps_ns, shown[places], 'sensor')])
    result = pressed_check([str(tmp_path / 'pressed')], {
        **cell, 'fit.structure': 'axisymmetric', 'wrench.delay': 0.0})
    save_stiffness(result, tmp_path / 'cup.yaml')
    K = np.diag(np.reshape(read_parameters(tmp_path / 'cup.yaml')['cup.stiffness'], (6, 6)))
    off = K - np.diag(felt.CUP.stiffness)
    assert len(poses) - 1 <= result.cup.standstills <= len(poses)
    assert np.all(np.abs(off) < 3.0 * np.diag(result.cup.stiffness_std))
