"""
The one table of all parameters: of both nodes, the parameter files and the command line.

A 6x6 matrix is 36 numbers, row-major; an inertia is [ixx, iyy, izz, ixy, ixz, iyz]; units are SI.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
import re
from types import MappingProxyType
from typing import Literal

from bellows_ros.core.nearest_name import hint
from bellows_ros.errors import BellowsError

Kind = Literal['bool', 'integer', 'double', 'string', 'double_array', 'string_array']
Value = bool | int | float | str | tuple[float, ...] | tuple[str, ...]

# Diagonals of (4.78), N/m and N m/rad, and (4.79), N s/m and N m s/rad; l0 of chapter 3, m.
THESIS_STIFFNESS = (6417.0, 6417.0, 1.153e4, 3.868, 3.868, 1.123)
THESIS_DAMPING = (66.06, 66.06, 22.35, 0.05458, 0.05458, 0.09736)
THESIS_LENGTH = 0.0481


@dataclass(frozen=True)
class Parameter:
    """
    One parameter: what it means, what it may be, and who reads it.

    Parameters
    ----------
    name : str
        Dotted name.
    kind : str
        bool, integer, double, string, double_array or string_array, as in ROS.
    default : value or None
        None where no default is honest: whoever needs the parameter must be given it.
    unit : str
        SI unit, '' where there is none.
    description : str
        One sentence.
    used_by : tuple of str
        'identifier', 'predictor'.
    minimum, maximum : float, optional
        Allowed range of the number, or of each number of an array; both ends are allowed.
    above : float, optional
        The number must be larger than this.
    choices : tuple of str
        The allowed strings, when not empty.
    length : int, optional
        How many numbers an array has.
    required_text : bool
        True where the empty string is refused.
    read_only : bool
        True where a running node cannot change it.
    example : str
        What to write for a parameter without a default.

    """

    name: str
    kind: Kind
    default: Value | None
    unit: str
    description: str
    used_by: tuple[str, ...]
    minimum: float | None = None
    maximum: float | None = None
    above: float | None = None
    choices: tuple[str, ...] = ()
    length: int | None = None
    required_text: bool = False
    read_only: bool = False
    example: str = ''

    @property
    def constraint(self) -> str:
        """What the value must be, in words: its kind, count, range, choices and unit."""
        unit = f' ({self.unit})' if self.unit else ''
        if self.choices:
            return 'one of ' + ', '.join(self.choices)
        return _KIND_WORDS[self.kind].format(count=self.length) + self._range() + unit

    def _range(self) -> str:
        """Return the range in words, with a leading blank, or nothing."""
        low = [f'above {self.above:g}'] if self.above is not None else []
        low += [f'at least {self.minimum:g}'] if self.minimum is not None else []
        high = [f'at most {self.maximum:g}'] if self.maximum is not None else []
        text = ' and '.join(low + high)
        each = ' each' if self.kind == 'double_array' else ''
        return f',{each} {text}' if text else ''


_KIND_WORDS: Mapping[Kind, str] = MappingProxyType(
    {
        'bool': 'true or false',
        'integer': 'a whole number',
        'double': 'a number',
        'string': 'a text',
        'double_array': 'a list of {count} numbers',
        'string_array': 'a list of texts',
    }
)


def _diagonal(values: tuple[float, ...]) -> tuple[float, ...]:
    """Return a diagonal matrix as a row-major tuple."""
    size = range(len(values))
    return tuple(values[i] if i == j else 0.0 for i in size for j in size)


_BOTH = ('identifier', 'predictor')
_IDENTIFIER = ('identifier',)
_PREDICTOR = ('predictor',)

_TABLE = (
    Parameter(
        'bags', 'string_array', (), '',
        'Recordings to identify from: rosbag2 folders, or single .mcap or .db3 files.',
        _IDENTIFIER,
    ),
    Parameter(
        'topics.tool_pose', 'string', 'tool_arm/pose', '',
        'Topic with the pose of the tool tip E in the world.',
        _IDENTIFIER, required_text=True,
    ),
    Parameter(
        'topics.tool_twist', 'string', '', '',
        "Topic with the tool tip's twist; '' for none: it is then estimated from the poses.",
        _IDENTIFIER,
    ),
    Parameter(
        'topics.package_pose', 'string', 'package/pose', '',
        'Topic with the pose of the package in the world.',
        _IDENTIFIER, required_text=True,
    ),
    Parameter(
        'recording.world', 'string', 'z_up', '',
        'World frame of the recording: z up, or y up as Motive records it, equation (4.1).',
        _IDENTIFIER, choices=('z_up', 'motive_y_up'),
    ),
    Parameter(
        'recording.package_frame', 'string', 'com', '',
        "Frame the package poses are of: its centre of mass B, or the cup's lip S.",
        _IDENTIFIER, choices=('com', 'lip'),
    ),
    Parameter(
        'recording.align_at_rest', 'bool', False, '',
        'Whether turned marker frames and a lateral pick-up offset are removed by means of the '
        'standstill at the beginning, equations (4.2)-(4.13).',
        _IDENTIFIER,
    ),
    Parameter(
        'recording.rest_duration', 'double', 1.0, 's',
        'How long the recording stands still at its beginning; used with recording.align_at_rest.',
        _IDENTIFIER, above=0.0, maximum=600.0,
    ),
    Parameter(
        'package.mass', 'double', None, 'kg',
        'Mass of the held package.',
        _BOTH, above=0.0, maximum=1e4, example='2.17',
    ),
    Parameter(
        'package.inertia', 'double_array', None, 'kg m^2',
        'Inertia of the package at B, in axes of B: ixx, iyy, izz, ixy, ixz, iyz.',
        _BOTH, minimum=-1e6, maximum=1e6, length=6,
        example='[0.0087, 0.0087, 0.0173, 0.0, 0.0, 0.0]',
    ),
    Parameter(
        'package.com', 'double_array', None, 'm',
        "Centre of mass B in the frame S of the cup's lip; below the lip z is negative.",
        _BOTH, minimum=-10.0, maximum=10.0, length=3, example='[0.0, 0.0, -0.03]',
    ),
    Parameter(
        'package.attached', 'bool', True, '',
        'Whether the cup holds the package when the node becomes active; a vacuum signal decides '
        'instead where there is one.',
        _PREDICTOR, read_only=True,
    ),
    Parameter(
        'package.files', 'string_array', (), '',
        'Parameter files with package.*, one for each of the recordings, where these held '
        'different packages; none where they held the same.',
        _IDENTIFIER,
    ),
    Parameter(
        'static.bags', 'string_array', (), '',
        'Recordings of standstills of the same cup, whose balance counts in the fit beside the '
        'motion of the recordings in bags.',
        _IDENTIFIER,
    ),
    Parameter(
        'static.files', 'string_array', (), '',
        'Parameter files with package.mass, and package.com where it differs, one for each of '
        'static.bags; none where these held what package.* says.',
        _IDENTIFIER,
    ),
    Parameter(
        'static.length', 'bool', False, '',
        'Whether cup.length is found from static.bags, which must then hold two or more masses '
        'with the tool upright, section 4.2.',
        _IDENTIFIER,
    ),
    Parameter(
        'cup.length', 'double', THESIS_LENGTH, 'm',
        'Length l0 of the cup from E to S under vacuum and without load.',
        _BOTH, above=0.0, maximum=1.0,
    ),
    Parameter(
        'cup.stiffness', 'double_array', _diagonal(THESIS_STIFFNESS), 'N/m, N, N m/rad',
        'Stiffness K of the cup, 6x6 row-major, linear first; symmetric positive definite.',
        _BOTH, minimum=-1e9, maximum=1e9, length=36,
    ),
    Parameter(
        'cup.damping', 'double_array', _diagonal(THESIS_DAMPING), 'N s/m, N s, N m s/rad',
        'Damping P of the cup, 6x6 row-major, linear first; symmetric positive semidefinite.',
        _BOTH, minimum=-1e9, maximum=1e9, length=36,
    ),
    Parameter(
        'cup.name', 'string', '', '',
        "Which of the cups in cups.NAME.* is mounted; '' for the one in cup.*.",
        _PREDICTOR,
    ),
    Parameter(
        'cup.stiffness_std', 'double_array', (0.0,) * 36, 'N/m, N, N m/rad',
        'Standard deviations of the entries of K, 6x6 row-major; 0 where an entry is exact, '
        '1e9 where nothing is known of it.',
        _PREDICTOR, minimum=0.0, maximum=1e9, length=36,
    ),
    Parameter(
        'cup.damping_std', 'double_array', (0.0,) * 36, 'N s/m, N s, N m s/rad',
        'Standard deviations of the entries of P, 6x6 row-major; 0 where an entry is exact, '
        '1e9 where nothing is known of it.',
        _PREDICTOR, minimum=0.0, maximum=1e9, length=36,
    ),
    Parameter(
        'cup.max_force', 'double', 0.0, 'N',
        'Largest force that the cup can hold, for the holding margin; 0 where it is not known.',
        _PREDICTOR, minimum=0.0, maximum=1e6,
    ),
    Parameter(
        'cup.max_moment', 'double', 0.0, 'N m',
        'Largest moment at the lip that the cup can hold; 0 where it is not known.',
        _PREDICTOR, minimum=0.0, maximum=1e6,
    ),
    Parameter(
        'envelope.deflection_low', 'double_array', (0.0,) * 6, 'm, rad',
        'Smallest shift (x, y, z) and rotation vector of the lip from its nominal pose, in tool '
        'axes, that the fit has seen; all of envelope.* is 0 where it is not known.',
        _BOTH, minimum=-10.0, maximum=10.0, length=6,
    ),
    Parameter(
        'envelope.deflection_high', 'double_array', (0.0,) * 6, 'm, rad',
        'Largest shift (x, y, z) and rotation vector of the lip that the fit has seen.',
        _BOTH, minimum=-10.0, maximum=10.0, length=6,
    ),
    Parameter(
        'envelope.rates', 'double_array', (0.0,) * 6, 'm/s, rad/s',
        "Largest absolute twist of the lip in the tool, in the lip's axes, that the fit has seen.",
        _BOTH, minimum=0.0, maximum=1e4, length=6,
    ),
    Parameter(
        'envelope.frequencies', 'double_array', (0.0,) * 4, 'Hz',
        "Bands with 95 % of the power of the lip's motion: from and to of its shift, from and to "
        'of its rotation.',
        _BOTH, minimum=0.0, maximum=1e5, length=4,
    ),
    Parameter(
        'envelope.mass', 'double_array', (0.0,) * 2, 'kg',
        'Smallest and largest mass of the packages that the fit has seen.',
        _BOTH, minimum=0.0, maximum=1e4, length=2,
    ),
    Parameter(
        'filter.tool.half_window', 'integer', 0, 'samples',
        "Half window n of the filter on the tool's poses, whose window has 2 n + 1 samples; 0 "
        'takes as many as lie in 1/12 s (30 at 360 Hz).',
        _IDENTIFIER, minimum=0, maximum=10000,
    ),
    Parameter(
        'filter.tool.order', 'integer', 6, '',
        "Polynomial order of the filter on the tool's poses; at most 2 n.",
        _IDENTIFIER, minimum=2, maximum=10,
    ),
    Parameter(
        'filter.package.half_window', 'integer', 0, 'samples',
        "Half window n of the filter on the package's poses, whose window has 2 n + 1 samples; 0 "
        'takes as many as lie in 1/12 s (30 at 360 Hz).',
        _IDENTIFIER, minimum=0, maximum=10000,
    ),
    Parameter(
        'filter.package.order', 'integer', 6, '',
        "Polynomial order of the filter on the package's poses; at most 2 n.",
        _IDENTIFIER, minimum=2, maximum=10,
    ),
    Parameter(
        'filter.relative', 'bool', False, '',
        "Whether the filter takes the lip's motion in the tool instead of the package's in the "
        'world, appendix J.',
        _IDENTIFIER,
    ),
    Parameter(
        'fit.method', 'string', 'least_squares', '',
        'How the cup is fitted: least squares on accelerations (section 4.3.2) is fast, the '
        'prediction error on poses is exact with noisy recordings too and starts from the former.',
        _IDENTIFIER, choices=('least_squares', 'prediction_error'),
    ),
    Parameter(
        'fit.structure', 'string', 'axisymmetric', '',
        'Form of K and P: diagonal and equal laterally (4 + 4 unknowns), diagonal (6 + 6), or '
        'full (21 + 21).',
        _IDENTIFIER, choices=('axisymmetric', 'diagonal', 'full'),
    ),
    Parameter(
        'fit.compare_recordings', 'bool', False, '',
        'Whether each recording is fitted alone as well, and tested whether all are of one cup.',
        _IDENTIFIER,
    ),
    Parameter(
        'fit.compare_structures', 'bool', False, '',
        'Whether the structures of K and P are compared by AIC, BIC and held-out parts, and one '
        'is advised, as the command ladder does.',
        _IDENTIFIER,
    ),
    Parameter(
        'fit.time_offset', 'bool', False, '',
        'Whether the time by which the stamps of the tool are behind those of the package, up to '
        '0.05 s, is found and taken off, for every recording: for streams of two clocks.',
        _IDENTIFIER,
    ),
    Parameter(
        'gravity', 'double', 9.81, 'm/s^2',
        'Magnitude of gravity, along -z of the world.',
        _BOTH, minimum=0.0, maximum=100.0, read_only=True,
    ),
    Parameter(
        'tool_pose.type', 'string', 'pose', '',
        'What tool_arm/pose brings: PoseStamped, TransformStamped or Odometry, whose twist is not '
        'read.',
        _PREDICTOR, choices=('pose', 'transform', 'odometry'), read_only=True,
    ),
    Parameter(
        'tool_twist.frame', 'string', 'world', '',
        "Axes of the tool tip's twist, linear and angular: the world's or the tool's own.",
        _BOTH, choices=('world', 'tool'), read_only=True,
    ),
    Parameter(
        'frames.package', 'string', 'package', '',
        "Name of the package's frame B in what is published.",
        _PREDICTOR, required_text=True,
    ),
    Parameter(
        'frames.lip', 'string', 'cup_lip', '',
        "Name of the frame S of the cup's lip in what is published.",
        _PREDICTOR, required_text=True,
    ),
    Parameter(
        'frames.tf', 'bool', True, '',
        "Whether the package's frame is sent to tf, where tf2_msgs is installed.",
        _PREDICTOR, read_only=True,
    ),
    Parameter(
        'autostart', 'bool', True, '',
        'Whether the node configures and activates itself, or waits for its lifecycle manager.',
        _PREDICTOR, read_only=True,
    ),
    Parameter(
        'tool_noise.position', 'double', 1e-4, 'm',
        "Standard deviation of the tool pose's position in each axis, for the covariance.",
        _PREDICTOR, minimum=0.0, maximum=1.0,
    ),
    Parameter(
        'tool_noise.rotation', 'double', 5e-4, 'rad',
        "Standard deviation of the tool pose's rotation about each axis, for the covariance.",
        _PREDICTOR, minimum=0.0, maximum=1.0,
    ),
    Parameter(
        'coast.limit', 'double', 0.1, 's',
        'How long the tool is extrapolated when no pose comes; 0 for not at all.',
        _PREDICTOR, minimum=0.0, maximum=0.4,
    ),
    Parameter(
        'coast.poses', 'bool', False, '',
        'Whether package/pose, package/twist and cup/wrench, which cannot show that the tool is '
        'extrapolated, are published then as package/odometry is.',
        _PREDICTOR,
    ),
    Parameter(
        'vacuum.signal', 'string', 'none', '',
        'What attaches and detaches the package: nothing but the services, vacuum/held (Bool), or '
        'vacuum/pressure (FluidPressure).',
        _PREDICTOR, choices=('none', 'bool', 'pressure'), read_only=True,
    ),
    Parameter(
        'vacuum.attach_below', 'double', 60000.0, 'Pa',
        'Absolute pressure in the cup below which the package is held.',
        _PREDICTOR, minimum=0.0, maximum=1e6,
    ),
    Parameter(
        'vacuum.detach_above', 'double', 80000.0, 'Pa',
        'Absolute pressure in the cup above which the package is gone.',
        _PREDICTOR, minimum=0.0, maximum=1e6,
    ),
    Parameter(
        'validation.bags', 'string_array', (), '',
        'Recordings of the same cup and package, not in bags, on which the result is validated '
        'by free simulation.',
        _IDENTIFIER,
    ),
    Parameter(
        'output.parameters', 'string', '', '',
        "Parameter file to write the identified cup to, for the predictor; '' for none.",
        _IDENTIFIER,
    ),
    Parameter(
        'output.json', 'string', '', '',
        "File to write the result of the fit to, as JSON; '' for none.",
        _IDENTIFIER,
    ),
    Parameter(
        'output.report', 'string', '', '',
        "File to write a page with plots to, as HTML; '' for none.",
        _IDENTIFIER,
    ),
    Parameter(
        'predictor', 'string', '', '',
        "Name of a running predictor node to set the identified cup on; '' for none.",
        _IDENTIFIER,
    ),
    Parameter(
        'exit_when_done', 'bool', False, '',
        'Whether the node identifier ends when it has finished, or stays to show its result.',
        _IDENTIFIER,
    ),
)  # fmt: skip

PARAMETERS: Mapping[str, Parameter] = MappingProxyType({p.name: p for p in _TABLE})

# A file may hold several cups, and cup.name chooses: cups.NAME.stiffness is like cup.stiffness.
NAMED_CUP = re.compile(r'cups\.([A-Za-z][A-Za-z0-9_]*)\.([a-z_]+)')

# What neither node can do without and nobody can guess.
PACKAGE_PARAMETERS = ('package.mass', 'package.inertia', 'package.com')


def parameters_of(user: str) -> tuple[Parameter, ...]:
    """Return the parameters that 'identifier' or 'predictor' uses, in the table's order."""
    return tuple(p for p in _TABLE if user in p.used_by)


