"""Static recordings: the cup's nominal length, and whether its spring holds where it hangs."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
import os
from pathlib import Path
from typing import Any

from bellows_ros import __version__
from bellows_ros.core.identification.statics.standstills import Hold, holds_of, unsettled
from bellows_ros.core.identification.statics.static import (
    check_spring,
    nominal_length,
    NominalLength,
    SpringCheck,
)
from bellows_ros.core.model import Cup, cup_of, Package, package_of
from bellows_ros.core.parameters import PACKAGE_PARAMETERS, resolve, validate
from bellows_ros.core.recording.preparation import Report
from bellows_ros.core.synthetic.settings import Settings
from bellows_ros.errors import BellowsError
from bellows_ros.files import safe_yaml
from bellows_ros.files.parameter_files import write_parameters
from bellows_ros.workflows.recordings import load, values_at_rest
from bellows_ros.workflows.result_json import recording_json
import numpy as np

Progress = Callable[[str, float], None]

LENGTHS_AGREE_WITHIN = 3e-4
"""A cup.length that differs by more than this (m) from the one found is warned about."""


@dataclass(frozen=True)
class StaticBag:
    """A recording, and what it held where that is not what the parameters say (kg, m)."""

    bag: str
    mass: float | None = None
    com: tuple[float, ...] | None = None


@dataclass(frozen=True, eq=False)
class StaticRecording:
    """One recording's standstills, those without rest of the package, and what it held."""

    bag: str
    held: Package
    holds: tuple[Hold, ...]
    unsettled: int
    report: Report


@dataclass(frozen=True, eq=False)
class AtRest:
    """
    The recordings that the parameter `static.bags` names.

    Parameters
    ----------
    recordings : tuple of StaticRecording
        In that order.
    length : NominalLength or None
        The cup's length without load, where there are masses enough.
    no_length : str
        Why there is none, or ''.

    """

    recordings: tuple[StaticRecording, ...]
    length: NominalLength | None
    no_length: str

    @property
    def holds(self) -> list[tuple[Hold, Package]]:
        """All standstills, with what was held."""
        return [(hold, r.held) for r in self.recordings for hold in r.holds]

    def warnings(self, cup_length: float) -> tuple[str, ...]:
        """Return what the user must know, with the length (m) that the cup is taken to have."""
        return tuple(_warnings(self.length, cup_length, self.recordings))

    def as_json(self) -> dict[str, Any]:
        """Return the content for a JSON file."""
        return {
            'cup_length': None if self.length is None else _length_json(self.length),
            'no_cup_length': self.no_length,
            'recordings': [_recording_json(recording) for recording in self.recordings],
        }


@dataclass(frozen=True, eq=False)
class StaticResult:
    """
    What static recordings tell.

    Parameters
    ----------
    recordings : tuple of StaticRecording
        In the order they were given.
    length : NominalLength or None
        The cup's length without load, where there are masses enough.
    no_length : str
        Why there is none, or ''.
    spring : SpringCheck or None
        The spring in every pose; None where no stiffness was given.
    cup_length : float
        The length with which the spring was checked, m.
    values : mapping
        All parameters.
    warnings : tuple of str
        What the user must know.

    """

    recordings: tuple[StaticRecording, ...]
    length: NominalLength | None
    no_length: str
    spring: SpringCheck | None
    cup_length: float
    values: Mapping[str, Any]
    warnings: tuple[str, ...]

    def as_json(self) -> dict[str, Any]:
        """Return the content of the JSON file, in SI units."""
        return {
            'cup_length': None if self.length is None else _length_json(self.length),
            'no_cup_length': self.no_length,
            'spring': None if self.spring is None else {
                'passed': self.spring.passed,
                'verdict': self.spring.sentence,
                'cup_length': self.cup_length,
                'poses': [
                    {'tilt': pose.hold.tilt, 'measured': pose.measured,
                     'predicted': pose.predicted, 'verdict': pose.verdict,
                     'sentence': pose.sentence}
                    for pose in self.spring.poses
                ],
            },
            'recordings': [_recording_json(recording) for recording in self.recordings],
            'warnings': self.warnings,
            'settings': dict(self.values),
            'version': __version__,
        }  # fmt: skip


