"""
A replay in Rerun's viewer (extra `view`): tool, cup and package in space, and their time series.

Rerun has a timeline for it to be played, and every quantity under a path:

    world/tool, world/cup, world/predicted, world/measured    poses, in m
    package/AXIS/predicted, package/AXIS/measured             B in the tool, mm and degrees
    error/AXIS, deflection/AXIS                               mm and degrees

The deflection is that of the predicted lip from where it is without load.
"""

from pathlib import Path
import subprocess
import sys
from tempfile import TemporaryDirectory
from typing import Any

from bellows_ros.core.geometry.arrays import Stamps
from bellows_ros.core.geometry.lie import rotation_to_quaternion
from bellows_ros.core.signals.residuals import AXES, DISPLAY_FACTORS, DISPLAY_UNITS
from bellows_ros.errors import BellowsError, install
from bellows_ros.files import File
from bellows_ros.files.atomic import write_bytes
from bellows_ros.workflows.plot import Replayed
import numpy as np

from .animation import bellows_rings, RINGS, SIDES
from .style import THEMES

NO_RERUN = (
    f'The viewer Rerun is not installed. Install it: {install("view")}. Or use '
    "'bellows plot animation'.")
ENDING = '.rrd'
TIMELINE = 'time'
CUPS_PER_SECOND = 60.0
ARM, AXES_LENGTH = 0.10, 0.04  # m, of what is drawn
EYE = np.array([0.5, -1.0, 0.35])  # from the centre of the scene, in parts of its size
COLOURS = THEMES['dark']
XYZ_COLOURS = ((232, 88, 88), (86, 190, 96), (92, 138, 255))


def write_view(path: File, replayed: Replayed, note: str) -> None:
    """
    Write a replay as a recording of Rerun, whole or not at all.

    Parameters
    ----------
    path : path
        Ends in .rrd.
    replayed : Replayed
        What is shown.
    note : str
        Which recording and cup.

    Raises
    ------
    BellowsError
        If the ending is another, or Rerun is missing.

    """
    rr = require_viewer(path)
    # A recording with a name, without settings of the whole process.
    recording = rr.RecordingStream('bellows_ros', send_properties=True)
    recording.send_recording_name(note)
    try:
        stream = recording.binary_stream()
        _fill(rr, recording, replayed)
        data = stream.read(flush=True)
    finally:
        recording.disconnect()
    write_bytes(path, data)


def open_view(replayed: Replayed, note: str) -> None:
    """
    Show a replay in a window of Rerun, until it is closed.

    Parameters
    ----------
    replayed : Replayed
        What is shown.
    note : str
        Which recording and cup.

    Raises
    ------
    BellowsError
        If Rerun is missing, or ends with an error, as it does without a display.

    """
    with TemporaryDirectory() as folder:
        path = Path(folder, f'view{ENDING}')
        write_view(path, replayed, note)
        done = subprocess.run([sys.executable, '-m', 'rerun', '--hide-welcome-screen', str(path)])
    if done.returncode != 0:
        raise BellowsError(
            f'The viewer Rerun exited with {done.returncode}, with the reason above. Without a '
            'display, write a file with --view replay.rrd, and open it elsewhere: '
            "'rerun replay.rrd'.")


def require_viewer(path: File = '') -> Any:
    """Return Rerun's module, with its blueprints; refuse its absence and another ending."""
    if path and Path(path).suffix.lower() != ENDING:
        raise BellowsError(f"View '{path}' must end in {ENDING}.")
    try:
        import rerun
        import rerun.blueprint
    except ImportError:
        raise BellowsError(NO_RERUN) from None
    return rerun


