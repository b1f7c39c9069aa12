"""
What the command line of each command takes; importing it loads nothing that takes long.

Options of several commands stand here once, those of a single one in `ARGUMENTS`.
"""

from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

STDOUT = '-'
"""As `files.atomic` takes it."""

INTERVAL = {'from': 'recording.start', 'to': 'recording.end'}
"""The parameters that options for a part of a recording set."""


class Output(str):
    """The name of a text file to write, '-' for stdout; inputs are a Path."""


class Binary(Output):
    """The name of a file to write that is no text."""


class Folder(Binary):
    """The name of a folder to write."""


class Argument(NamedTuple):
    """What `add_argument` of a parser takes."""

    name: str
    settings: Mapping[str, Any]


def argument(words: str, meaning: str, default: Any = '', **settings: Any) -> Argument:
    """
    Return an argument of a command.

    Parameters
    ----------
    words : str
        Its name, and what stands for its values in the help.
    meaning : str
        For the help.
    default
        Also tells the type: of False a switch, of [] an option that may be repeated.
    settings
        More for `add_argument`.

    """
    name, *metavars = words.split()
    if default is False:
        settings['action'] = 'store_true'
    else:
        if default == [] and name.startswith('-'):
            settings['action'] = 'append'
        elif isinstance(default, int | float):
            settings['type'] = type(default)
        if len(metavars) > 1:
            settings |= {'nargs': len(metavars), 'metavar': tuple(metavars)}
        elif metavars:
            settings['metavar'] = metavars[0]
        settings['default'] = default
    return Argument(name, {**settings, 'help': meaning})


def output(words: str, meaning: str, kind: type[Output] = Output, **settings: Any) -> Argument:
    """Return an option that names what is written."""
    return argument(words, meaning, type=kind, **settings)


def json_output(what: str) -> Argument:
    """Return --json."""
    return output(
        '--json FILE', f"write {what} as JSON; '-' for stdout (all else then goes to stderr)")


def force(what: str = 'a recording') -> Argument:
    """Return --force, which replaces existing output."""
    return argument('--force', f'replace {what} that already exists', False)


def interval(default: str = '') -> tuple[Argument, ...]:
    """Return --from and --to, which set recording.start and recording.end, by default too."""
    return tuple(argument(
        f'--{name} S', f'leave out data {which} than this, in s from the start of the data',
        default, dest=INTERVAL[name]) for name, which in (('from', 'earlier'), ('to', 'later')))


RECORDING = 'recording: a rosbag2 folder, or a .mcap or .db3 file'
BAG = argument('bag BAG', RECORDING, type=Path)


def bags(parameter: str = 'bags') -> Argument:
    """Return the recordings as positional arguments; without any, a parameter names them."""
    return argument(
        'bags BAG', f"{RECORDING}; overrides the parameter '{parameter}'", [], nargs='*',
        type=Path)


PARAMETERS = (
    argument('--params FILE', 'parameter file (YAML, as for ROS nodes); may be repeated, later '
             'files override earlier ones', [], type=Path),
    argument('--set NAME=VALUE', 'set one parameter, overriding the files; may be repeated. '
             "'bellows parameters' lists all, with units and defaults", [], dest='overrides'))
ARM = (
    argument('--urdf FILE', 'URDF of the arm, if the source has joint positions; default: the '
             "recording's /robot_description", None, type=Path),
    argument('--tool-link LINK', 'link of the arm at the tool tip E'))


def plan_arguments(numbers: str, picture: str, recording: str) -> tuple[Argument, ...]:
    """Return the arguments for a plan, its parameters and its outputs."""
    return (
        argument('plan PLAN', 'a recording with a MultiDOFJointTrajectory, Path or '
                 'JointTrajectory, with tool poses, joint states or transforms; a YAML file with '
                 'such a message or with a motion for bellows simulate; or a TUM, KITTI or EuRoC '
                 'file', type=Path),
        argument('--topic TOPIC', 'topic of the plan, if the recording has several plans'),
        *interval('0'),  # a file may hold the part of another recording
        *ARM, *PARAMETERS, json_output(numbers),
        output('--plot FILE', f'picture to write: {picture}', Binary),
        output('--out BAG', f'recording to write: {recording}', Folder), force())


PICTURES = {
    'motion': 'tool and package against time, all axes',
    'spectra': "spectra of the package's motion relative to the tool; with a cup, also of the "
               'error',
    'path': 'paths of tool and package in space',
    'deflection': "load on the cup against its deflection, with the cup's stiffness",
    'margin': 'safety factors of the grip against time, with two standard deviations',
    'residuals': 'load on the cup against time, and the part the cup does not explain',
    'prediction': 'predicted and measured pose of the package, and their difference',
    'animation': 'tool, cup and package moving (.gif; .mp4 with ffmpeg)'}
FULL_RANGE = (float('-inf'), float('inf'))  # s

