"""Kinematics of an arm from its URDF: pose and Jacobian of the tool for joint positions."""

from collections.abc import Mapping, Sequence
import math
from typing import NamedTuple
from xml.etree import ElementTree

from bellows_ros.core.geometry import lie
from bellows_ros.core.geometry.arrays import Array
from bellows_ros.core.parameters.checks import MAX_NUMBER
from bellows_ros.errors import BellowsError, require_names, shown
import numpy as np

MAX_URDF_SIZE = 10_000_000
"""Largest number of characters in a URDF."""

POSE_TOLERANCE = 1e-9
"""Largest error of the tool pose by inverse kinematics, m and rad."""

MAX_ITERATIONS = 30
"""Largest number of iterations of the inverse kinematics."""
MAX_JOINT_STEP = 0.5
"""Longest step of the joints in an iteration, rad or m."""

MIN_RATIO = 1e-4
"""Smallest ratio of a singular value to the largest one; smaller singular values are ignored."""

TURNING = 'revolute', 'continuous'


class Joint(NamedTuple):
    """A joint of the chain; its child's pose is origin times the motion along the axis."""

    name: str
    kind: str
    origin: Array
    """Pose of the joint in its parent (4, 4)."""
    axis: Array
    """Unit vector of the axis in the joint's frame (3,)."""
    lower: float = -math.inf
    upper: float = math.inf
    """Upper end of its range, rad or m."""
    speed: float = math.inf
    """Largest speed, rad/s or m/s."""
    drive: str = ''
    """Name of the mimicked joint, with its range and speed; '' for an independent joint."""
    ratio: float = 1.0
    offset: float = 0.0
    """Offset of the position, rad or m: position = ratio * position of the drive + offset."""