def _fill(rr: Any, recording: Any, replayed: Replayed) -> None:
    """Send all that is shown."""
    recording.send_blueprint(_blueprint(rr, replayed))
    recording.log('world', rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    times = [rr.TimeColumn(TIMELINE, duration=replayed.seconds)]
    for name, body in (('tool', replayed.tool), ('predicted', replayed.package),
                       ('measured', replayed.outline)):
        recording.send_columns(f'world/{name}', times, rr.Transform3D.columns(
            translation=body.position, quaternion=rotation_to_quaternion(body.rotation)))
    _send_bodies(rr, recording, replayed)
    _send_cup(rr, recording, replayed)
    _send_series(rr, recording, replayed, times)


def _send_bodies(rr: Any, recording: Any, replayed: Replayed) -> None:
    """Send what is fixed to the moving frames: the arm, axes, boxes."""
    axes = rr.Arrows3D(vectors=AXES_LENGTH * np.eye(3), radii=0.001, colors=XYZ_COLOURS)
    arm = rr.LineStrips3D(
        [[[0.0, 0.0, 0.0], [0.0, 0.0, ARM]]], radii=0.005, colors=[_rgb(COLOURS.quiet)])
    solid, outline = (
        rr.Boxes3D(half_sizes=[0.5 * replayed.box], fill_mode=mode, radii=0.001,
                   colors=[_rgb(colour)])
        for mode, colour in (('solid', COLOURS.predicted), ('majorwireframe', COLOURS.error)))
    for name, body in (('tool/axes', axes), ('predicted/axes', axes), ('tool/arm', arm),
                       ('predicted/box', solid), ('measured/box', outline)):
        recording.log(f'world/{name}', body, static=True)


def _send_cup(rr: Any, recording: Any, replayed: Replayed) -> None:
    """Send the cup between tool and predicted package, `CUPS_PER_SECOND`."""
    step = max(1, round(1.0 / (CUPS_PER_SECOND * float(np.median(np.diff(replayed.seconds))))))
    shown = np.arange(0, len(replayed.seconds), step)
    tool, package = replayed.tool, replayed.package
    lip = package.position - package.rotation @ replayed.com
    rings = np.array([
        bellows_rings(tool.position[i], tool.rotation[i], lip[i], package.rotation[i])
        for i in shown])
    outward = rings - rings[:, :, :-1].mean(axis=2, keepdims=True)
    outward /= np.linalg.norm(outward, axis=-1, keepdims=True)
    count = RINGS * SIDES
    recording.log('world/cup', rr.Mesh3D.from_fields(
        triangle_indices=_triangles(), albedo_factor=_rgb(COLOURS.measured)), static=True)
    recording.send_columns(
        'world/cup', [rr.TimeColumn(TIMELINE, duration=replayed.seconds[shown])],
        rr.Mesh3D.columns(
            vertex_positions=rings.reshape(-1, 3), vertex_normals=outward.reshape(-1, 3),
        ).partition([count] * len(shown)))


def _triangles() -> Stamps:
    """Return the corners (T, 3) of the triangles between the rings."""
    ring, side = (x.ravel() for x in np.mgrid[:RINGS - 1, :SIDES - 1])
    a = ring * SIDES + side
    return np.concatenate([
        np.column_stack([a, a + 1, a + SIDES]), np.column_stack([a + 1, a + SIDES + 1, a + SIDES]),
    ])


def _send_series(rr: Any, recording: Any, replayed: Replayed, times: list[Any]) -> None:
    """Send the time series, in mm and degrees."""
    live = replayed.live
    for axis, name in enumerate(AXES):
        for path, label, colour, width, values in (
            (f'package/{name}/measured', 'measured', _rgb(COLOURS.measured), 3.0, live.measured),
            (f'package/{name}/predicted', 'predicted', _rgb(COLOURS.predicted), 1.2,
             live.predicted),
            (f'error/{name}', name, XYZ_COLOURS[axis % 3], 1.0, live.predicted - live.measured),
            (f'deflection/{name}', name, XYZ_COLOURS[axis % 3], 1.2, replayed.deflection),
        ):
            recording.log(path, rr.SeriesLines(
                names=[f'{label} ({DISPLAY_UNITS[axis]})'], widths=[width], colors=[colour]),
                static=True)
            recording.send_columns(
                path, times, rr.Scalars.columns(scalars=DISPLAY_FACTORS[axis] * values[:, axis]))


def _blueprint(rr: Any, replayed: Replayed) -> Any:
    """Return the layout of the viewer: space on the left, series on the right."""
    rrb = rr.blueprint
    bodies = np.vstack([replayed.tool.position, replayed.package.position])
    low, high = bodies.min(axis=0), bodies.max(axis=0)
    centre, reach = 0.5 * (low + high), float(np.max(high - low)) + 2.0 * np.max(replayed.box)
    eye = rrb.EyeControls3D(
        position=centre + reach * EYE, look_target=centre, eye_up=(0.0, 0.0, 1.0))
    axes = [rrb.TimeSeriesView(origin=f'package/{name}', name=f'{name} of B in the tool')
            for name in AXES]
    tabs = [rrb.Grid(*axes, grid_columns=2, name='Package in the tool')]
    for what, words in (('deflection', 'Deflection of the cup'),
                        ('error', 'Predicted minus measured')):
        tabs.append(rrb.Vertical(*(
            rrb.TimeSeriesView(origin='/', name=f'{words} ({unit})',
                               contents=[f'{what}/{name}' for name in names])
            for unit, names in (('mm', AXES[:3]), ('deg', AXES[3:]))), name=words))
    return rrb.Blueprint(
        rrb.Horizontal(
            rrb.Spatial3DView(origin='world', name='Tool, cup, package', eye_controls=eye),
            rrb.Tabs(*tabs), column_shares=[2, 3]),
        rrb.BlueprintPanel(state='collapsed'), rrb.SelectionPanel(state='collapsed'),
        rrb.TimePanel(state='collapsed', timeline=TIMELINE, play_state='playing', loop_mode='all'))


def _rgb(colour: str) -> tuple[int, ...]:
    """Return red, green and blue of '#rrggbb'."""
    return tuple(bytes.fromhex(colour.lstrip('#')))