ARGUMENTS: Mapping[str, tuple[Argument, ...]] = MappingProxyType({
    'info': (
        BAG, *interval(),
        output('--write-params FILE', 'write a parameter file for this recording, for bellows '
               'identify and the nodes'),
        force('a parameter file'), json_output('what was found')),
    'identify': (
        bags(), *PARAMETERS, *interval(),
        output('--out FILE', 'write the cup as a parameter file, for the predictor and bellows '
               'replay'),
        json_output('the result with its uncertainties'),
        output('--report FILE', 'write a page with plots (HTML; extra plot)'),
        argument('--force', 'also write the cup file of a refused cup; its header says so', False),
        argument('--jobs N', 'read N recordings in parallel, -1 for one per core (extra '
                 'parallel); unusable recordings are then reported and left out', None, type=int),
        argument('--dask ADDRESS', 'read them on the workers of a Dask scheduler instead (extra '
                 'dask), for example tcp://host:8786; the workers must see the recordings under '
                 'the same paths'),
        argument('--release', 'identify release.* instead, from tosses with the cup given by the '
                 "parameters; the valve is on 'topics.valve'", False)),
    'structures': (bags(), *PARAMETERS, *interval(), json_output('all figures')),
    'static': (
        bags('static.bags'),
        argument('--mass KG', 'mass in a recording, once for each BAG in the same order; '
                 'overrides package.mass', [], type=float, dest='masses'),
        *PARAMETERS, *interval(),
        output('--out FILE', 'write the parameters of --params and --set with the new nominal '
               'length'),
        json_output('all results')),
    'replay': (
        BAG, *PARAMETERS, *interval(), json_output('all figures'),
        output('--report FILE', 'write a page with plots (HTML; extra plot)'),
        output('--view FILE', 'show tool, cup and package (predicted, and measured as an '
               'outline), deflection and errors in the viewer Rerun (extra view), or write an '
               '.rrd file that it opens', Binary, default=None, nargs='?', const=''),
        argument('--observe TOPIC', 'poses of the package from a camera, which correct a second '
                 'live prediction; see measured.*'),
        argument('--calibrate-alarms', 'take the recording for sound work: find noise, its '
                 'memory, and errors of pose and stamps of the camera, and count the false alarms '
                 'to expect with and without them', False),
        output('--out FILE', 'write what was found of the camera as parameters (with --observe, '
               'and --calibrate-alarms or measured.calibrate)'),
        argument('--limit PERCENT', 'exit with 1 if the NRMSE of an axis that moves is above this',
                 None, type=float)),
    'compare': (
        argument('before FIT_A', 'result file, written by bellows identify --json', type=Path),
        argument('after FIT_B', 'the result file to compare it with', type=Path),
        json_output('the comparison')),
    'plan': (
        *plan_arguments(
            'all figures', '.png, .svg or .pdf; bands are two standard deviations',
            'the plan, and the package along it'),
        argument('--fastest', 'find the shortest time in which the safety factor, less two '
                 'standard deviations, stays above safety.least', False)),
    'steer': (
        *plan_arguments(
            'all figures', '.png, .svg or .pdf: tilt of the package over time; .gif or .mp4: '
            'planned and steered motion', 'the steered motion, and the package along it'),
        argument('--method', 'the inverse of cup and package, or input shaping for their modes at '
                 'rest', None, required=True, choices=('inverse', 'zv', 'zvd')),
        argument('--limits FILE', 'limits of the arm: the motion is slowed down until it meets '
                 'all of them; config/limits_example.yaml explains every setting', None,
                 type=Path)),
    'toss': (
        *plan_arguments(
            'the toss', '.png, .svg or .pdf; the toss from the side and from above',
            'tool and package, held, parting and flying until it lands'),
        argument('--release T', 'when to switch the valve, in s from the beginning of the plan',
                 None, type=float),
        argument('--target X Y', 'find the time of release whose landing is nearest to this '
                 'point, m in the world', None, type=float),
        argument('--target-rotation QX QY QZ QW', 'with --target: also match this orientation '
                 '(quaternion); an angle counts as the distance it moves the farthest corner',
                 None, type=float),
        argument('--monte-carlo N', 'also draw this many random tosses, beside the linear ellipse',
                 0)),
    'excite': (
        *PARAMETERS,
        argument('--limits FILE', 'limits of the arm, and noise and rates of the tracking (YAML); '
                 'config/limits_example.yaml explains every setting', None, required=True,
                 type=Path),
        argument('--time S', 'duration, s: 2 s of standstill, then the motion with ramps of 1 s '
                 'at both ends', None, required=True, type=float),
        argument('--hold S', 'then hold a tilt for this time, s, beside --time: rubber relaxes in '
                 'it, which bellows identify fits (default: 7; 0 for none)', 7.0),
        output('--out BAG', 'recording to write, with the plan on /tool_arm/plan', Folder,
               required=True),
        output('--csv FILE', 'also write the motion as text: EuRoC columns with velocities, 1000 '
               'lines per second'),
        output('--urscript FILE', 'also write it as a program for a Universal Robots arm'),
        output('--plot FILE', 'picture to write: .png, .svg or .pdf', Binary),
        argument('--beside PLAN', 'compare with another motion, a plan as for bellows plan; may '
                 'be repeated. --from and --to apply to these', [], type=Path),
        *interval('0'),
        argument('--series', 'write everything to record for a new cup into the folder --out: '
                 'standstills, this motion, and one for validation; report what each identifies',
                 False),
        argument('--seed N', 'seed of the random start; another seed gives another motion', 0),
        force(), *ARM, json_output('what to expect')),
    'simulate': (
        *PARAMETERS,
        argument('--motion FILE', 'motion file (YAML): the motion of the tool and the tracking; '
                 'config/motion_example.yaml explains every setting', None, required=True,
                 type=Path),
        argument('--plan PLAN', 'move the tool along this plan, as of bellows plan or bellows '
                 'excite; then only the rest of --motion counts', None, type=Path),
        output('--out BAG', 'recording to write, a folder', Folder, required=True),
        force(), json_output('what was recorded')),
    'plot': (
        argument('what WHAT', '; '.join(f'{name}: {text}' for name, text in PICTURES.items()),
                 choices=PICTURES),
        BAG, *PARAMETERS,
        output('--out FILE', 'picture to write: .png, .svg or .pdf; of an animation .gif or .mp4',
               Binary, required=True),
        json_output('the numbers that are drawn, in SI units,'),
        argument('--theme', 'colours on a light or dark background', 'light',
                 choices=('light', 'dark')),
        argument('--speed S', 'speed of an animation: seconds of the recording per second '
                 '(default: %(default)s)', 0.25),
        argument('--from S', "start of the picture, in s after the recording's first stamp; not "
                 'for spectra', FULL_RANGE[0], dest='first'),
        argument('--to S', 'end of the picture', FULL_RANGE[1], dest='last')),
    'play': (
        BAG, *interval(),
        argument('--topic TOPIC[:=NAME]', 'topic to play, and the name to play it under; may be '
                 'repeated (default: all with poses or twists)', [], dest='topics'),
        argument('--rate R', 'times the recorded speed', 1.0),
        argument('--stamps', 'stamps of the headers: as recorded, or the current time', 'recorded',
                 choices=('recorded', 'now')),
        json_output('what was played')),
    'convert': (
        argument('sources SOURCE', 'Motive or EuRoC .csv, TUM or KITTI .tum, .kitti or .txt; or '
                 'one recording, to write a TUM file or, with --tool-link or --tool-frame, a '
                 'recording with poses', [], nargs='+', type=Path),
        output('--out NAME', 'recording to write; from a recording also a file that ends in .tum '
               'or .txt', Folder, required=True),
        argument('--topic TOPIC', 'topic for each source, in the same order (default: '
                 '/NAME/pose); for a recording, the topic to write', []),
        argument('--markers N', 'leave out poses of Motive with fewer visible markers than this '
                 '(default: 3)', 3),
        argument('--storage', 'storage of the recording', 'mcap', choices=('mcap', 'sqlite3')),
        force(), *interval(), *ARM,
        argument('--tool-frame FRAME', 'frame of the tool tip E in the transforms (/tf, '
                 '/tf_static) of a recording'),
        argument('--package-frame FRAME', 'frame of the package in the transforms (/tf, '
                 '/tf_static) of a recording'),
        argument('--world-frame FRAME', 'frame of the poses to write (default: the farthest frame '
                 'above the tool)'),
        argument('--unit', 'unit of the positions in a recording, of --topic or of all poses '
                 '(default: m)', 'm', choices=('m', 'mm')),
        argument('--quaternion', 'order of the quaternions there (default: xyzw, as in ROS)',
                 'xyzw', choices=('xyzw', 'wxyz')),
        json_output('what was converted')),
    'export': (
        argument('params CUP', 'parameter file with cup and package', nargs=1, type=Path),
        argument('--set NAME=VALUE', 'set one parameter, overriding the file; may be repeated', [],
                 dest='overrides'),
        argument('--to', 'mjcf: MuJoCo; sdf: Gazebo, Drake and others; c: a header in C99', None,
                 choices=('mjcf', 'sdf', 'c'), required=True),
        argument('--name', 'of the numbers in the header in C, and prefix of their names '
                 '(default: %(default)s); another one for each cup of a program',
                 'bellows_exported'),
        output('--out FILE', 'model to write', required=True),
        json_output('what the format cannot express')),
    'parameters': (
        argument('names NAME', 'list only names that begin with this', [], nargs='*'),
        argument('--yaml', 'print a parameter file with the defaults, to fill in', False),
        json_output('the table'))})

NEGATIVE_RESULTS: Mapping[str, str] = MappingProxyType({
    'identify': 'the fit cannot be used',
    'structures': 'no structure fits',
    'replay': 'an axis that moves is above --limit; without it, above 5 % and 3 times what noise '
              'explains',
    'compare': 'a change matters',
    'plan': 'the cup lets go, or --fastest finds no time that is safe',
    'toss': 'no release of the plan lands, or none at the target'})
"""What it means that a command ends with 1."""