def lookup(name: str) -> Parameter:
    """
    Return the parameter of a name.

    Raises
    ------
    BellowsError
        If there is none; the message names the nearest.

    """
    if name in PARAMETERS:
        return PARAMETERS[name]
    named = NAMED_CUP.fullmatch(name)
    if named and named[2] != 'name' and f'cup.{named[2]}' in PARAMETERS:
        return replace(PARAMETERS[f'cup.{named[2]}'], name=name)
    raise BellowsError(f"Unknown parameter '{short(name)}'. {_hint(name, named)}")


def _hint(name: str, named: re.Match[str] | None) -> str:
    """Return what helps to find the right name."""
    if named:
        of_cups = [f'cups.{named[1]}.{key[4:]}' for key in PARAMETERS if key.startswith('cup.')]
        return hint(name, [key for key in of_cups if key != f'cups.{named[1]}.name'])
    if name.startswith('cups.'):
        return ("A cup's parameters are cups.NAME.stiffness and so on; NAME has letters, digits "
                'and underscores.')  # fmt: skip
    return hint(name, PARAMETERS)


def short(value: object) -> str:
    """Return a value in at most 80 characters, printable."""
    text = value if isinstance(value, str) else repr(value)
    text = ''.join(c if c.isprintable() else '?' for c in text[:81])
    return text if len(text) <= 80 else text[:77] + '...'
