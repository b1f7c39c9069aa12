"""
A tracked body, measured by its pose.

The residual of a view is the difference of the measured and the simulated pose of B: shift and
rotation in body axes, as of `pose_error`, or of a measured point, in the axes of its noise.
Nuisances of the sensor are frames (com, world, marker), scale, clocks and exposure.
"""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any, NamedTuple

from bellows_ros.core.geometry import lie
from bellows_ros.core.geometry import tuples as t3
from bellows_ros.core.geometry.arrays import Array, Places
from bellows_ros.core.geometry.jit import kernel
from bellows_ros.core.model import kernels
from bellows_ros.core.model.equilibrium import pose_error
from bellows_ros.core.model.kernels import ModelTuple, State
from bellows_ros.core.signals.trajectory import at_tip, NS_PER_S, Trajectory
import numpy as np

Values = Mapping[str, Array]
"""Values of nuisances by name, SI units."""


class Views(NamedTuple):
    """
    Measured poses of B.

    The poses (N, 9) with their small delay (s) after a node, and the factor (s^2) of the
    acceleration in a mean over the exposure; minus their derivatives (N, 6, p) in body axes by the
    unknowns, for delay and exposure per unit of the simulated twist and acceleration; the axes (N,
    3, 3) of the noise in the world, empty for body axes, and the measured point (3,), m, in body
    axes; the unknowns of the clocks, and the unknown of the exposure, -1 for none.
    """

    rows: Array
    columns: Array
    axes: Array
    point: Array
    clocks: Places
    exposure: int


@kernel
def observe(
    model: ModelTuple, tool: State, body: State, views: Views, i: int, M: Any, out: Any
) -> None:
    """
    Write the residual (6,) of view i, and its derivative (6, 6) by the package's error.

    The mean pose over an exposure T differs from the pose at its middle by T^2/24 times the
    acceleration. Columns of clocks are multiplied by the twist, the column of the exposure by the
    acceleration, and all columns are mapped.
    """
    pose, columns, point = views.rows[i], views.columns[i], views.point
    _write_map(body, views, i, M)
    acceleration = (t3.ZERO, t3.ZERO)
    if views.exposure >= 0:
        acceleration = kernels.body_acceleration(model, tool, body)
    shift, rotation = pose_error(
        body, (pose[0], pose[1], pose[2]), (pose[3], pose[4], pose[5], pose[6]))
    linear, angular = body[2], body[3]
    bend = t3.add(acceleration[0], t3.cross(angular, linear)), acceleration[1]
    lever = (point[0], point[1], point[2])
    # The map is linear in the rotation, but blurred tags need the second order.
    second = t3.scale(0.5, t3.cross(rotation, t3.cross(rotation, lever)))
    difference = np.empty((6, 1))
    for j in range(3):
        difference[j, 0] = shift[j] + second[j] - pose[7] * linear[j] - pose[8] * bend[0][j]
        difference[3 + j, 0] = rotation[j] - pose[7] * angular[j] - pose[8] * bend[1][j]
        if views.exposure >= 0:
            columns[j, views.exposure] *= bend[0][j]
            columns[3 + j, views.exposure] *= bend[1][j]
    for column in views.clocks:
        for j in range(3):
            columns[j, column] *= linear[j]
            columns[3 + j, column] *= angular[j]
    mapped = t3.product(M, difference, np.empty((6, 1)))
    for j in range(6):
        out[j] = mapped[j, 0]
    if len(views.axes) > 0:
        turned = t3.product(M, columns, np.empty(columns.shape))
        for j in range(6):
            for k in range(turned.shape[1]):
                columns[j, k] = turned[j, k]


@kernel
def _write_map(body: State, views: Views, i: int, M: Any) -> None:
    """Write the derivative (6, 6) of view i by the package's error."""
    R, lever = t3.rotation_matrix(body[1]), (views.point[0], views.point[1], views.point[2])
    for j in range(3):
        if len(views.axes) == 0:
            M[j, j] = M[3 + j, 3 + j] = 1.0
        else:
            axis = views.axes[i]
            c = t3.apply_transposed(R, (axis[0, j], axis[1, j], axis[2, j]))
            of_rotation = t3.cross(lever, c)
            for k in range(3):
                M[j, k] = M[3 + j, 3 + k] = c[k]
                M[j, 3 + k] = of_rotation[k]


