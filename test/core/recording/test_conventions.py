"""Units and orders of quaternions are found from how two bodies move."""

from dataclasses import replace
from itertools import product
from typing import NamedTuple

from bellows_ros.core.geometry.lie import exp_so3
from bellows_ros.core.recording.faults import pose_remarks
from bellows_ros.core.recording.pose_faults import RecordedPoses
from bellows_ros.core.signals.trajectory import PoseStream
import numpy as np
import pytest

from ...cell.motion import shake
from ...cell.sensors import record


class Convention(NamedTuple):
    """Positions in mm, quaternions with w first."""

    millimetres: bool
    w_first: bool


BODIES = {'/tool': 'tool', '/package': 'package', "/tool' and '/package": 'both'}
ALL = [Convention(*own) for own in product((False, True), repeat=2)]


def remarks(*both):
    return pose_remarks(RecordedPoses(*both, np.eye(3)))


def faults(*both):
    """Return codes and bodies of the faults that are found."""
    return {(found.code, BODIES[found.topic]) for found in remarks(*both)}


def expected(tool, package):
    """Return the faults of poses by such conventions; orders are judged of poses in metres."""
    first = {(True, False): 'tool', (False, True): 'package', (True, True): 'both'}.get(
        (tool.w_first, package.w_first))
    return {('millimetres', body) for body, own in (('tool', tool), ('package', package))
            if own.millimetres} or ({('quaternions', first)} if first else set())


def w_first(R):
    """Return rotations as they are read if quaternions had w first."""
    from scipy.spatial.transform import Rotation

    return Rotation.from_quat(np.roll(Rotation.from_matrix(R).as_quat(), 1, axis=1)).as_matrix()


def streams(tool, package):
    """Return both bodies of a held package, recorded by such conventions."""
    held = record(shake(duration=6.0, seed=3))
    bodies = (held.aligned_tool, held.aligned_package)
    return [PoseStream(
        f'/{name}', 'world', body.stamps_ns, body.position * (1e3 if own.millimetres else 1.0),
        w_first(body.rotation) if own.w_first else body.rotation)
        for name, body, own in zip(('tool', 'package'), bodies, (tool, package), strict=True)]


@pytest.mark.parametrize(('tool', 'package'), [
    (ALL[0], ALL[0]), (ALL[1], ALL[2]), (ALL[2], ALL[0]), (ALL[1], ALL[1])])
def test_each_stream_has_its_own(tool, package):
    assert faults(*streams(tool, package)) == expected(tool, package)


@pytest.mark.parametrize('millimetres', [False, True])
def test_millimetres_of_another_world_are_seen_by_how_far_both_move(millimetres):
    tool, package = streams(ALL[0], Convention(millimetres, False))
    R, shift = exp_so3(np.array([0.5, -1.0, 2.0])), 3e3 if millimetres else 3.0
    apart = replace(package, frame_id='camera', rotation=R @ package.rotation,
                    position=package.position @ R.T + shift)
    assert faults(tool, apart) == ({('millimetres', 'package')} if millimetres else set())


def test_a_base_that_drives_far_is_in_metres():
    tool, package = streams(*ALL[:1] * 2)
    driven = [replace(body, position=body.position + np.outer(
        5e-9 * (body.stamps_ns - tool.stamps_ns[0]), [1.0, 0.0, 0.0])) for body in (tool, package)]
    assert np.ptp(driven[0].position[:, 0]) > 25.0
    assert not faults(*driven)


@pytest.mark.parametrize('seed', [17, 108, 146, 165])
def test_poses_of_two_worlds_are_of_no_other_convention(seed):
    """Although with quaternions of another order the package would happen to hang nearly."""
    tool, package = streams(*ALL[:1] * 2)
    rng = np.random.default_rng(seed)
    turn = rng.normal(size=3)
    R = exp_so3(np.radians(rng.uniform(10.0, 180.0)) * turn / np.linalg.norm(turn))
    middle = tool.position.mean(axis=0) + 0.1 * rng.normal(size=3)
    turned = replace(package, position=middle + (package.position - middle) @ R.T,
                     rotation=R @ package.rotation)
    assert not {'quaternions', 'millimetres'} & {code for code, _ in faults(tool, turned)}


def test_streams_without_overlap_determine_no_roles():
    one, other = streams(*ALL[:1] * 2)
    later = replace(other, stamps_ns=other.stamps_ns + 10**12)
    assert not remarks(one, later)
