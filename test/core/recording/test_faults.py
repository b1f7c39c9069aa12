"""Each fault of the poses or stamps is seen without a fit, and none in sound ones."""

from dataclasses import replace

from bellows_ros.core.findings import Level
from bellows_ros.core.geometry import lie
from bellows_ros.core.geometry.lie import apply, exp_so3
from bellows_ros.core.model.cup_package import Package
from bellows_ros.core.recording.faults import pose_remarks
from bellows_ros.core.recording.outliers import find_outliers
from bellows_ros.core.recording.pose_faults import RecordedPoses
from bellows_ros.core.signals.resampling import clock_steps
from bellows_ros.core.signals.trajectory import PoseStream
import numpy as np
import pytest

from ...cell.motion import START

OUT = np.diag([1.0, -1.0, -1.0])


def body_of(topic, tool, package):
    return {tool.name: 'tool', package.name: 'package', '': ''}.get(topic, 'both')


def faults(tool, package):
    """Give codes and bodies of the faults that are found."""
    return [(found.code, body_of(found.topic, tool, package)) for found in remarks(tool, package)]


def remarks(tool, package):
    return pose_remarks(RecordedPoses(tool, package, np.eye(3)))


def waves(rng, t, hz, size):
    """Give six coordinates (N, 6) that oscillate at two frequencies each, at most as large."""
    return sum(np.sin(2.0 * np.pi * rng.uniform(*hz, 6) * t + rng.uniform(0.0, 6.0, 6))
               for _ in range(2)) * 0.5 * np.array(size)


def streams(seed):
    """Give a tool that moves and tilts widely, and the package that sways below it, with noise."""
    rng = np.random.default_rng(seed)
    stamps = START + np.arange(1200) * 8_333_333
    t = (stamps[:, None] - START) * 1e-9
    tool, sway = waves(rng, t, (0.15, 0.5), [0.3, 0.2, 0.2, 0.5, 0.5, 0.6]), waves(
        rng, t, (1.0, 3.0), [5e-3, 5e-3, 3e-3, 0.1, 0.1, 0.1])
    R, o = exp_so3(tool[:, 3:]), tool[:, :3] + [0.5, 0.1, 0.8]
    below = o + apply(R, sway[:, :3] + [0.0, 0.0, -0.07])
    return [PoseStream(
        f'/{name}', 'world', stamps, position + 1e-4 * rng.normal(size=(len(t), 3)),
        rotation @ exp_so3(3e-4 * rng.normal(size=(len(t), 3))))
        for name, position, rotation in (
            ('tool', o, R), ('package', below, R @ exp_so3(sway[:, 3:])))]


def apart(tool, package, seed):
    """Give the package as a camera sees its marker, in a world of its own."""
    R, marker = exp_so3(np.random.default_rng(seed).normal(size=(2, 3)))
    origin = package.position + package.rotation @ [0.1, 0.02, 0.0]
    return tool, replace(
        package, frame_id='camera', rotation=R @ package.rotation @ marker,
        position=apply(R, origin) + [1.0, 2.0, 0.5])


def changed(body, position=None, rotation=None):
    """Give a stream with other positions or rotations."""
    return replace(body, position=body.position if position is None else position,
                   rotation=body.rotation if rotation is None else rotation)


def w_first(body):
    return changed(body, rotation=lie.quaternion_to_rotation(
        np.roll(lie.rotation_to_quaternion(body.rotation), 1, axis=1)))


def still(body):
    rng = np.random.default_rng(0)
    return changed(body, body.position[0] + 1e-4 * rng.normal(size=body.position.shape),
                   body.rotation[0] @ exp_so3(3e-4 * rng.normal(size=body.position.shape)))


def on_tool(tool):
    rng = np.random.default_rng(1)
    return replace(
        tool, name='/package', position=tool.position + tool.rotation @ [0.02, 0.0, 0.03]
        + 1e-4 * rng.normal(size=tool.position.shape),
        rotation=tool.rotation @ exp_so3(3e-4 * rng.normal(size=tool.position.shape)))


def frozen(body):
    return changed(body, rotation=np.tile(body.rotation[:1], (len(body), 1, 1)))