def recorded_at_rest(values: Mapping[str, Any], tell: Progress) -> AtRest:
    """
    Return what the recordings of standstills tell that the parameter `static.bags` names.

    Parameters
    ----------
    values : mapping
        All parameters.
    tell : callable
        Called with what is being done and the part (0 to 1) that is done.

    Raises
    ------
    BellowsError
        If a recording is not usable, or static.length asks for a length that they do not tell.

    """
    recordings = []
    for bag, own in zip(values['static.bags'], values_at_rest(values), strict=True):
        tell(f'reading {bag}', 0.0)
        recordings.append(_recording(StaticBag(os.fspath(bag)), own))
    pairs = [(hold, r.held) for r in recordings for hold in r.holds]
    length, no_length = _length(pairs, values['gravity'])
    if length is None and values['static.length']:
        raise BellowsError(f'static.length is set, but: {no_length}')
    return AtRest(tuple(recordings), length, no_length)


def static_bags(values: Mapping[str, Any]) -> list[StaticBag]:
    """Return the recordings that the parameter `static.bags` names, with what hung there."""
    return [
        StaticBag(os.fspath(bag), own['package.mass'], tuple(own['package.com']))
        for bag, own in zip(values['static.bags'], values_at_rest(values), strict=True)
    ]


def static_check(
    bags: Sequence[StaticBag],
    settings: Mapping[str, object],
    progress: Progress | None = None,
) -> StaticResult:
    """
    Find the standstills of recordings, the cup's nominal length, and whether its spring holds.

    Parameters
    ----------
    bags : sequence of StaticBag
        Recordings of one cup with known masses.
    settings : mapping
        Parameters by name. The spring is checked if cup.stiffness is among them; with cup.length,
        or with the length that was found where that is not among them.
    progress : callable, optional
        Called with what is being done and the part (0 to 1) that is done.

    Raises
    ------
    BellowsError
        If a parameter or a recording is not usable, or there is neither a nominal length nor a
        spring to be had from them.

    """
    if not bags:
        raise BellowsError('No static recording is given. Name one or more rosbag2 folders.')
    values = _resolved(bags, settings)
    recordings = []
    for number, bag in enumerate(bags):
        if progress is not None:
            progress(f'reading {bag.bag}', number / len(bags))
        recordings.append(_recording(bag, values))
    pairs = [(hold, r.held) for r in recordings for hold in r.holds]
    gravity = values['gravity']
    length, no_length = _length(pairs, gravity)
    if length is None and 'cup.stiffness' not in settings:
        raise BellowsError(
            f'{no_length} To check the spring instead, give its cup.stiffness with --params.'
        )
    given = 'cup.length' in settings or length is None
    cup_length = values['cup.length'] if given or length is None else length.length
    spring = None
    if 'cup.stiffness' in settings:
        cup = cup_of(values)
        spring = check_spring(Cup(cup.stiffness, cup.damping, cup_length), pairs, gravity)
    warnings = tuple(_warnings(length, cup_length, recordings))
    return StaticResult(
        tuple(recordings), length, no_length, spring, cup_length, values, warnings
    )


def read_list(path: str | os.PathLike[str]) -> list[StaticBag]:
    """
    Read a YAML file that lists recordings with what they held.

    It holds `recordings`, a list of blocks with `bag` (relative to the file's folder), `mass` (kg)
    and, where it differs from package.com, `com` (m).

    Raises
    ------
    BellowsError
        If the file cannot be read or is not such a list.

    """
    file = Path(path)
    content = safe_yaml.load(file)
    if not isinstance(content, Mapping):
        raise BellowsError(
            f"'{file}' must hold recordings: a list of blocks with bag and mass, got "
            f'{type(content).__name__}.'
        )
    settings = Settings(content)
    bags = [_listed(block, file.parent) for block in settings.blocks('recordings')]
    settings.done()
    return bags


def save_length(
    result: StaticResult, path: str | os.PathLike[str], given: Mapping[str, object]
) -> None:
    """
    Write the given parameters with the nominal length that was found.

    Raises
    ------
    BellowsError
        If none was found, or the file cannot be written.

    """
    if result.length is None:
        raise BellowsError(result.no_length)
    bags = ', '.join(recording.bag for recording in result.recordings)
    header = [
        f'Nominal length found by bellows_ros {__version__} from {bags}:',
        f'{result.length.length * 1e3:.3f} mm, standard error '
        f'{result.length.length_std * 1e3:.3f} mm.',
    ]
    write_parameters(path, {**given, 'cup.length': result.length.length}, header)


