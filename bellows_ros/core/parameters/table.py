"""
The table of all parameters: of both nodes, the parameter files and the command line.

A 6x6 matrix is 36 numbers, row-major; an inertia is [ixx, iyy, izz, ixy, ixz, iyz]; units are SI.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from difflib import get_close_matches
import re
from types import MappingProxyType
from typing import Literal

from bellows_ros.core.model.structure import (
    RELAXATION_TIMES,
    structure_named,
    STRUCTURE_NAMES,
)
from bellows_ros.errors import BellowsError

Kind = Literal['bool', 'integer', 'double', 'string', 'double_array', 'string_array']
Value = bool | int | float | str | tuple[float, ...] | tuple[str, ...]

# Diagonals of (4.78), N/m and N m/rad, and (4.79), N s/m and N m s/rad; l0 of chapter 3, m.
THESIS_STIFFNESS = (6417.0, 6417.0, 1.153e4, 3.868, 3.868, 1.123)
THESIS_DAMPING = (66.06, 66.06, 22.35, 0.05458, 0.05458, 0.09736)
THESIS_LENGTH = 0.0481

# Other names of some parameters, and the similarity at which a name is recognised.
OTHER_WORDS = MappingProxyType({
    'weight': 'package.mass', 'payload': 'package.mass', 'center_of_mass': 'package.com',
    'centre_of_mass': 'package.com', 'spring': 'cup.stiffness', 'nominal_length': 'cup.length',
})
ALIKE, CERTAIN = 0.75, 0.9
ANY = 0
"""Length of an array that may have any."""


@dataclass(frozen=True)
class Parameter:
    """
    One parameter: its meaning, its constraints and its users.

    Parameters
    ----------
    name : str
        Dotted name.
    default : value or None
        None if there is no sensible default: the user must then give a value.
    unit : str
        SI unit, '' where there is none.
    used_by : tuple of str
        'identifier', 'predictor'.
    kind : str
        bool, integer, double, string, double_array or string_array, as in ROS; that of the
        default, where there is one.
    minimum, maximum : float, optional
        Allowed range of the number, or of each number of an array; both ends are allowed.
    above : float, optional
        The number must be larger than this.
    choices : tuple of str
        The allowed strings, when not empty.
    length : int, optional
        How many numbers an array has, `ANY` for any; else as many as the default, if there is one.
    required_text : bool
        True where the empty string is refused.
    read_only : bool
        True where a running node cannot change it.
    example : str
        What to write for a parameter without a default.
    description : str
        A sentence or two.

    """

    name: str
    default: Value | None
    unit: str
    used_by: tuple[str, ...]
    kind: Kind = 'string'
    minimum: float | None = None
    maximum: float | None = None
    above: float | None = None
    choices: tuple[str, ...] = ()
    length: int | None = None
    required_text: bool = False
    read_only: bool = False
    example: str = ''
    description: str = ''

    def __post_init__(self) -> None:
        """Take the kind, and the length of an array, from the default."""
        if self.kind == 'double_array' and self.default == ():
            object.__setattr__(self, 'length', ANY)
        elif isinstance(self.default, tuple) and self.default:
            if self.length is None:
                object.__setattr__(self, 'length', len(self.default))
            object.__setattr__(self, 'kind', 'double_array')
        elif self.default is not None:
            object.__setattr__(self, 'kind', _KINDS[type(self.default)])

    @property
    def constraint(self) -> str:
        """The constraint in words: kind, count, range, choices and unit."""
        unit = f' ({self.unit})' if self.unit else ''
        if self.choices:
            some = 'a list of some of ' if self.kind == 'string_array' else 'one of '
            return some + ', '.join(self.choices)
        kind = _KIND_MESSAGES[self.kind]
        if self.length:
            kind = kind.replace('numbers', f'{self.length} numbers')
        return kind + self._range() + unit

    @property
    def default_text(self) -> str:
        """The default in words."""
        default = self.default
        if default is None:
            return 'must be given'
        if isinstance(default, tuple):
            if len(set(default)) < 2:
                return f'default all {default[0]:g}' if default else 'default none'
            known = 'the unit matrix' if self.name == 'release.correlation' else 'from the thesis'
            return f'default {known if len(default) > 6 else list(default)}'
        return f'default {str(default).lower() if isinstance(default, bool) else repr(default)}'

    def _range(self) -> str:
        """Return the range in words, with a leading blank, or ''."""
        low = [f'above {self.above:g}'] if self.above is not None else []
        low += [f'at least {self.minimum:g}'] if self.minimum is not None else []
        high = [f'at most {self.maximum:g}'] if self.maximum is not None else []
        text = ' and '.join(low + high)
        each = ' each' if self.kind == 'double_array' else ''
        return f',{each} {text}' if text else ''


_KINDS: Mapping[type, Kind] = {
    bool: 'bool', int: 'integer', float: 'double', str: 'string', tuple: 'string_array'}

_KIND_MESSAGES: Mapping[Kind, str] = {
    'bool': 'true or false', 'integer': 'an integer', 'double': 'a number',
    'string': 'a string', 'double_array': 'a list of numbers', 'string_array': 'a list of strings'}


def _diagonal(values: tuple[float, ...]) -> tuple[float, ...]:
    """Return a diagonal matrix as a row-major tuple."""
    size = range(len(values))
    return tuple(values[i] if i == j else 0.0 for i in size for j in size)


_BOTH = ('identifier', 'predictor')
_IDENTIFIER = ('identifier',)
_PREDICTOR = ('predictor',)

_TABLE = (
    Parameter('bags', (), '', _IDENTIFIER,
              description='Recordings to identify from: rosbag2 folders, or single .mcap or .db3 '
              'files.'),
    Parameter('topics.tool_pose', 'tool_arm/pose', '', _IDENTIFIER, required_text=True,
              description='Topic with the pose of the tool tip E in the world.'),
    Parameter('topics.tool_twist', '', '', _IDENTIFIER,
              description="Topic with the tool tip's twist; '' for none: the twist is then "
              'estimated from the poses.'),
    Parameter('topics.package_pose', 'package/pose', '', _IDENTIFIER, required_text=True,
              description='Topic with the pose of the package in the world.'),
    Parameter('topics.valve', 'vacuum/valve', '', _IDENTIFIER,
              description='Topic (Bool) that becomes false when the valve is switched off, for '
              "identify --release; '' for none."),
    Parameter('recording.world', 'z_up', '', _IDENTIFIER, choices=('z_up', 'motive_y_up'),
              description='World frame of the recording: z up, or y up as Motive records it, '
              'equation (4.1).'),
    Parameter('recording.package_frame', None, '', _IDENTIFIER, kind='string',
              choices=('com', 'lip'), example='com',
              description='Point of the package whose poses are recorded: com, its centre of mass '
              "B, or lip, the cup's lip S."),
    Parameter('recording.package_world', '', '', _BOTH,
              description="Pose of the package's world in the tool's world, if their poses come "
              "from a robot driver and motion capture: 'x y z qx qy qz qw' (m), or estimate "
              "(recordings only); '' if both use one world. Live it applies to package/measured."),
    Parameter('recording.align_at_rest', False, '', _IDENTIFIER,
              description='Whether to correct rotated marker frames and a lateral pick-up offset '
              'from the standstill at the beginning, equations (4.2)-(4.13).'),
    Parameter('recording.rest_duration', 1.0, 's', _IDENTIFIER, minimum=0.01, maximum=600.0,
              description='Duration of the standstill at the beginning of the recording; used '
              'with recording.align_at_rest.'),
    Parameter('recording.marker_std', (1e-3, 5e-3), 'm, rad', _IDENTIFIER, minimum=0.0,
              maximum=1.0,
              description='Standard deviations with which the marker frames, and '
              'recording.package_world where it is given, are known: position and rotation in '
              'each axis; for the errors of K and P, 0 for exact.'),
    Parameter('recording.clock_std', 1e-3, 's', _IDENTIFIER, minimum=0.0, maximum=1.0,
              description='Standard deviation of the offset between the clocks of tool and '
              'package, for the errors of K and P; 0 for one clock.'),
    Parameter('recording.start', 0.0, 's', _IDENTIFIER, minimum=0.0, maximum=1e6,
              description="Start of the data to use, from the recording's first stamp."),
    Parameter('recording.end', 0.0, 's', _IDENTIFIER, minimum=0.0, maximum=1e6,
              description="End of the data to use, from the recording's first stamp; 0 for the "
              'whole recording.'),
    Parameter('package.mass', None, 'kg', _BOTH, kind='double', above=0.0, maximum=1e4,
              example='2.17',
              description='Mass of the held package.'),
    Parameter('package.inertia', None, 'kg m^2', _BOTH, kind='double_array', minimum=-1e6,
              maximum=1e6, length=6, example='[0.0087, 0.0087, 0.0173, 0.0, 0.0, 0.0]',
              description='Inertia of the package at B, in axes of B: ixx, iyy, izz, ixy, ixz, '
              'iyz.'),
    Parameter('package.com', None, 'm', _BOTH, kind='double_array', minimum=-10.0, maximum=10.0,
              length=3, example='[0.0, 0.0, -0.03]',
              description="Centre of mass B in the frame S of the cup's lip; below the lip z is "
              'negative.'),
    Parameter('package.mass_std', 0.0, 'kg', _BOTH, minimum=0.0, maximum=1e4,
              description='Standard deviation of the mass, for the uncertainty of predicted '
              'plans, and for the errors of K and P: there 1 % if it is 0.'),
    Parameter('package.inertia_std', (0.0,) * 6, 'kg m^2', _BOTH, minimum=0.0, maximum=1e6,
              description='Standard deviations of the inertia: ixx, iyy, izz, ixy, ixz, iyz; in '
              'an identification 5 % if all are 0.'),
    Parameter('package.com_std', (0.0,) * 3, 'm', _BOTH, minimum=0.0, maximum=10.0,
              description='Standard deviations of the centre of mass in the frame S; in an '
              'identification 2 mm if all are 0.'),
    Parameter('package.size', (0.0,) * 3, 'm', _PREDICTOR, minimum=0.0, maximum=10.0,
              description='Sides of the package along x, y and z of B, for its landing; 0 if '
              'unknown.'),
    Parameter('package.size_center', (0.0,) * 3, 'm', _PREDICTOR, minimum=-10.0, maximum=10.0,
              description='Centre of the box of package.size in B; 0 if it is the centre of '
              'mass.'),
    Parameter('package.attached', True, '', _PREDICTOR, read_only=True,
              description='Whether the cup holds the package when the node becomes active; a '
              'vacuum signal, if there is one, overrides it.'),
    Parameter('package.files', (), '', _IDENTIFIER,
              description='Parameter files, one for each recording, with package.*, topics.*, '
              'recording.*, tool_twist.* and gravity.direction as far as they differ; empty if '
              'none differ.'),
    Parameter('static.bags', (), '', _IDENTIFIER,
              description='Recordings of standstills of the same cup, fitted together with the '
              'motion in bags.'),
    Parameter('static.files', (), '', _IDENTIFIER,
              description='Parameter files with package.mass, and package.com where it differs, '
              'one for each of static.bags; empty if package.* applies to all.'),
    Parameter('static.length', False, '', _IDENTIFIER,
              description='Whether to find cup.length from static.bags, which must then contain '
              'two or more masses with the tool upright, section 4.2.'),
    Parameter('cup.length', THESIS_LENGTH, 'm', _BOTH, above=0.0, maximum=1.0,
              description='Length l0 of the cup from E to S under vacuum and without load.'),
    Parameter('cup.stiffness', _diagonal(THESIS_STIFFNESS), 'N/m, N, N m/rad', _BOTH, minimum=-1e9,
              maximum=1e9,
              description='Static stiffness K of the cup, 6x6 row-major, linear first; symmetric '
              'positive definite.'),
    Parameter('cup.damping', _diagonal(THESIS_DAMPING), 'N s/m, N s, N m s/rad', _BOTH,
              minimum=-1e9, maximum=1e9,
              description='Damping P of the cup, 6x6 row-major, linear first; symmetric positive '
              'semidefinite.'),
    Parameter('cup.relaxation', (0.0, 0.0), '', _BOTH, minimum=0.0, maximum=100.0,
              description='Strengths r1, r2 of the relaxation of the rubber: a sudden strain '
              'meets the stiffness K (1 + r1 + r2), of which K remains; 0 for a cup that does not '
              'relax.'),
    Parameter('cup.relaxation_times', RELAXATION_TIMES, 's', _BOTH, above=0.0, maximum=1e3,
              description='Times of cup.relaxation. Leave them: the strengths are identified with '
              'these, and others describe the same cup as well.'),
    Parameter('cup.layout', (0.0, 0.0, 0.0), 'm', _BOTH, length=ANY, minimum=-10.0, maximum=10.0,
              description='Positions x, y, z in E of the equal, parallel cups of a gripper, one '
              'after the other; all else in cup.* is of one cup.'),
    Parameter('cup.open', (-1.0,), '', _PREDICTOR, length=ANY, minimum=-1.0,
              description='Cups of cup.layout, from 0, that do not hold: they leave K, P and the '
              'safety factor. -1 for none, as ROS has no empty lists.'),
    Parameter('cup.name', '', '', _PREDICTOR,
              description="Name of the mounted cup, one of cups.NAME.*; '' for the one in cup.*."),
    Parameter('cup.length_std', 1e-3, 'm', _IDENTIFIER, minimum=0.0, maximum=1.0,
              description='Standard deviation of cup.length, for the errors of K and P; 0 for '
              'exact.'),
    Parameter('cup.stiffness_std', (0.0,) * 36, 'N/m, N, N m/rad', _PREDICTOR, minimum=0.0,
              maximum=1e9,
              description='Standard deviations of the entries of K, 6x6 row-major; 0 for an exact '
              'entry, 1e9 for an unknown one.'),
    Parameter('cup.damping_std', (0.0,) * 36, 'N s/m, N s, N m s/rad', _PREDICTOR, minimum=0.0,
              maximum=1e9,
              description='Standard deviations of the entries of P, 6x6 row-major; 0 for an exact '
              'entry, 1e9 for an unknown one.'),
    Parameter('cup.lip_radius', 0.0, 'm', _PREDICTOR, minimum=0.0, maximum=1.0,
              description='Radius of the lip on the package, for the safety factor of the grip; 0 '
              'if unknown.'),
    Parameter('cup.suction_area', 0.0, 'm^2', _PREDICTOR, minimum=0.0, maximum=10.0,
              description='Area on which the vacuum acts; 0 for a disc of radius cup.lip_radius.'),
    Parameter('cup.friction', 0.5, '', _PREDICTOR, above=0.0, maximum=10.0,
              description='Coefficient of friction between lip and package.'),
    Parameter('envelope.deflection_low', (0.0,) * 6, 'm, rad', _BOTH, minimum=-10.0, maximum=10.0,
              description='Validity range: smallest shift (x, y, z) and rotation vector of the '
              'lip from its nominal pose, in tool axes, in the fit; all of envelope.* is 0 if '
              'unknown.'),
    Parameter('envelope.deflection_high', (0.0,) * 6, 'm, rad', _BOTH, minimum=-10.0, maximum=10.0,
              description='Validity range: largest shift (x, y, z) and rotation vector of the lip '
              'in the fit.'),
    Parameter('envelope.rates', (0.0,) * 6, 'm/s, rad/s', _BOTH, minimum=0.0, maximum=1e4,
              description='Validity range: largest absolute twist of the lip in the tool, in the '
              "lip's axes, in the fit."),
    Parameter('envelope.frequencies', (0.0,) * 4, 'Hz', _BOTH, minimum=0.0, maximum=1e5,
              description="Validity range: bands with 95 % of the power of the lip's motion in "
              'the fit; low and high limit for its shift, then for its rotation.'),
    Parameter('envelope.mass', (0.0,) * 2, 'kg', _BOTH, minimum=0.0, maximum=1e4,
              description='Validity range: smallest and largest mass of the packages in the fit.'),
    Parameter('filter.tool.half_window', 0, 'samples', _IDENTIFIER, minimum=0, maximum=10000,
              description="Half window n of the filter on the tool's poses, with 2 n + 1 samples "
              'in the window; 0 for the number of samples in 1/12 s (30 at 360 Hz).'),
    Parameter('filter.tool.order', 6, '', _IDENTIFIER, minimum=2, maximum=10,
              description="Polynomial order of the filter on the tool's poses; at most 2 n."),
    Parameter('filter.package.half_window', 0, 'samples', _IDENTIFIER, minimum=0, maximum=10000,
              description="Half window n of the filter on the package's poses, with 2 n + 1 "
              'samples in the window; 0 for the number of samples in 1/12 s (30 at 360 Hz).'),
    Parameter('filter.package.order', 6, '', _IDENTIFIER, minimum=2, maximum=10,
              description="Polynomial order of the filter on the package's poses; at most 2 n."),
    Parameter('fit.method', 'output_error', '', _IDENTIFIER,
              choices=('output_error', 'least_squares'),
              description='Method of the fit. output_error, by simulation from pose to pose, is '
              'unbiased by noise of both bodies, and takes any sensor: motion capture, or a robot '
              'and a camera of 10 to 60 Hz. '
              'least_squares, on accelerations (section 4.3.2), is for a quick look and '
              'for very many recordings.'),
    Parameter('fit.structure', 'axisymmetric', '', _IDENTIFIER, choices=STRUCTURE_NAMES,
              description='Form of K and P: ' + '; '.join(
                  f'{s.name}: {s.meaning} ({s.size} + {s.size} unknowns)'
                  for s in map(structure_named, STRUCTURE_NAMES)) + '.'),
    Parameter('fit.relaxation', 'auto', '', _IDENTIFIER, choices=('auto', 'off', 'on'),
              description='Whether to estimate cup.relaxation together with K and P. auto: where '
              'it is significant; on: else refuse the recordings.'),
    Parameter('fit.compare_recordings', False, '', _IDENTIFIER,
              description='Whether to fit each recording alone as well, and test whether all are '
              'of one cup.'),
    Parameter('fit.compare_structures', False, '', _IDENTIFIER,
              description='Whether to compare the structures of K and P by AIC, BIC and held-out '
              'error, and recommend one, as bellows structures does.'),
    Parameter('fit.time_offset', False, '', _IDENTIFIER,
              description="Whether to estimate, for every recording, the delay of the tool's "
              "stamps behind the package's, up to 0.1 s, and remove it: for streams of two "
              'clocks.'),
    Parameter('fit.free', (), '', _IDENTIFIER,
              choices=('time_offset', 'com', 'length', 'inertia', 'mass', 'package_world',
                       'package_marker'),
              description='Quantities to estimate together with K and P, with standard errors: '
              'time_offset, com, length, inertia, mass, package_world, package_marker (the pose '
              'of the marker on the package; with output_error). Refused if they are not '
              'identifiable.'),
    Parameter('gravity.magnitude', 9.81, 'm/s^2', _BOTH, minimum=0.0, maximum=100.0,
              read_only=True,
              description='Magnitude of gravity; may be written as gravity.'),
    Parameter('gravity.direction', (0.0, 0.0, -1.0), '', _BOTH, minimum=-1e3, maximum=1e3,
              read_only=True,
              description='Direction of gravity in the world, of any length; not -z if the world '
              'is the base of an arm on a wall or ceiling.'),
    Parameter('tool_pose.type', 'pose', '', _PREDICTOR,
              choices=('pose', 'pose_with_covariance', 'transform', 'odometry', 'tf'),
              read_only=True,
              description='Type of tool_arm/pose: PoseStamped, PoseWithCovarianceStamped, '
              'TransformStamped or Odometry, whose covariance and twist are not read; or tf, for '
              'the pose of frames.tool in frames.world.'),
    Parameter('tool_pose.offset', '', '', _BOTH, read_only=True,
              description='Pose of E in the frame of the tool whose poses, twists and plans are '
              "recorded or received: 'x y z qx qy qz qw' (m); '' if that frame is E. '0 0 0 1 0 0 "
              "0' for a flange with z out of it, as in ROS-Industrial."),
    Parameter('tool_twist.frame', 'world', '', _BOTH, choices=('world', 'tool'), read_only=True,
              description="Axes of the tool tip's twist, linear and angular: the world's or the "
              "tool's own."),
    Parameter('plan.frame', '', '', _PREDICTOR,
              description="Frame that plans must be in; '' for any."),
    Parameter('plan.rate', 20.0, 'Hz', _PREDICTOR, minimum=0.1, maximum=50.0,
              description='Highest rate at which the rest of a plan is predicted again while the '
              'tool drives it.'),
    Parameter('plan.points_rate', 100.0, 'Hz', _PREDICTOR, minimum=0.1, maximum=10000.0,
              description='Highest number of points per second in the answer to a plan; the last '
              'point is always included. Their twists describe the motion between them.'),
    Parameter('steer.method', 'inverse', '', _PREDICTOR, choices=('inverse', 'zv', 'zvd'),
              description='Method of steering: the inverse of cup and package, or input shaping '
              '(zv, zvd).'),
    Parameter('tool_link', '', '', _PREDICTOR,
              description="Link of the arm's URDF at the tool tip E, z along the cup, for plans "
              'of its joints.'),
    Parameter('frames.package', 'package', '', _PREDICTOR, required_text=True,
              description="Name of the package's frame B in published messages."),
    Parameter('frames.lip', 'cup_lip', '', _PREDICTOR, required_text=True,
              description="Name of the frame S of the cup's lip in published messages."),
    Parameter('frames.world', 'world', '', _PREDICTOR, required_text=True, read_only=True,
              description="Frame of tf in which the tool's pose is looked up, with tool_pose.type "
              'tf.'),
    Parameter('frames.tool', 'tool0', '', _PREDICTOR, required_text=True, read_only=True,
              description='Frame of tf at the tool tip E, with tool_pose.type tf.'),
    Parameter('frames.tf', True, '', _PREDICTOR, read_only=True,
              description="Whether to send the package's frame to tf; needs tf2_msgs."),
    Parameter('autostart', True, '', _PREDICTOR, read_only=True,
              description='Whether the node configures and activates itself, or waits for its '
              'lifecycle manager.'),
    Parameter('tool_noise.position', 1e-4, 'm', _PREDICTOR, minimum=0.0, maximum=1.0,
              description="Standard deviation of the tool pose's position in each axis, for the "
              'covariance.'),
    Parameter('tool_noise.rotation', 5e-4, 'rad', _PREDICTOR, minimum=0.0, maximum=1.0,
              description="Standard deviation of the tool pose's rotation about each axis, for "
              'the covariance.'),
    Parameter('measured.type', 'pose', '', _PREDICTOR,
              choices=('pose', 'pose_with_covariance', 'odometry'), read_only=True,
              description='Type of package/measured: PoseStamped, PoseWithCovarianceStamped or '
              'Odometry.'),
    Parameter('measured.noise', (2e-3, 1e-2), 'm, rad', _PREDICTOR, minimum=1e-6, maximum=1.0,
              description='Standard deviations of a measured pose of the package, position and '
              'rotation in each axis, if the message has no covariance.'),
    Parameter('measured.memory', 0.043, 's', _PREDICTOR, minimum=1e-3, maximum=1.0,
              description='Time in which the correlation of the noise of measured poses falls to '
              '1 / e, at the beginning; it is then estimated from the poses.'),
    Parameter('measured.frame', 'com', '', _PREDICTOR, choices=('com', 'lip'),
              description="Measured frame of the package: its centre of mass B, or the cup's lip "
              'S.'),
    Parameter('measured.offset', (0.0,) * 6, 'm, rad', _PREDICTOR, minimum=-10.0, maximum=10.0,
              description='Pose of the measured marker in the frame named by measured.frame: '
              'position and rotation vector.'),
    Parameter('measured.offset_std', (1e-3, 2e-3), 'm, rad', _PREDICTOR, minimum=0.0, maximum=1.0,
              description='Standard deviations of a constant error of the calibration of the '
              'camera, and of measured.offset: position and rotation in each axis.'),
    Parameter('measured.latency_std', 5e-3, 's', _PREDICTOR, minimum=0.0, maximum=0.5,
              description='Standard deviation of a constant error of the stamps of measured '
              'poses.'),
    Parameter('measured.calibrate', False, '', _PREDICTOR,
              description='Whether to estimate pose and latency of the camera, with standard '
              'deviations of at least 30 mm, 50 mrad and 50 ms at the beginning; bellows replay '
              '--observe prints them.'),
    Parameter('payload.estimate', True, '', _PREDICTOR,
              description='Whether to estimate mass and centre of mass of each package from its '
              'measured poses, starting from package.* and its standard deviations (10 % and 10 '
              'mm if these are 0).'),
    Parameter('alarm.false_per_hour', 1.0, '1/h', _PREDICTOR, minimum=0.0, maximum=1e3,
              description='Acceptable number of false alarms per hour of normal operation with '
              'measured poses of the package; 0 for no alarms.'),
    Parameter('coast.limit', 0.1, 's', _PREDICTOR, minimum=0.0, maximum=0.4,
              description='Longest time to extrapolate the tool without a new pose; 0 for no '
              'extrapolation.'),
    Parameter('coast.poses', False, '', _PREDICTOR,
              description='Whether to publish package/pose, package/twist and cup/wrench during '
              'extrapolation as well, although they cannot show it; package/odometry can.'),
    Parameter('vacuum.signal', 'none', '', _PREDICTOR, choices=('none', 'bool', 'pressure'),
              read_only=True,
              description='Source of attaching and detaching the package: none (the services '
              'only), bool (vacuum/held, Bool) or pressure (vacuum/pressure, FluidPressure).'),
    Parameter('vacuum.attach_below', 60000.0, 'Pa', _PREDICTOR, minimum=0.0, maximum=1e6,
              description='Absolute pressure in the cup below which the package is held.'),
    Parameter('vacuum.detach_above', 80000.0, 'Pa', _PREDICTOR, minimum=0.0, maximum=1e6,
              description='Absolute pressure in the cup above which the package is released.'),
    Parameter('vacuum.ambient', 101325.0, 'Pa', _PREDICTOR, minimum=0.0, maximum=1e6,
              description='Absolute pressure around the cup, from which vacuum/pressure is '
              'subtracted.'),
    Parameter('vacuum.holding', 0.0, 'Pa', _PREDICTOR, minimum=0.0, maximum=1e6,
              description='Pressure below ambient in the cup while it holds the package, for the '
              'safety factor of the grip if vacuum/pressure is not received; 0 if unknown.'),
    Parameter('safety.least', 1.5, '', _PREDICTOR, minimum=1.0, maximum=100.0,
              description='Smallest acceptable safety factor of the grip; below it the node '
              'warns, below 1 the cup lets go.'),
    Parameter('release.delay', 0.0, 's', _PREDICTOR, minimum=0.0, maximum=1.0,
              description='Time from switching the valve until the suction force starts to fall.'),
    Parameter('release.delay_std', 0.0, 's', _PREDICTOR, minimum=0.0, maximum=1.0,
              description='Standard deviation of release.delay from toss to toss.'),
    Parameter('release.tau', 0.0, 's', _PREDICTOR, minimum=0.0, maximum=1.0,
              description='Time constant of the fall of the suction force; 0 for an immediate '
              'fall.'),
    Parameter('release.tau_std', 0.0, 's', _PREDICTOR, minimum=0.0, maximum=1.0,
              description='Standard deviation of release.tau.'),
    Parameter('release.impulse', 0.0, 'N s', _PREDICTOR, minimum=-10.0, maximum=10.0,
              description='Impulse of the blow-off on the package at release, along -z of the '
              'lip; 0 for none.'),
    Parameter('release.impulse_std', 0.0, 'N s', _PREDICTOR, minimum=0.0, maximum=10.0,
              description='Standard deviation of release.impulse.'),
    Parameter('release.blow_off', 0.0, '', _PREDICTOR, minimum=0.0, maximum=1000.0,
              description='Blow-off towards which the suction falls, as a part of the suction '
              'that holds; 0 for none.'),
    Parameter('release.blow_off_std', 0.0, '', _PREDICTOR, minimum=0.0, maximum=1000.0,
              description='Standard deviation of release.blow_off.'),
    Parameter('release.closing', 0.0, 'N', _PREDICTOR, minimum=0.0, maximum=10000.0,
              description='Force with which the suction that holds closes the bellows; must be '
              'above 0 if release.opening is.'),
    Parameter('release.closing_std', 0.0, 'N', _PREDICTOR, minimum=0.0, maximum=10000.0,
              description='Standard deviation of release.closing.'),
    Parameter('release.opening', 0.0, 'm', _PREDICTOR, minimum=0.0, maximum=1.0,
              description='Stretch at which the open bellows pull as much as release.closing; 0 '
              'for a cup that keeps its nominal length until it lets go.'),
    Parameter('release.opening_std', 0.0, 'm', _PREDICTOR, minimum=0.0, maximum=1.0,
              description='Standard deviation of release.opening.'),
    Parameter('release.damping', 0.0, 'N s/m', _PREDICTOR, minimum=0.0, maximum=10000.0,
              description='Damping of the opening bellows along z; 0 for that in cup.damping.'),
    Parameter('release.damping_std', 0.0, 'N s/m', _PREDICTOR, minimum=0.0, maximum=10000.0,
              description='Standard deviation of release.damping.'),
    Parameter('release.sticking', 0.0, '', _PREDICTOR, minimum=0.0, maximum=1000.0,
              description='Force with which the lip sticks, as a part of the suction force that '
              'holds; without vacuum.holding, the cup lets go at minus this suction.'),
    Parameter('release.sticking_std', 0.0, '', _PREDICTOR, minimum=0.0, maximum=1000.0,
              description='Standard deviation of release.sticking.'),
    Parameter('release.correlation', _diagonal((1.0,) * 8), '', _PREDICTOR, minimum=-1.0,
              maximum=1.0,
              description='Correlations of the numbers of the law of release, 8x8 row-major in '
              'the order delay, tau, impulse, blow_off, closing, opening, damping, sticking.'),
    Parameter('release.mass_range', (0.0, 0.0), 'kg', _PREDICTOR, minimum=0.0, maximum=1000.0,
              description='Lightest and heaviest package from whose drops release.* was '
              'identified; a toss of another is warned of and is less certain. 0, 0: not known.'),
    Parameter('landing.height', 0.0, 'm', _PREDICTOR, minimum=-100.0, maximum=100.0,
              description='Height of the floor on which a tossed package lands, in the world, '
              'along -gravity.'),
    Parameter('landing.rate', 50.0, 'Hz', _PREDICTOR, minimum=0.1, maximum=50.0,
              description='Highest rate of package/landing.'),
    Parameter('landing.aim', False, '', _PREDICTOR,
              description='Whether to publish on release/at when to switch the valve for '
              'landing.target.'),
    Parameter('landing.target', (0.0,) * 2, 'm', _PREDICTOR, minimum=-100.0, maximum=100.0,
              description="Desired landing point: x and y of B in the frame of the tool's poses."),
    Parameter('validation.bags', (), '', _IDENTIFIER,
              description='Recordings of the same cup and package, not in bags, to validate the '
              'result by free simulation.'),
    Parameter('output.parameters', '', '', _IDENTIFIER,
              description="Parameter file to write the identified cup to, for the predictor; '' "
              'for none.'),
    Parameter('output.json', '', '', _IDENTIFIER,
              description="File to write the result of the fit to, as JSON; '' for none."),
    Parameter('output.report', '', '', _IDENTIFIER,
              description="File to write a page with plots to, as HTML; '' for none. Needs "
              'matplotlib.'),
    Parameter('predictor', '', '', _IDENTIFIER,
              description="Name of a running predictor node that receives the identified cup; '' "
              'for none.'),
    Parameter('exit_when_done', False, '', _IDENTIFIER,
              description='Whether the node identifier exits when it has finished, or stays to '
              'show its result.'),
)

PARAMETERS: Mapping[str, Parameter] = MappingProxyType({p.name: p for p in _TABLE})

# A file may hold several cups, and cup.name chooses: cups.NAME.stiffness is like cup.stiffness.
NAMED_CUP = re.compile(r'cups\.([A-Za-z][A-Za-z0-9_]*)\.([a-z_]+)')

SHORT_FORMS: Mapping[str, str] = MappingProxyType({'gravity': 'gravity.magnitude'})
"""Aliases; `lookup` returns the parameter with its full name."""


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
    name = SHORT_FORMS.get(name, name)
    if name in PARAMETERS:
        return PARAMETERS[name]
    named = NAMED_CUP.fullmatch(name)
    if named and named[2] != 'name' and f'cup.{named[2]}' in PARAMETERS:
        return replace(PARAMETERS[f'cup.{named[2]}'], name=name)
    raise BellowsError(f"Unknown parameter '{short(name)}'. {_hint(name, named)}")


def _hint(name: str, named: re.Match[str] | None) -> str:
    """Return a hint at the right name."""
    if named:
        of_cups = [f'cups.{named[1]}.{key[4:]}' for key in PARAMETERS if key.startswith('cup.')]
        return _nearest(name, [key for key in of_cups if key != f'cups.{named[1]}.name'])
    if name.startswith('cups.'):
        return ("A cup's parameters are cups.NAME.stiffness and so on; NAME has letters, digits "
                'and underscores.')
    return _nearest(name, [*PARAMETERS, *SHORT_FORMS])


def _nearest(name: str, known: Sequence[str]) -> str:
    """Return the nearest known name, the names of the same group, or the groups."""
    name = name[:80]
    group, _, leaf = name.rpartition('.')
    inside = [other for other in known if other.startswith(f'{name}.')]
    beside = inside or [other for other in known if group and other.startswith(f'{group}.')]
    words = {word: other for word, other in OTHER_WORDS.items() if other in known}
    leaves = {} if beside else {o.rpartition('.')[2]: o for o in reversed(known)}
    near = get_close_matches(name, known, 1, CERTAIN) if group else []
    near += [words[word] for word in get_close_matches(leaf, words, 1, ALIKE)]
    near += [] if inside else get_close_matches(name, beside, 1, ALIKE)
    near += [] if inside else get_close_matches(name, known, 1, ALIKE)
    near += [leaves[word] for word in get_close_matches(leaf, leaves, 1)]
    if near:
        return f"Did you mean '{near[0]}'?"
    if beside:
        return f'Known there are: {", ".join(beside)}.'
    groups = dict.fromkeys(f'{own.partition(".")[0]}.*' for own in known if '.' in own)
    return f"Known are {', '.join(groups)}; 'bellows parameters' lists them all."


def short(value: object, most: int = 80) -> str:
    """Return a value as printable text of at most this many characters."""
    text = value if isinstance(value, str) else repr(value)
    text = ''.join(c if c.isprintable() else '?' for c in text[:most + 1])
    return text if len(text) <= most else text[:most - 3] + '...'
