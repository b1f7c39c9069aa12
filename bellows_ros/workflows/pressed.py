"""K of a cup on a fixed plate, from recordings of the tool and of a force-torque sensor."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from bellows_ros.core.geometry.arrays import Array
from bellows_ros.core.identification.pressed import pressed_cup, PressedCup
from bellows_ros.core.parameters import checks, conversion
from bellows_ros.core.parameters.values import Values
from bellows_ros.core.recording.standstills import rests_of
from bellows_ros.core.sensors.wrench import WrenchSensor
from bellows_ros.core.signals.trajectory import Trajectory
from bellows_ros.errors import BellowsError
from bellows_ros.files import File, parameter_files
from bellows_ros.version import __version__
from bellows_ros.workflows.gripper import tool_and_readings, with_gripper
from bellows_ros.workflows.recordings import no_progress, Progress
import numpy as np


class PressedResult(NamedTuple):
    """K of a cup from standstills of a tool, and the recordings."""

    cup: PressedCup
    length: float
    bags: tuple[str, ...]
    passed: bool = True

    def as_json(self) -> dict[str, Any]:
        """Return the content of a JSON file, in SI units."""
        return {**self.cup._asdict(), 'cup_length': self.length, 'bags': self.bags}


def pressed_check(
    bags: Sequence[str], settings: Mapping[str, Any], progress: Progress = no_progress
) -> PressedResult:
    """
    Return K from recordings of standstills with wrenches, of one cup on a fixed plate.

    Raises
    ------
    BellowsError
        If a parameter or a recording is unusable, or they do not determine K.

    """
    if 'cup.length' not in settings:
        raise BellowsError(
            'cup.length is not set, on which K depends. Measure the length from the tool tip to '
            'the lip, under vacuum and without load.')
    values = with_gripper(checks.resolve(settings), progress)
    if not bags:
        raise BellowsError('No recording is given. Name one or more rosbag2 folders.')
    tools, wrenches = list[Trajectory](), list[Array]()
    for number, bag in enumerate(bags):
        progress(f'reading {bag}', number / len(bags))
        tool, shown = _at_rest(bag, values)
        tools.append(tool)
        wrenches.append(shown)
    tool = Trajectory(np.arange(sum(map(len, tools))), *(
        np.concatenate([getattr(each, name) for each in tools])
        for name in ('position', 'rotation')))
    return PressedResult(pressed_cup(
        tool, np.concatenate(wrenches), WrenchSensor.of(values),
        conversion.given_structure(values), np.reshape(values.cup.stiffness, (6, 6)),
        values.cup.length, values.gravity.magnitude), values.cup.length, tuple(bags))


def _at_rest(bag: File, values: Values) -> tuple[Trajectory, Array]:
    """Return poses of the tool at rest (N), and mean wrenches (N, 6) in axes of the sensor."""
    tool, felt = tool_and_readings(bag, values)
    spans, rests = rests_of(tool)
    stamps = felt.stamps_ns - felt.sensor.delay_ns
    ends = np.searchsorted(stamps, [tool.stamps_ns[span[[0, -1]]] for span in spans])
    full = ends[:, 1] > ends[:, 0]
    return rests.select(full), np.array([
        felt.values[first:last].mean(axis=0) for first, last in ends[full]])


def save_stiffness(result: PressedResult, path: File) -> None:
    """Write K, with its standard errors and the length it holds for, as a parameter file."""
    cup = result.cup
    parameter_files.write_parameters(path, {
        'cup.stiffness': tuple(cup.stiffness.ravel().tolist()),
        'cup.stiffness_std': tuple(cup.stiffness_std.ravel().tolist()),
        'cup.length': result.length}, [
        f'K from {cup.standstills} standstills with wrenches by bellows_ros {__version__}, '
        f'from {", ".join(result.bags)}.'])
