"""
The command `bellows`: the package from a shell, without ROS.

The commands are functions whose docstring is the help of the command. They import their work when
called, so that help and completion answer at once, and return a `CommandOutcome`, which is written
and printed here.
"""

from collections.abc import Callable, Mapping, Sequence
import difflib
from functools import partial
import inspect
import os
from pathlib import Path
import shlex
from shutil import which
import sys
from types import MappingProxyType, SimpleNamespace
from typing import Any, NamedTuple, TYPE_CHECKING

from bellows_ros.errors import BellowsError, require_pictures
from bellows_ros.exits import EXIT_CODES, guarded, NOT_USABLE, OK, USER_ERROR
from bellows_ros.files.atomic import (
    Binary,
    Folder,
    Output,
    require_absent,
    require_outputs,
    STDOUT,
)
from bellows_ros.version import __version__
import click
from click.shell_completion import CompletionItem, shell_complete

if TYPE_CHECKING:
    from bellows_ros.files import File
    from bellows_ros.report.console import Console

WIDTH = 100
"""Largest width of help, characters."""

DEFAULTS: Mapping[str, Any] = {
    **dict.fromkeys(('json', 'plot', 'report', 'first', 'last', 'tool_link'), ''),
    **dict.fromkeys(('bags', 'params', 'overrides'), ()), 'force': False}
"""Values of options that some commands lack."""


class CommandOutcome(NamedTuple):
    """Result of a command, the function that prints the result, and the next steps."""

    show: Callable[['Console'], None]
    result: Any
    then: tuple[str, ...] = ()