class Arm(NamedTuple):
    """
    The joints from the root of a URDF to the tool, in this order.

    Parameters
    ----------
    root, tool_link : str
        Links; the tool's pose is the pose of `tool_link` in `root`.
    joints : tuple of Joint

    """

    root: str
    tool_link: str
    joints: tuple[Joint, ...]

    def with_tip(self, tip: Array | None) -> 'Arm':
        """Return the arm with E at a pose (4, 4) in its tool link."""
        if tip is None:
            return self
        return self._replace(joints=(*self.joints, Joint('', 'fixed', tip, np.eye(3)[2])))

    @property
    def moving(self) -> tuple[str, ...]:
        """Names of the moving joints, without mimicking ones."""
        return tuple(joint.name for joint in self.moving_joints)

    @property
    def moving_joints(self) -> tuple[Joint, ...]:
        """Joints that are not fixed; a joint that drives several others appears once."""
        drives = {joint.drive or joint.name: joint
                  for joint in reversed(self.joints) if joint.kind != 'fixed'}
        return tuple(joint._replace(name=name) for name, joint in reversed(drives.items()))

    def columns(self, names: Sequence[str], of: str) -> list[int]:
        """
        Return the columns of this arm's joints among the names.

        Raises
        ------
        BellowsError
            If a joint is missing; `of` names the owner of the joints.

        """
        missing = [name for name in self.moving if name not in names]
        if missing:
            raise BellowsError(
                f"{of} lacks the joint '{shown(missing[0])}' on the way from "
                f"'{shown(self.root)}' to '{shown(self.tool_link)}'; it has "
                f"{shown(', '.join(names), 300) or 'none'}. Give the URDF of this arm, or another "
                'tool_link.')
        return [list(names).index(name) for name in self.moving]

    def tool(self, position: Array, velocity: Array | None = None) -> tuple[Array, Array]:
        """
        Return poses (N, 4, 4) and body twists (N, 6) of the tool.

        Parameters
        ----------
        position, velocity : array (N, M)
            Motion of the moving joints in their order, rad or m, per second; default: at rest.

        """
        T, J = self._moved(position)
        return T, lie.apply(J, np.zeros_like(position) if velocity is None else velocity)

    def jacobian(self, position: Array) -> Array:
        """Return the derivative (N, 6, M) of the tool's displacement in body axes."""
        return self._moved(position)[1]

    def _moved(self, position: Array) -> tuple[Array, Array]:
        """Return poses of the tool, and the twist in tool axes by each joint."""
        T, names = np.tile(np.eye(4), (len(position), 1, 1)), self.moving
        J, moved = np.zeros((len(T), len(names), 6)), []
        for joint in self.joints:
            T = T @ joint.origin
            if joint.kind != 'fixed':
                column, zero = names.index(joint.drive or joint.name), np.zeros(3)
                q = np.multiply.outer(
                    joint.ratio * position[:, column] + joint.offset, joint.axis)
                linear, angular = (zero, joint.axis) if joint.kind in TURNING else (
                    joint.axis, zero)
                moved.append((column, T, joint.ratio * np.concatenate([linear, angular])))
                T = T @ (lie.transform(lie.exp_so3(q), zero) if joint.kind in TURNING
                         else lie.transform(np.eye(3), q))
        for column, frame, twist in moved:
            J[:, column] += lie.apply(lie.adjoint(lie.inverse_transform(T) @ frame), twist)
        return T, np.swapaxes(J, 1, 2)

    def positions(self, T: Array, guess: Array) -> Array:
        """
        Return the joints (N, M) for tool poses (N, 4, 4), searched from a guess, (M,) or (N, M).

        Raises
        ------
        BellowsError
            If a pose is out of reach, or beyond a singularity.

        """
        position = np.array(np.broadcast_to(guess, (len(T), len(self.moving))))
        for _ in range(MAX_ITERATIONS):
            error = lie.log_se3(lie.inverse_transform(self.tool(position)[0]) @ T)
            if np.abs(error).max() < POSE_TOLERANCE:
                return position
            step = np.linalg.pinv(self.jacobian(position), rcond=MIN_RATIO) @ error[:, :, None]
            position = position + np.clip(step[:, :, 0], -MAX_JOINT_STEP, MAX_JOINT_STEP)
        worst = int(np.argmax(np.abs(error).max(axis=1)))
        raise BellowsError(
            f'The arm cannot reach {np.round(T[worst, :3, 3], 3).tolist()} m from the joint '
            'positions of the start. Make the workspace smaller, or start away from '
            'singularities and joint limits.')


def read_arm(urdf: str, tool_link: str) -> Arm:
    """
    Return the chain to a link of a URDF.

    Parameters
    ----------
    urdf : str
        XML, as on /robot_description.
    tool_link : str
        Link at the tool tip E, with z along the cup.

    Raises
    ------
    BellowsError
        If the text is not a URDF, the link is missing or does not move, or a joint of the chain is
        not fixed, revolute, continuous or prismatic, or a joint mimics a joint that itself mimics
        another.

    """
    joints = _robot(urdf).findall('joint')
    by_child = {_attribute(joint, 'child', 'link'): joint for joint in joints}
    chain, link = list[ElementTree.Element](), tool_link
    while link in by_child and len(chain) <= len(by_child):
        chain.append(by_child[link])
        link = _attribute(by_child[link], 'parent', 'link')
    names = (link, *(each.get('name', '') for each in chain))
    if len(chain) > len(by_child) or not all(names):
        raise BellowsError(
            f"The URDF has a joint without a name or parent, or a circle of joints, at '"
            f"{shown(link)}' on the way to the tool; expected a tree of named joints.")
    require_names(names, 'the URDF')
    by_name = {joint.get('name', ''): joint for joint in joints}
    arm = Arm(link, tool_link, tuple(_joint(each, by_name) for each in reversed(chain)))
    if not arm.moving:
        raise BellowsError(
            f"No joint of the URDF moves tool_link '{shown(tool_link)}'; expected the link at the "
            f'tool tip. Joints carry {shown(", ".join(list(by_child)[:20]), 300)}.')
    return arm