def views(
    poses: Trajectory, values: Values, places: Mapping[str, Places], units: Array,
    context: tuple[Array, Array], path: Trajectory, period: float, delays: Array,
    axes: Array, point: Array,
) -> Views:
    """
    Return the views of measured poses of B, corrected by the values of the nuisances.

    Parameters
    ----------
    poses : Trajectory
        N measured poses.
    values, places : mapping
        Nuisances by name: values, SI units, and their places among the p unknowns.
    units : ndarray (p,)
        Units of the unknowns.
    context : (ndarray (3,), ndarray (4,))
        Components of the com that shift B, and middle: see `poses_of`.
    path : Trajectory
        Smooth path of the tool.
    period, delays, axes, point
        Time (s) between poses, and fields of `Views`.

    """
    body = poses_of(poses, values, *context)
    columns, mean = np.zeros((len(poses), 6, len(units))), period**2 / 24.0
    for name, place in places.items():
        known = carried(poses, path) if name == 'scale' else poses
        columns[:, :, place] = -pose_changes(name, len(place), known, *context)
    columns[:, :, places.get('exposure', [])] = mean  # for an exposure as long as the period
    exposure = mean * float(values.get('exposure', (0.0,))[0])
    return Views(
        np.column_stack([body.position, lie.rotation_to_quaternion(body.rotation), delays,
                         np.full(len(poses), exposure)]), columns * units, axes, point,
        np.array([int(place) for name in ('time_offset', 'clock_rate')
                  for place in places.get(name, ())], dtype=np.int64),
        int(places.get('exposure', (-1,))[0]))


def poses_of(
    package: Trajectory, values: Values, moves: Array, middle: Array | None = None
) -> Trajectory:
    """
    Return the poses of B, and twists if any, for given free quantities.

    Moves (3,) is 1 for the components of the com that shift B, else 0. The world rotates about a
    middle, see `middle_of`; by default of the poses.
    """
    if 'com' in values:
        package = of_fixed_frame(package, np.zeros(3), moves * values['com'])
    if 'scale' in values:
        package = replace(package, position=(1.0 + values['scale']) * package.position)
    if 'package_world' in values:
        middle = middle_of(package) if middle is None else middle
        R = lie.exp_so3(values['package_world'][3:])
        package = replace(
            package, position=middle[:3] + values['package_world'][:3] + lie.apply(
                R, package.position - middle[:3]), rotation=R @ package.rotation)
    if 'package_marker' in values:
        shift, rotation = np.split(values['package_marker'], 2)
        package = of_fixed_frame(package, rotation, shift)
    return package


def of_fixed_frame(motion: Trajectory, rotation: Array, shift: Array) -> Trajectory:
    """Return the motion of a frame fixed in a body, rotated (rad) and shifted (m) there."""
    return at_tip(motion, lie.transform(lie.exp_so3(rotation), shift))


def middle_of(package: Trajectory) -> Array:
    """Return the mean (3,) of the valid positions (m), and their first stamp (s)."""
    used = package.select(package.valid)
    return np.append(used.position.mean(axis=0), used.stamps_ns[0] / NS_PER_S)


def carried(package: Trajectory, tool: Trajectory) -> Trajectory:
    """
    Return the package as if fixed to the tool's smooth path.

    Noisy positions in the derivative by their scale would bias the scale towards zero.
    """
    nearest = np.minimum(np.searchsorted(tool.stamps_ns, package.stamps_ns), len(tool) - 1)
    position, R = tool.position[nearest], tool.rotation[nearest]
    offset = lie.apply(np.swapaxes(R, 1, 2), package.position - position).mean(axis=0)
    return replace(package, position=position + R @ offset, rotation=R)


def pose_changes(
    name: str, size: int, package: Trajectory, moves: Array, middle: Array
) -> Array:
    """
    Return the derivatives of poses (M, 6, size) by a nuisance, in body axes.

    Derivatives by offset and rate of the clocks are in units of the twist.
    """
    change = np.zeros((len(package), 6, size))
    if name == 'com':
        change[:, :3] = np.diag(moves)
    elif name == 'time_offset':
        change -= 1.0
    elif name == 'clock_rate':
        change -= (package.stamps_ns / NS_PER_S - middle[3])[:, None, None]
    elif name == 'scale':  # of smooth poses, see `carried`
        change[:, :3, 0] = lie.apply(np.swapaxes(package.rotation, 1, 2), package.position)
    elif name == 'package_marker':
        change += np.eye(6)
    elif name == 'package_world':
        inverse = np.swapaxes(package.rotation, 1, 2)
        change[:, :3, :3] = change[:, 3:, 3:] = inverse
        change[:, :3, 3:] = -inverse @ lie.hat(package.position - middle[:3])
    return change