class Commands(click.Group):
    """Commands in their order here; a wrong name is answered with the nearest one."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        """Return the commands in the order of their definition."""
        return [*self.commands]

    def resolve_command(self, ctx: click.Context, args: list[str]) -> Any:
        """Find a command."""
        if args and not args[0].startswith('-') and args[0] not in self.commands:
            near = difflib.get_close_matches(args[0], self.commands, n=1)
            known = f"Did you mean '{near[0]}'?" if near else (
                f'Expected: {", ".join(self.commands)}.')
            ctx.fail(f"'{args[0]}' is not a command. {known}")
        return super().resolve_command(ctx, args)


def help_of(text: str | None) -> str:
    """Return a docstring as help, with examples and lists as they are."""
    return inspect.cleandoc(text or '').replace('For example:', '\b\nFor example:')


@click.group(cls=Commands, context_settings={
    'help_option_names': ['-h', '--help'], 'max_content_width': WIDTH})
@click.version_option(__version__, message='bellows %(version)s')
def app() -> None:
    """
    Identify bellows suction cups, and predict the motion of the packages that they hold.

    For example:
      bellows identify bags/identification --params bags/package.yaml --out cup.yaml
      bellows replay bags/validation --params bags/package.yaml --params cup.yaml

    Angles are shown in degrees; in files and JSON they are in rad.
    """


app.help = '\n'.join([help_of(app.help), '\n\b\nexit codes:', *(
    f'  {code:<4} {meaning}' for code, meaning in EXIT_CODES.items())])


def parameter_names(
    context: click.Context, argument: click.Parameter, incomplete: str
) -> list[CompletionItem]:
    """Return the completions of --set."""
    from bellows_ros.core.parameters.table import PARAMETERS

    return [CompletionItem(f'{name}=', help=parameter.description)
            for name, parameter in PARAMETERS.items() if name.startswith(incomplete)]


def files(*names: str, metavar: str = 'FILE', **settings: Any) -> Any:
    """Return an option for an input file."""
    return click.option(*names, type=click.Path(path_type=Path), metavar=metavar, **settings)


def output(name: str, kind: type[Output] = Output, metavar: str = 'FILE', **settings: Any) -> Any:
    """Return an option for an output."""
    return click.option(
        name, type=click.Path(path_type=kind), metavar=metavar, default='', **settings)


def source(name: str, **settings: Any) -> Any:
    """Return a positional argument for input files."""
    return click.argument(name, type=click.Path(path_type=Path), metavar=settings.pop(
        'metavar', name.upper()), **settings)


def option(name: str, metavar: str, text: str, *names: str, **settings: Any) -> Any:
    """Return an option for a text."""
    return click.option(
        name, *names, metavar=metavar, help=text, **{'default': '', **settings})


SET = option('--set', 'NAME=VALUE', (
    "set one parameter, overriding the files; may be repeated. 'bellows parameters' lists all"),
    'overrides', default=(), multiple=True, shell_complete=parameter_names)
PARAMS = files('--params', multiple=True, help=(
    'parameter file (YAML, as for ROS nodes); may be repeated, later files override earlier ones'))
FROM = option('--from', 'S', 'leave out earlier data, in s from the start of the data', 'first')
TO = option('--to', 'S', 'leave out later data, in s from the start of the data', 'last')
JSON = output('--json', help="write all figures as JSON; '-' for stdout, with the rest on stderr")
PLOT = output('--plot', kind=Binary, help='picture (.png, .svg, .pdf), or animation (.gif)')
REPORT = output('--report', help='write a page with plots (HTML; extra plot)')
FORCE = click.option('--force', is_flag=True, help='replace an output that already exists')
PLAN_OPTIONS = (
    source('plan'), option('--topic', 'TOPIC', 'topic of the plan, if there are several'), FROM,
    TO, files('--urdf', help='URDF of the arm, for joints; default: that of the recording'),
    option('--tool-link', 'LINK', 'link of the arm at the tool tip E'), PARAMS, SET, JSON, PLOT,
    output('--out', kind=Folder, metavar='BAG', help='recording to write, with the package'),
    FORCE)


def command(
    *options: Any, name: str = ''
) -> Callable[[Callable[[Any, 'Console'], CommandOutcome]], click.Command]:
    """Register a function of options and console as a command of its name."""
    def register(work: Callable[[Any, 'Console'], CommandOutcome]) -> click.Command:
        def call(**given: Any) -> int:
            return run_command(work, SimpleNamespace(**{**DEFAULTS, **given}))

        call.__doc__ = help_of(work.__doc__)
        for option in reversed(options):
            call = option(call)
        return app.command(name or work.__name__)(call)

    return register


# ---------------------------------------------------------------------------------------- commands


@command(
    source('bag'), PARAMS, SET, FROM, TO, output('--write-params', help=(
        'write a parameter file for this recording, for bellows identify and the nodes')),
    FORCE, JSON)
def info(arguments: Any, console: 'Console') -> CommandOutcome:
    """
    List the topics of a recording, and guess which is the tool.

    Report rates, gaps and jitter, the tool and the package with the reasons, and the checks
    before a fit. BAG is a rosbag2 folder, or a .mcap or .db3 file.

    For example:
      bellows info bags/identification
      bellows info recording --write-params my_cell.yaml    then fill in the package
      bellows info recording --json - | jq .settings

    Read on: docs/recording.md
    """
    from bellows_ros.files.atomic import write_text
    from bellows_ros.report.printed import cell_file, print_info
    from bellows_ros.workflows.info import info

    require_absent(arguments.write_params, arguments.force)
    console.progress(f'reading {arguments.bag}')
    result = info(arguments.bag, read_settings(arguments))
    if arguments.write_params:
        write_text(arguments.write_params, cell_file(result))
    show = partial(print_info, result, file=arguments.write_params)
    if not arguments.write_params:
        return CommandOutcome(show, result)
    if missing := {'topics.tool_pose', 'topics.package_pose'} - result.settings.keys():
        words = ['bellows', *click.get_current_context().obj, '--force', '--set', 'NAME=VALUE']
        return CommandOutcome(show, result, (
            f'The file lacks {" and ".join(sorted(missing))}. Set them, and write the file again:',
            f'  {shlex.join(words)}'))
    cell = ' --out-cell cell.yaml' if 'recording.package_world' in result.settings else ''
    return CommandOutcome(show, result, (
        'Fill in the package there, then:',
        f'  bellows identify --params {shlex.quote(arguments.write_params)} --out cup.yaml{cell}'))


@command(
    source('bags', nargs=-1, metavar='[BAG]...'), PARAMS, SET, FROM, TO,
    output('--out', help='write the cup as a parameter file'),
    output('--out-cell', help=(
        'write cell and package with all estimates (world, marker, latency, centre of mass) as a '
        'parameter file')),
    JSON, PLOT, REPORT,
    click.option('--force', is_flag=True, help='also write the cup file of a refused cup'),
    option('--jobs', 'N', (
        'read and fit in N processes, -1 for one per core; unusable recordings are left out'),
        type=int, default=None),
    option('--dask', 'ADDRESS', (
        'read and fit on the workers of a Dask scheduler (extra dask), for example '
        'tcp://host:8786; the workers must see the recordings under the same paths')),
    click.option('--release', is_flag=True, help=(
        "identify release.* instead, from drops with a given cup; the valve is 'topics.valve'")))
def identify(arguments: Any, console: 'Console') -> CommandOutcome:
    """
    Identify a cup's stiffness K and damping P from recordings.

    The parameter file has the given quantities (the package, the cup's length, the topics) and
    the method. --release identifies, with a given cup, the release from recordings of drops.

    For example:
      bellows identify bags/identification --params bags/package.yaml --out cup.yaml
      bellows identify first second --params my_cell.yaml --set fit.structure=full
      bellows identify recordings/* --params my_cell.yaml --jobs -1 --out cup.yaml
      bellows identify recording --params my_cell.yaml --out cup.yaml --out-cell cell.yaml
      bellows identify drops --release --params bags/tossing.yaml --out release.yaml

    Exit code 1: the fit cannot be used.

    Read on: docs/tutorial.md, docs/choosing.md
    """
    if arguments.release:
        return _identify_release(arguments, console)
    from bellows_ros.core.geometry.jit import COMPILED, NOT_COMPILED
    from bellows_ros.report.text import print_identification
    from bellows_ros.workflows.identification import save
    from bellows_ros.workflows.identify import identify

    settings = read_settings(arguments, 'identifier', outputs={
        'out': 'output.parameters', 'out_cell': 'output.cell', 'json': 'output.json',
        'report': 'output.report'})
    if not COMPILED and settings.get('fit.method', 'output_error') == 'output_error':
        console.warn(
            f'Nothing is compiled, as {NOT_COMPILED}: the fit takes about 15 s for each second '
            'recorded. Consider fit.method: least_squares.')
    result = identify(
        settings, console.progress, arguments.jobs, arguments.dask, arguments.force)
    then = _next_steps(arguments, result)
    if not (result.succeeded or arguments.force and result.fit.usable):
        arguments.out = arguments.out_cell = ''
    save(result, arguments.out, '', arguments.force, arguments.out_cell)
    return CommandOutcome(partial(print_identification, result), result, then)


def _next_steps(arguments: Any, result: Any) -> tuple[str, ...]:
    """Return the status of the cup, and the next step, as sentences."""
    out, cell, check = arguments.out, arguments.out_cell, (
        'Next, check how well it predicts another recording:')
    if result.refusals:
        is_kept = (out or cell) and arguments.force and result.fit.usable
        return (f'This cup is refused; its file was {"" if is_kept else "not "}written.',)
    if not out:
        return ('The cup was not written to a file; give --out cup.yaml to keep it.',)
    if not cell:
        if not (lost := result.outside_cup_file):
            return check, _replay_of(*arguments.params, out)
        cell = f'{os.path.splitext(out)[0]}_cell.yaml'
        words = ['bellows', *click.get_current_context().obj, '--out-cell', cell]
        return (f'The cup file is right only with {", ".join(lost)} of this fit. Write both:',
                f'  {shlex.join(words)}', check, _replay_of(cell, out))
    topics = result.remappings
    return (
        check, f'{_replay_of(cell, out)} --observe {topics.get("package/measured", "/tf")}',
        'Then predict live:',
        f'  {"" if which("predictor") else "ros2 run bellows_ros "}predictor --ros-args'
        f' --params-file {shlex.quote(cell)} --params-file {shlex.quote(out)}'
        + ''.join(f' -r {name}:={topic}' for name, topic in topics.items()))


def _replay_of(*params: 'File') -> str:
    """Return the command that checks a cup on another recording."""
    return '  ' + shlex.join(['bellows', 'replay', 'BAG', *(
        word for file in params for word in ('--params', str(file)))])


def _identify_release(arguments: Any, console: 'Console') -> CommandOutcome:
    """Identify the valve and write."""
    if excluded := [f'--{name}' for name in ('report', 'jobs', 'dask', 'plot')
                    if getattr(arguments, name)]:
        raise BellowsError(
            f'--release cannot be combined with {", ".join(excluded)}. Leave it out.')
    from bellows_ros.files.parameter_files import write_parameters
    from bellows_ros.report.printed import print_release
    from bellows_ros.workflows.toss import identify_release

    result = identify_release(
        read_settings(arguments, 'identifier', console), console.progress)
    if arguments.out:
        write_parameters(arguments.out, result.fit.parameters())
    return CommandOutcome(partial(print_release, result), result)


@command(
    source('bag'), PARAMS, SET, FROM, TO, JSON, PLOT, REPORT,
    option('--observe', 'TOPIC', 'poses of the package that correct a second live prediction'),
    option('--limit', 'PERCENT', 'exit with 1 if the NRMSE of an axis that moves is above this',
           type=float, default=None))
def replay(arguments: Any, console: 'Console') -> CommandOutcome:
    """
    Predict a recording with a cup, and report the errors.

    The prediction uses the motion of the tool alone. The table has the error of the package on
    each axis, the part due to measurement noise, and the error of the live predictor. Use a
    recording that the cup was not identified from.

    For example:
      bellows replay bags/validation --params bags/cup.yaml
      bellows replay bags/validation --params bags/cup.yaml --report replay.html
      bellows replay bags/validation --params bags/cup.yaml --observe camera/box
      bellows replay second --params bags/cup.yaml --limit 5

    Exit code 1: an axis that moves is above --limit; without it, above 5 % and 3 times the noise.

    Read on: docs/tutorial.md, docs/with_a_camera.md
    """
    from dataclasses import replace

    from bellows_ros.report.text import print_replay
    from bellows_ros.workflows.replay import replay as predict

    result = predict(arguments.bag, read_settings(arguments, cup_for=console), console.progress,
                     arguments.observe)
    if arguments.limit is not None:
        result = replace(result, limit=arguments.limit / 100.0)
    return CommandOutcome(partial(print_replay, result), result)


@command(
    PARAMS, SET,
    files('--motion', required=True, help=(
        'motion of the tool, and the tracking (YAML); config/motion_example.yaml explains it')),
    files('--plan', metavar='PLAN', help=(
        'motion of the tool as a plan, see bellows plan; --motion then states the sensors alone')),
    output('--out', kind=Folder, metavar='BAG', required=True, help='recording to write'),
    FORCE, JSON)
def simulate(arguments: Any, console: 'Console') -> CommandOutcome:
    """
    Simulate a recording of a given cup.

    The package is held by a known cup while the tool moves. The recording is that of a robot
    driver and a tracking system, with noise, outliers and dropouts.

    For example:
      bellows simulate --params bags/cup.yaml --motion config/multisine.yaml --out recording
      bellows simulate --params bags/cup.yaml --motion bags/static.yaml --out heavy --force

    Read on: docs/recording.md
    """
    from bellows_ros.files.safe_yaml import load_names
    from bellows_ros.report.printed import print_simulation
    from bellows_ros.workflows.simulate import simulate_recording

    report = simulate_recording(
        read_settings(arguments, cup_for=console), load_names(arguments.motion), arguments.out,
        console.progress, arguments.force, arguments.plan or '')
    return CommandOutcome(partial(print_simulation, report), report)


@command(
    source('names', nargs=-1, metavar='[NAME]...'),
    click.option('--yaml', is_flag=True, help='print a parameter file to fill in'),
    output('--mjcf', help='write cup and package of --params as a model for MuJoCo (MJCF)'),
    PARAMS, SET, JSON)
def parameters(arguments: Any, console: 'Console') -> CommandOutcome:
    """
    List all parameters, or write a file to fill in.

    Or write a cup for MuJoCo. The parameters are those of the nodes identifier and predictor, and
    of --params and --set. A NAME is the beginning of the names to list.

    For example:
      bellows parameters fit cup
      bellows parameters --yaml > my_cell.yaml
      bellows parameters --params cup.yaml --mjcf cup.xml

    Read on: docs/reference/parameters.md
    """
    from dataclasses import asdict

    from bellows_ros.core.parameters.table import lookup, PARAMETERS
    from bellows_ros.report.printed import print_parameters, template

    if arguments.mjcf:
        return _mjcf(arguments, console)
    names = tuple(map(str, arguments.names))
    chosen = [p for p in PARAMETERS.values() if not names or p.name.startswith(names)]
    for prefix in names:
        if not any(p.name.startswith(prefix) for p in chosen):
            lookup(prefix)  # raises, and names the nearest
    if arguments.yaml:
        click.echo(template(chosen), nl=False)
    shown_here = [] if arguments.yaml or arguments.json else chosen
    return CommandOutcome(partial(print_parameters, shown_here), {
        p.name: {**asdict(p), 'constraint': p.constraint} for p in chosen})


def _mjcf(arguments: Any, console: 'Console') -> CommandOutcome:
    """Write the model for MuJoCo, and warn of the properties that it lacks."""
    from bellows_ros.core.parameters import checks, conversion
    from bellows_ros.files import atomic, mjcf

    settings = checks.resolve(read_settings(arguments, cup_for=console), checks.PACKAGE_PARAMETERS)
    text, lacking = mjcf.mjcf(conversion.cup_of(settings), conversion.package_of(settings),
                              conversion.gravity_of(settings))
    atomic.write_text(arguments.mjcf, text)
    if lacking:
        console.warn(f'The model lacks {", ".join(lacking)}.')
    return CommandOutcome(lambda out: None, {'file': arguments.mjcf, 'not_expressed': lacking})


@command(
    *PLAN_OPTIONS,
    click.option('--fastest', is_flag=True, help=(
        'find the shortest time with a safety factor, less two sigma, above safety.least; with '
        '--steer of a motion without swing')),
    click.option('--steer', type=click.Choice(['zv', 'zvd']), help=(
        'shape the motion so that the package does not swing: it takes longer; zvd is less '
        'sensitive to errors in cup and package than zv')),
    files('--limits', help=(
        'limits of the arm: their used parts are printed, and --steer slows down to meet them; '
        'config/limits_example.yaml explains them')))
def plan(arguments: Any, console: 'Console') -> CommandOutcome:
    """
    Predict the package during a planned motion of the tool.

    Report how firmly the cup holds, how far it bends, how long the package swings afterwards, and
    the uncertainty of all these. PLAN is a recording with a MultiDOFJointTrajectory, Path or
    JointTrajectory, with tool poses, joint states or transforms; a YAML file with such a message
    or with a motion for bellows simulate; or a TUM file.

    For example:
      bellows plan bags/transport.yaml --params bags/tossing.yaml --fastest
      bellows plan plan_bag --params bags/cup.yaml --json plan.json --plot plan.png --out predicted
      bellows plan moveit_bag --params bags/cup.yaml --urdf arm.urdf --tool-link tool0
      bellows plan bags/transport.yaml --params bags/tossing.yaml --steer zvd --out steered

    Exit code 1: the cup lets go, or --fastest finds no time that is safe.

    Read on: docs/before_it_moves.md
    """
    from bellows_ros.report.printed import print_plan
    from bellows_ros.workflows import plan as workflow

    values = read_settings(arguments, cup_for=console)
    console.progress('planning')
    more = {'urdf': str(arguments.urdf or ''), 'topic': arguments.topic,
            'limits': arguments.limits or '', 'seek_fastest': arguments.fastest}
    if arguments.steer:
        result = workflow.steer_plan(arguments.plan, values, arguments.steer, **more)
    else:
        result = workflow.plan(arguments.plan, values, **more)
    if arguments.out:
        workflow.write_prediction(
            arguments.out, result.source, result.result.tool, result.prediction.states,
            arguments.force)
    return CommandOutcome(partial(print_plan, result), result)


@command(
    *PLAN_OPTIONS,
    option('--release', 'T', 'when to switch the valve, in s from the beginning of the plan',
           type=float, default=None),
    option('--target', 'X Y', 'find the time of release for a landing here, m in the world',
           type=float, nargs=2, default=None))
def toss(arguments: Any, console: 'Console') -> CommandOutcome:
    """
    Predict where a tossed package lands, and how accurately.

    The valve is switched, the cup lets go, the package flies and lands. Report the uncertainty of
    the landing and the largest contribution to it; or find the time of release for a target.
    PLAN is a motion as for bellows plan.

    For example:
      bellows toss bags/throw.yaml --params bags/tossing.yaml --release 3.0
      bellows toss bags/throw.yaml --params bags/tossing.yaml --target 1.8 0.149 --plot toss.png

    Exit code 1: no release of the plan lands, or none at the target.

    Read on: docs/before_it_moves.md
    """
    from bellows_ros.report.printed import print_toss
    from bellows_ros.workflows.toss import toss_plan, write_toss

    result = toss_plan(
        arguments.plan, read_settings(arguments, cup_for=console), arguments.release,
        arguments.target, console.progress, str(arguments.urdf or ''), arguments.topic)
    if arguments.out:
        write_toss(arguments.out, result, arguments.force)
    return CommandOutcome(partial(print_toss, result), result)


@command(
    source('sources', nargs=-1, required=True, metavar='SOURCE...'),
    output('--out', kind=Folder, metavar='NAME', required=True, help='recording to write'),
    option('--topic', 'TOPIC', 'topic for each body, in the same order (default: /NAME/pose)',
           multiple=True, default=()),
    click.option('--storage', type=click.Choice(['mcap', 'sqlite3']), default='mcap',
                 help='storage of the recording'),
    FORCE, JSON)
def convert(arguments: Any, console: 'Console') -> CommandOutcome:
    """
    Make a recording from files of Motive or TUM.

    SOURCE is a Motive .csv, with a topic for each rigid body, or a TUM .tum or .txt.

    For example:
      bellows convert take.csv --out my_recording
      bellows convert tool.tum box.tum --topic /tool_arm/pose --topic /package/pose --out recorded

    Read on: docs/formats.md
    """
    from bellows_ros.report.printed import print_conversion
    from bellows_ros.workflows import convert as workflow

    console.progress('converting')
    done = workflow.convert(
        arguments.sources, arguments.out, arguments.topic, arguments.storage, arguments.force)
    return CommandOutcome(partial(print_conversion, done), done, (
        'Next, check the recording:', f'  bellows info {done.out} --write-params my_cell.yaml'))


# ------------------------------------------------------------------------------- running a command


def named_in(arguments: Any) -> list[Any]:
    """Return the values of a command line, also those in tuples."""
    return [item for value in vars(arguments).values()
            for item in (value if isinstance(value, tuple) else [value])]


def read_settings(
    arguments: Any, node: str | None = None, cup_for: 'Console | None' = None,
    outputs: Mapping[str, str] = MappingProxyType({}),
) -> dict[str, Any]:
    """
    Return the parameters of the files, overridden by the command line; check the outputs.

    Parameters
    ----------
    arguments : namespace
        Values of the command line.
    node : str, optional
        Node whose part of a file is used.
    cup_for : Console, optional
        Console that warns at the end if there is no cup.
    outputs : mapping of str to str
        Parameters that name outputs, by the options that replace the parameters.

    """
    from bellows_ros.workflows.settings import inputs_of, settings_of

    values = settings_of(arguments.params, arguments.overrides, {
        '--from': f'recording.start={arguments.first}', '--to': f'recording.end={arguments.last}',
        '--tool-link': f'tool_link={arguments.tool_link}'}, node)
    if arguments.bags:
        values['bags'] = tuple(map(str, arguments.bags))
    for option, name in outputs.items():
        values[name] = str(getattr(arguments, option) or values.get(name, ''))
        setattr(arguments, option, Output(values[name]))
    require_outputs([*named_in(arguments), *map(Path, inputs_of(values))], arguments.force)
    if cup_for and 'cup.stiffness' not in values:
        cup_for.final_warnings.append(
            'cup.stiffness is not set: using the cup of the thesis, (4.78, 4.79).')
    return values


def run_command(work: Callable[[Any, 'Console'], CommandOutcome], arguments: Any) -> int:
    """Check the outputs, work, write --json, print, name the written files; return the code."""
    from bellows_ros.core import configure_process

    configure_process()
    from bellows_ros.files import results
    from bellows_ros.report.console import Console

    require_outputs(named_in(arguments), arguments.force)
    if arguments.plot:
        from bellows_ros import plots

        plots.require_ending(arguments.plot)
    if arguments.report:
        require_pictures()
    console = Console()
    with console.asking(), console.progress:
        done = work(arguments, console)
        if arguments.plot:
            plots.write(arguments.plot, done.result)
        if arguments.report:
            from bellows_ros.report.build import write_page

            write_page(done.result, arguments.report, arguments.params)
        if arguments.json:
            results.write_json(arguments.json, results.of_command(
                done.result, arguments.params, console.asked))
    written = [value for key, value in sorted(
        vars(arguments).items(), key=lambda item: item[0] == 'out') if isinstance(value, Output)]
    if STDOUT in written:
        console.keep_stdout_free()
    done.show(console)
    for line in *(f'Wrote {file}.' for file in written if file not in ('', STDOUT)), *done.then:
        console.line(line)
    console.warn(*console.final_warnings)
    return OK if getattr(done.result, 'succeeded', True) else NOT_USABLE


def main(args: Sequence[str] | None = None) -> int:
    """
    Run the command line.

    Parameters
    ----------
    args : sequence of str, optional
        Command line; default: the arguments of this process.

    Returns
    -------
    int
        The exit code, of `EXIT_CODES`.

    """
    words = list(sys.argv[1:] if args is None else args)
    if instruction := os.environ.get('_BELLOWS_COMPLETE'):
        return shell_complete(app, {}, 'bellows', '_BELLOWS_COMPLETE', instruction)
    return guarded(partial(_run, words))


def _run(words: list[str]) -> int:
    """Run the named command, or print the help."""
    if not words:
        with click.Context(app, info_name='bellows') as context:
            click.echo(app.get_help(context), err=True)
        return USER_ERROR
    with app.make_context('bellows', list(words), obj=words) as context:
        return int(app.invoke(context))


if __name__ == '__main__':
    sys.exit(main())
