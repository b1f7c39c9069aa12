"""
Filtering of the package's motion relative to the tool (appendix J).

The Savitzky-Golay filter takes the tool in the world, A_H_E, and the lip in the tool, E_H_S; the
package's motion in the world follows from both. Which of the two ways is better was measured, see
`benchmarks/relative.py`.
"""

from bellows_ros.core.lie import adjoint, apply, inverse_transform, transform, twist_cross
from bellows_ros.core.recording.recording import Recording
from bellows_ros.core.resampling import savgol
from bellows_ros.core.trajectory import Trajectory, uniform_rate_hz
import numpy as np
from numpy.typing import ArrayLike


def relatively_filtered(recording: Recording) -> tuple[Trajectory, Trajectory]:
    """Return tool and package filtered in windows as long as the recording's own."""
    rate_hz = uniform_rate_hz(recording.package.stamps_ns)
    of_tool, of_package = (
        weights.shape[1] // 2 for weights in (recording.tool_weights, recording.package_weights))
    same_time = max(round(of_tool * rate_hz / recording.report.tool.timing.rate_hz), 1)
    return filtered_with_lip(
        recording.measured_tool, recording.measured_package, recording.payload.com,
        (same_time, recording.settings.tool_order),
        (of_package, recording.settings.package_order))


def filtered_with_lip(
    tool: Trajectory,
    package: Trajectory,
    com: ArrayLike,
    tool_filter: tuple[int, int],
    package_filter: tuple[int, int],
) -> tuple[Trajectory, Trajectory]:
    """
    Filter the tool in the world and the lip in the tool, and return tool and package.

    Parameters
    ----------
    tool, package : Trajectory
        N measured poses of E and B in the world at common stamps of a uniform rate, not filtered
        (`Recording.measured_tool` and `measured_package`).
    com : array_like (3,)
        Centre of mass B in the lip frame S, m.
    tool_filter, package_filter : (int, int)
        Half window (samples) and order for the tool, and for the lip in the tool.

    Returns
    -------
    tool, package : Trajectory
        E and B in the world with body twists and their derivatives, as `Samples` takes them, at
        the stamps at which both filters have full windows.

    Raises
    ------
    BellowsError
        If the stamps are not uniform, or the poses are fewer than a window.

    """
    R_tool_world = np.swapaxes(tool.rotation, -1, -2)
    origin = package.position - apply(package.rotation, np.asarray(com, dtype=float))
    lip = Trajectory(
        tool.stamps_ns, apply(R_tool_world, origin - tool.position),
        R_tool_world @ package.rotation, valid=tool.valid & package.valid)  # S in E
    filtered_tool, filtered_lip = savgol(tool, *tool_filter), savgol(lip, *package_filter)
    cut = max(tool_filter[0], package_filter[0])
    inner_tool, inner_lip = (
        filtered.select(slice(cut - n, len(filtered) - (cut - n)))
        for filtered, n in ((filtered_tool, tool_filter[0]), (filtered_lip, package_filter[0]))
    )
    return inner_tool, composed(inner_tool, inner_lip, com)


def composed(tool: Trajectory, lip: Trajectory, com: ArrayLike) -> Trajectory:
    """
    Return the package's motion in the world from the tool's there and the lip's in the tool.

    With B_v_EB = X(B_H_S) S_v_ES (J.85) and the same for its derivative (J.86), S_H_B being
    constant: B_v_AB = X(B_H_E) E_v_AE + B_v_EB (J.87), and its derivative is X(B_H_E) E_dv_AE +
    B_dv_EB - ad(B_v_EB) B_v_AB (J.88).

    Parameters
    ----------
    tool : Trajectory
        N poses of E in the world with body twists and their derivatives.
    lip : Trajectory
        N poses of S in E with body twists and their derivatives, at the same stamps.
    com : array_like (3,)
        Centre of mass B in S, m.

    """
    (tool_twist, tool_rate), (lip_twist, lip_rate) = (
        (np.asarray(motion.twist), np.asarray(motion.acceleration)) for motion in (tool, lip))
    T_lip_com = transform(np.eye(3), np.asarray(com, dtype=float))
    T_tool_com = transform(lip.rotation, lip.position) @ T_lip_com
    T_world_com = transform(tool.rotation, tool.position) @ T_tool_com
    X_com_tool = adjoint(inverse_transform(T_tool_com))
    X_com_lip = adjoint(inverse_transform(T_lip_com))
    relative = apply(X_com_lip, lip_twist)
    twist = apply(X_com_tool, tool_twist) + relative
    acceleration = (
        apply(X_com_tool, tool_rate)
        + apply(X_com_lip, lip_rate)
        - apply(twist_cross(relative), twist)
    )
    return Trajectory(
        tool.stamps_ns,
        T_world_com[:, :3, 3],
        T_world_com[:, :3, :3],
        twist,
        acceleration,
        tool.valid & lip.valid,
    )