def _listed(block: Settings, folder: Path) -> StaticBag:
    """Return one entry of a list."""
    bag = str(folder / block.text('bag'))
    mass = block.number('mass', unit='kg', above=0.0)
    com = tuple(block.vector('com', 3, unit='m').tolist()) if 'com' in block else None
    block.done()
    return StaticBag(bag, mass, com)


def _resolved(bags: Sequence[StaticBag], settings: Mapping[str, object]) -> dict[str, Any]:
    """
    Return all parameters; mass and centre need not be among them if every recording has its own.

    Nor the inertia, which plays no part at rest: any that a body can have will do.
    """
    filled = {'package.inertia': (1e-3, 1e-3, 1e-3, 0.0, 0.0, 0.0), **settings}
    if all(bag.mass is not None for bag in bags) and 'package.mass' not in filled:
        filled['package.mass'] = bags[0].mass
    if all(bag.com is not None for bag in bags) and 'package.com' not in filled:
        filled['package.com'] = bags[0].com
    return dict(resolve(filled, PACKAGE_PARAMETERS))


def _recording(bag: StaticBag, values: Mapping[str, Any]) -> StaticRecording:
    """Return a recording's standstills; twist and time offset, unseen at rest, are left out."""
    own = {**values, 'topics.tool_twist': '', 'fit.time_offset': False}
    for name, value in (('package.mass', bag.mass), ('package.com', bag.com)):
        if value is not None:
            own[name] = validate(name, value)
    recording = load(bag.bag, own).recording
    try:
        holds = holds_of(recording)
    except BellowsError as error:
        raise BellowsError(f'{bag.bag}: {error}') from None
    return StaticRecording(
        bag.bag, package_of(own), tuple(holds), unsettled(recording), recording.report
    )


def _length(
    pairs: Sequence[tuple[Hold, Package]], gravity: float
) -> tuple[NominalLength | None, str]:
    """Return the nominal length, or why there is none."""
    try:
        return nominal_length(pairs, gravity), ''
    except BellowsError as error:
        return None, str(error)


def _warnings(
    length: NominalLength | None, cup_length: float, recordings: Sequence[StaticRecording]
) -> list[str]:
    """Return what the user must know."""
    found = list(length.warnings) if length is not None else []
    if length is not None and abs(length.length - cup_length) > LENGTHS_AGREE_WITHIN:
        found.append(
            f'cup.length is {cup_length * 1e3:.2f} mm, but these recordings say '
            f'{length.length * 1e3:.2f} mm. Write the latter to a parameter file with --out.'
        )
    found += [
        f'{r.bag}: in {r.unsettled} of {r.unsettled + len(r.holds)} standstills of the tool the '
        'package had not stopped swinging; they are left out. Hold each pose for longer.'
        for r in recordings if r.unsettled
    ]
    return found + [f'{r.bag}: {text}' for r in recordings for text in r.report.warnings]


def _length_json(length: NominalLength) -> dict[str, Any]:
    """Return a nominal length for the JSON file."""
    return {
        'length': length.length,
        'length_std': length.length_std,
        'linear_length': length.linear_length,
        'linear_length_std': length.linear_length_std,
        'stiffness': length.stiffness,
        'linear_load': length.linear_load,
        'loads': length.loads,
        'lengths': length.lengths,
        'coefficients': length.coefficients,
    }


def _recording_json(recording: StaticRecording) -> dict[str, Any]:
    """Return a recording with its standstills for the JSON file."""
    return {
        **recording_json(recording.bag, recording.report),
        'mass': recording.held.mass,
        'unsettled': recording.unsettled,
        'standstills': [
            {'start_ns': hold.start_ns, 'duration': hold.duration, 'tilt': hold.tilt,
             'samples': hold.samples, 'lip': hold.lip(np.asarray(recording.held.com))}
            for hold in recording.holds
        ],
    }  # fmt: skip
