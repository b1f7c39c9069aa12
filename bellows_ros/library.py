"""
The public API, `import bellows_ros`: arrays and paths in, arrays and frozen data out.

Most of it stands in other rooms; the functions here only spare a user the way there.
"""

from collections.abc import Mapping, Sequence
import os
from typing import TYPE_CHECKING

from bellows_ros.core.geometry.arrays import Array
from bellows_ros.core.geometry.lie import quaternion_to_rotation, rotation_to_quaternion
from bellows_ros.core.live import LivePredictor, Prediction
from bellows_ros.core.model import equilibrium
from bellows_ros.core.model.cup_package import (
    Cup,
    cup_of,
    model_tuple,
    Package,
    package_of,
    STANDARD_GRAVITY,
)
from bellows_ros.core.model.simulation import simulate, state_row
from bellows_ros.core.parameters.checks import PACKAGE_PARAMETERS, resolve
from bellows_ros.core.signals.savgol import savgol
from bellows_ros.core.signals.trajectory import PoseStream, Trajectory
from bellows_ros.errors import BellowsError
from bellows_ros.files.parameter_files import read_parameters, write_parameters
import numpy as np
from numpy.typing import ArrayLike

if TYPE_CHECKING:  # loads much that the others do without
    from bellows_ros.core.identification.result import Fit

__all__ = [
    'BellowsError', 'Cup', 'LivePredictor', 'Package', 'Prediction', 'Trajectory', 'identify',
    'read_cup', 'read_package', 'read_parameters', 'savgol', 'simulate', 'static_equilibrium',
    'write_cup', 'write_parameters',
]


def read_cup(path: str | os.PathLike[str]) -> Cup:
    """
    Read a cup from a parameter file, such as `bellows identify` writes.

    Parameters
    ----------
    path : path
        YAML file with cup.stiffness, cup.damping, cup.length and, if it relaxes, cup.relaxation.

    Raises
    ------
    BellowsError
        If the file cannot be read, or one of the three is missing or not allowed.

    Examples
    --------
    >>> cup = bellows_ros.read_cup('bags/cup.yaml')
    >>> cup.length
    0.046
    >>> float(cup.stiffness[2, 2])
    9200.0

    """
    return cup_of(_read(path, ('cup.stiffness', 'cup.damping', 'cup.length')))


def read_package(path: str | os.PathLike[str]) -> Package:
    """
    Read a package from a parameter file.

    Parameters
    ----------
    path : path
        YAML file with package.mass, package.inertia and package.com.

    Raises
    ------
    BellowsError
        If the file cannot be read, or one of the three is missing or not allowed.

    Examples
    --------
    >>> bellows_ros.read_package('bags/package.yaml').mass
    1.8

    """
    return package_of(_read(path, PACKAGE_PARAMETERS))


def write_cup(path: str | os.PathLike[str], cup: Cup, package: Package | None = None) -> None:
    """
    Write a cup, and a package if one is given, for both nodes and all commands.

    Parameters
    ----------
    path : path
        YAML file, written whole or not at all.
    cup : Cup
        K, P and length.
    package : Package, optional
        What hangs on it.

    Raises
    ------
    BellowsError
        If K is not positive definite, or the file cannot be written.

    Examples
    --------
    >>> bellows_ros.write_cup(folder / 'cup.yaml', bellows_ros.Cup.thesis())
    >>> bellows_ros.read_cup(folder / 'cup.yaml').length
    0.0481

    """
    values: dict[str, object] = {
        'cup.stiffness': cup.stiffness.ravel().tolist(),
        'cup.damping': cup.damping.ravel().tolist(),
        'cup.length': cup.length,
        'cup.relaxation': cup.relaxation,
        'cup.relaxation_times': cup.relaxation_times,
    }
    if package is not None:
        values.update(_package_values(package))
    write_parameters(path, values)