def _robot(urdf: str) -> ElementTree.Element:
    """Return the root of a URDF; entity definitions raise, as they may expand without bound."""
    try:
        if len(urdf) > MAX_URDF_SIZE or '<!ENTITY' in urdf:
            raise ValueError('larger than 10 MB, or with entities')
        robot = ElementTree.fromstring(urdf)
        if robot.tag != 'robot':
            raise ValueError(f'it starts with <{shown(robot.tag)}>')
    except (ElementTree.ParseError, ValueError) as error:
        raise BellowsError(
            f'The URDF cannot be read: {error}. Expected XML that starts with <robot>, as xacro '
            'writes it.') from None
    return robot


def _attribute(joint: ElementTree.Element, tag: str, name: str, default: str = '') -> str:
    """Return an attribute of an element of a joint."""
    element = joint.find(tag)
    return default if element is None else element.get(name, default)


def _joint(element: ElementTree.Element, by_name: Mapping[str, ElementTree.Element]) -> Joint:
    """Return a joint of the chain, with the limits of the mimicked joint, if any."""
    name, kind = element.get('name', ''), element.get('type', '')
    if kind not in ('fixed', *TURNING, 'prismatic'):
        raise _error(name, f'is {shown(kind) or "of no kind"}',
                     'fixed, revolute, continuous or prismatic')
    drive, limits = '', element
    if element.find('mimic') is not None and kind != 'fixed':
        drive = _attribute(element, 'mimic', 'joint')
        if drive not in by_name:
            raise _error(name, f"mimics '{shown(drive)}', which is missing", 'a joint of the URDF')
        if by_name[drive].find('mimic') is not None:
            raise _error(name, f"mimics '{shown(drive)}'", 'a joint that mimics no other')
        limits = by_name[drive]

    def number(joint: ElementTree.Element, tag: str, attribute: str, default: float) -> float:
        return float(_numbers(joint, tag, attribute, str(default), 1)[0])

    axis = _numbers(element, 'axis', 'xyz', '1 0 0')
    length = float(np.linalg.norm(axis))
    if kind != 'fixed' and not length > 0.0:
        raise _error(name, 'has an axis of zero length', 'a direction')
    pose = lie.transform(lie.rpy_rotation(_numbers(element, 'origin', 'rpy', '0 0 0')),
                         _numbers(element, 'origin', 'xyz', '0 0 0'))
    lower, upper, multiplier, offset = -math.inf, math.inf, 1.0, 0.0
    if kind != 'continuous' and limits.find('limit') is not None:  # 0 by default, as in URDF
        lower, upper = (number(limits, 'limit', key, 0.0) for key in ('lower', 'upper'))
    if drive:
        multiplier = number(element, 'mimic', 'multiplier', multiplier)
        offset = number(element, 'mimic', 'offset', offset)
    velocity = number(limits, 'limit', 'velocity', math.inf)
    return Joint(name, kind, pose, axis / (length or 1.0), lower, upper, velocity, drive,
                 multiplier, offset)


def _numbers(
    joint: ElementTree.Element, tag: str, attribute: str, default: str, count: int = 3
) -> Array:
    """Return numbers of a joint; limits may be infinite."""
    text = _attribute(joint, tag, attribute, default)
    try:
        numbers = np.array(text.split(), float)
    except ValueError:
        numbers = np.array([])
    if numbers.shape != (count,) or np.isnan(numbers).any() or (
            count > 1 and not (np.abs(numbers) < MAX_NUMBER).all()):
        raise _error(joint.get('name', ''), f"has {tag} {attribute} '{shown(text, 60)}'",
                     'one number' if count == 1 else 'three numbers')
    return numbers


def _error(name: str, fact: str, expected: str) -> BellowsError:
    """Return the error for a joint that cannot be followed."""
    return BellowsError(
        f"Joint '{shown(name)}' of the URDF {fact}; expected {expected} on the way to the tool.")