def swapped(tool, package, *seconds, wrong=(True, True)):
    """Exchange the two bodies in some seconds, or give one body as both."""
    mask = np.isin(np.arange(len(tool)) // 120, seconds)[:, None]
    return [changed(
        one, np.where(mask & is_wrong, other.position, one.position),
        np.where((mask & is_wrong)[..., None], other.rotation, one.rotation))
        for one, other, is_wrong in zip((tool, package), (package, tool), wrong, strict=True)]


def clocks(tool, package, *sizes):
    """Let the clocks of both bodies step."""
    return [replace(body, clock_steps=((int(body.stamps_ns[500]), size),) if size else ())
            for body, size in zip((tool, package), sizes, strict=True)]


FAULTS = {
    'frozen package': (lambda t, p: (t, frozen(p)), 'frozen_orientation', 'package'),
    'frozen tool': (lambda t, p: (frozen(t), p), 'frozen_orientation', 'tool'),
    'on the tool': (lambda t, p: (t, on_tool(t)), 'no_swing', 'package'),
    'one body': (lambda t, p: (t, replace(t, name='/other')), 'no_swing', 'package'),
    'on the table': (lambda t, p: (t, still(p)), 'no_swing', 'package'),
    'clock': (lambda t, p: clocks(t, p, 0.0, -0.3), 'clock_step', 'package'),
    'swapped': (lambda t, p: swapped(t, p, 4), 'swapped', 'both'),
    'swapped at first': (lambda t, p: swapped(t, p, 0, 1), 'swapped', 'both'),
    'swapped from then on': (lambda t, p: swapped(t, p, *range(3, 10)), 'swapped', 'both'),
    'tool twice': (lambda t, p: swapped(t, p, 6, wrong=(False, True)), 'swapped', 'both'),
    'package twice': (lambda t, p: swapped(t, p, 6, wrong=(True, False)), 'swapped', 'both'),
    'at rest': (lambda t, p: (still(t), still(p)), 'tool_at_rest', 'tool'),
    'millimetres': (lambda t, p: (t, changed(p, 1e3 * p.position)), 'millimetres', 'package'),
    'w first': (lambda t, p: (t, w_first(p)), 'quaternions', 'package'),
    'w first in the tool': (lambda t, p: (w_first(t), p), 'quaternions', 'tool'),
    'w first in both': (lambda t, p: (w_first(t), w_first(p)), 'quaternions', 'both'),
    'exchanged': (lambda t, p: (p, t), 'exchanged', 'both'),
    'z of the tool': (lambda t, p: (changed(t, rotation=t.rotation @ OUT), p), 'tool_z', 'tool')}

TWO_FRAMES = {
    name: FAULTS[name][1:] for name in (
        'clock', 'at rest', 'frozen package', 'frozen tool', 'on the table',
        'millimetres', 'z of the tool')}
"""Code and body of the faults that are seen although the package is in two worlds."""


@pytest.mark.parametrize('name', FAULTS)
@pytest.mark.parametrize('seed', [3, 4])
def test_each_fault_is_seen_in_one_frame(name, seed):
    make, code, body = FAULTS[name]
    assert faults(*make(*streams(seed))) == [(code, body)]


@pytest.mark.parametrize('name', TWO_FRAMES)
@pytest.mark.parametrize('seed', [3, 4])
def test_faults_are_seen_in_two_frames(name, seed):
    code, body = TWO_FRAMES[name]
    ((found, place),) = faults(*FAULTS[name][0](*apart(*streams(seed), seed)))
    assert (found, place) == (code, body)


@pytest.mark.filterwarnings('ignore::bellows_ros.errors.UnitWarning')
@pytest.mark.parametrize('wrong', [
    {'com': (0.0, 0.0, 0.03)}, {'mass': 1800.0}, {'inertia': np.diag([4.38, 6.54, 9.84])},
    {}])
def test_each_impossible_package_is_seen_beside_sound_poses(wrong):
    package = Package(**{'mass': 1.8, 'inertia': np.diag([0.00438, 0.00654, 0.00984]),
                         'com': (0.0, 0.0, -0.03), **wrong})
    found = pose_remarks(RecordedPoses(*streams(3), np.eye(3), package))
    assert {(one.code, one.level) for one in found} == (
        {('implausible', Level.ERROR)} if wrong else set())


@pytest.mark.parametrize('seed', range(3, 13))
def test_sound_poses_have_no_fault_in_one_frame_or_two(seed):
    both = streams(seed)
    assert faults(*both) == faults(*apart(*both, seed)) == []


@pytest.mark.parametrize('seed', range(3, 13))
@pytest.mark.parametrize('samples', [3, 7])
def test_an_outlier_that_meets_the_other_body_is_no_exchange(samples, seed):
    """As the screening leaves it out, wherever it is."""
    tool, package = streams(seed)
    off = np.arange(500, 500 + samples)
    position, R = tool.position.copy(), tool.rotation.copy()
    position[off] = package.position[off] + 0.005 * np.random.default_rng(seed).normal(size=3)
    R[off] = R[off] @ exp_so3(np.array([0.3, -0.2, 0.2]))
    lost = changed(tool, position, R)
    assert not find_outliers(lost.trajectory(), 20_000_000).good[off].any()
    assert not faults(lost, package)


def test_a_base_that_drives_far_is_in_metres():
    far = [replace(body, position=body.position + np.outer(
        4e-9 * (body.stamps_ns - START), [1.0, 0.0, 0.0])) for body in streams(3)]
    assert np.ptp(far[0].position[:, 0]) > 25.0 and not faults(*far)


def test_streams_without_overlap_determine_no_roles():
    tool, package = streams(3)
    assert not remarks(tool, replace(package, stamps_ns=package.stamps_ns + 10**12))


@pytest.mark.parametrize('seed', [17, 108, 146, 165])
def test_poses_of_two_worlds_are_of_no_other_convention(seed):
    """Although with quaternions of another order the package would happen to hang nearly."""
    tool, package = streams(3)
    rng = np.random.default_rng(seed)
    turn = rng.normal(size=3)
    R = exp_so3(np.radians(rng.uniform(10.0, 180.0)) * turn / np.linalg.norm(turn))
    middle = tool.position.mean(axis=0) + 0.1 * rng.normal(size=3)
    turned = changed(package, middle + (package.position - middle) @ R.T, R @ package.rotation)
    assert not {'quaternions', 'millimetres'} & {code for code, _ in faults(tool, turned)}


@pytest.mark.parametrize('seed', range(3, 13))
def test_a_flange_that_does_not_turn_has_no_quaternions_of_another_order(seed):
    """Another order would turn z of the tool upwards, without any effect on the motion."""
    tool, package = streams(seed)
    rng = np.random.default_rng(seed)
    turn = exp_so3(np.array([0.0, 0.0, rng.uniform(-0.3, 0.3)]))
    R = turn @ OUT @ exp_so3(1e-4 * rng.normal(size=tool.position.shape))
    swing = 0.2 * lie.log_so3(package.rotation[0].T @ package.rotation)
    held = turn @ exp_so3(swing)
    hung = changed(package, tool.position + held @ [0.0, 0.0, -0.08], held)
    assert faults(changed(tool, rotation=R), hung) == [('tool_z', 'tool')]


@pytest.mark.parametrize('fixed', [True, False])
@pytest.mark.parametrize('seed', range(3, 8))
def test_a_package_fixed_to_a_tool_that_tilts_little_is_seen(fixed, seed):
    """Of 10 mm and 0.06 rad, where a cup bends by a part of the tilt."""
    tool, package = streams(seed)
    rng = np.random.default_rng(seed)
    small = replace(tool, position=tool.position[0] + 0.05 * (tool.position - tool.position[0]),
                    rotation=exp_so3(0.15 * lie.log_so3(tool.rotation)))
    bend = exp_so3(0.04 * 0.15 * lie.log_so3(tool.rotation) + 3e-4 * rng.normal(size=(1200, 3)))
    body = on_tool(small) if fixed else replace(
        small, name='/package', rotation=small.rotation @ bend,
        position=small.position - small.rotation[:, :, 2] * 0.07)
    assert [code for code, _ in faults(small, body)] == ['no_swing'] * fixed


@pytest.mark.parametrize('size', [-4.1, -0.3, -0.02, 0.02, 0.3, 4.1])
@pytest.mark.parametrize('rate_hz', [30, 360])
def test_a_clock_step_is_distinguished_from_delays(size, rate_hz):
    """Through delays of 2 ms, a stall of the recorder of 0.5 s, and clocks 200 ppm apart."""
    rng = np.random.default_rng(rate_hz)
    t = np.arange(0.0, 20.0, 1.0 / rate_hz)
    arrival = 1.0002 * t + 2e-3 * rng.exponential(size=len(t))
    arrival = np.sort(np.where((t > 5.0) & (t < 5.5), 5.5 + 1e-3 * (t - 5.0), arrival))
    stamps = (1e9 * (t + size * (t > 13.0))).astype(np.int64)
    arrivals = (1e9 * arrival).astype(np.int64)
    ((at, found),) = clock_steps(stamps, arrivals)
    assert abs(at * 1e-9 - 13.0) < 2.0 / rate_hz and abs(found - size) < 5e-3
    assert clock_steps((1e9 * t).astype(np.int64), arrivals) == ()