def identify(
    recordings: Sequence[str | os.PathLike[str] | tuple[Trajectory, Trajectory]],
    package: Package,
    cup_length: float,
    settings: Mapping[str, object] | None = None,
) -> 'Fit':
    """
    Identify a cup's K and P from recordings, or from poses in arrays.

    Parameters
    ----------
    recordings : sequence of path or of (Trajectory, Trajectory)
        Each a rosbag2 recording, or the measured poses of the tool tip E and of the package's
        centre of mass B in a world whose z is up. Samples that are not valid are left out; twists
        are not needed.
    package : Package
        What the cup held.
    cup_length : float
        Nominal length l0, m.
    settings : mapping, optional
        Further parameters by name, such as fit.structure or topics.tool_pose.

    Returns
    -------
    Fit
        stiffness and damping (6, 6), stiffness_std and damping_std (6, 6), covariance of the
        parameters that `labels` names, and warnings, in sentences.

    Raises
    ------
    BellowsError
        If a recording is not usable, or they do not determine the cup.

    Examples
    --------
    >>> package = bellows_ros.read_package('bags/package.yaml')
    >>> fit = bellows_ros.identify(
    ...     ['bags/identification'], package, 0.046,
    ...     {'fit.method': 'least_squares', 'recording.package_frame': 'com'})
    >>> bool(abs(fit.stiffness[2, 2] - 9200.0) < 50.0)
    True
    >>> cup = bellows_ros.Cup(fit.stiffness, fit.damping, 0.046)

    """
    from bellows_ros.core.identification.methods import fit
    from bellows_ros.core.recording.preparation import prepare
    from bellows_ros.workflows.recordings import load, prepare_settings

    values = resolve({**(settings or {}), **_package_values(package), 'cup.length': cup_length})
    parts = [
        load(own, values) if isinstance(own, str | os.PathLike) else
        prepare(_stream(own[0], 'tool'), _stream(own[1], 'package'), prepare_settings(values))
        for own in recordings]
    return fit(parts, values).fit


def static_equilibrium(
    cup: Cup,
    package: Package,
    T_world_tool: ArrayLike | None = None,
    gravity: float | ArrayLike = STANDARD_GRAVITY,
) -> Array:
    """
    Return where a package hangs from a tool at rest (3.9).

    Parameters
    ----------
    cup : Cup
        What connects tool and package.
    package : Package
        What hangs on it.
    T_world_tool : array_like (4, 4), optional
        Pose of the tool tip E in the world, m; upright at the origin when left out.
    gravity : float or array_like (3,)
        Along -z of the world, or as a vector there, m/s^2.

    Returns
    -------
    ndarray (4, 4)
        T_world_package, the pose of the centre of mass B.

    Raises
    ------
    BellowsError
        If T_world_tool is no pose, or the cup cannot carry the package in it.

    Examples
    --------
    The weight stretches the cup by m g / K_z:

    >>> cup = bellows_ros.read_cup('bags/cup.yaml')
    >>> package = bellows_ros.read_package('bags/package.yaml')
    >>> T_world_package = bellows_ros.static_equilibrium(cup, package)
    >>> T_world_package[:3, 3].round(5).tolist()
    [0.0, 0.0, -0.07792]

    """
    T = np.eye(4) if T_world_tool is None else np.asarray(T_world_tool, dtype=np.float64)
    R = T[:3, :3] if T.shape == (4, 4) else np.full((3, 3), np.nan)
    if not np.allclose(R @ R.T, np.eye(3), atol=1e-6) or not np.all(np.isfinite(T)):
        raise BellowsError(
            f'T_world_tool must be a homogeneous matrix (4, 4) with a rotation in it, got shape '
            f'{T.shape}.')
    tool = state_row(T[:3, 3], rotation_to_quaternion(R))
    body = equilibrium.static_equilibrium(model_tuple(cup, package, gravity), tool)
    T_world_package = np.eye(4)
    T_world_package[:3, :3] = quaternion_to_rotation(np.array(body[1]))
    T_world_package[:3, 3] = body[0]
    return T_world_package


def _package_values(package: Package) -> dict[str, object]:
    """Return the parameters of a package."""
    inertia = package.inertia[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]
    return {
        'package.mass': package.mass,
        'package.inertia': inertia.tolist(),
        'package.com': package.com.tolist(),
    }


def _stream(poses: Trajectory, name: str) -> PoseStream:
    """Return the valid poses of a trajectory as if they had been recorded."""
    good = poses.select(poses.valid)
    return PoseStream(name, 'world', good.stamps_ns, good.position, good.rotation)


def _read(path: str | os.PathLike[str], names: tuple[str, ...]) -> Mapping[str, object]:
    """Return parameters of a file, which must all be there."""
    values = read_parameters(path)
    missing = [name for name in names if name not in values]
    if missing:
        raise BellowsError(f"Parameter file '{path}' lacks {', '.join(missing)}.")
    return values
