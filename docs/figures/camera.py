"""Draw the errors of prediction, camera and both; as a program, print their table."""

from functools import cache
from pathlib import Path
import tempfile
from typing import Any

from bellows_ros.core.geometry.lie import exp_so3, rotation_to_quaternion
from bellows_ros.core.signals.residuals import AXES, DISPLAY_FACTORS, DISPLAY_UNITS
from bellows_ros.files.bag_writer import as_messages, write_bag
from bellows_ros.files.bags import read_streams
from bellows_ros.files.parameter_files import read_parameters
from bellows_ros.plots.style import BELOW_HEAD, picture, Theme, THEMES
from bellows_ros.workflows.replay import replay
import numpy as np

ROOT = Path(__file__).parents[2]
TOPICS = {'tool': '/tool_arm/pose', 'twist': '/tool_arm/twist', 'package': '/package/pose'}
NOISE = 2e-3, 1e-2
NOTE = 'camera alone: its newest pose, held; its spikes are outliers of the recording'
BESIDE = 0.01
"""Distance of the grip from the middle of the package, m."""
CALIBRATED = (0.7e-3, 1.4e-3)
"""Standard deviations of a calibrated camera and of a measured marker, m and rad."""


def filmed(folder: Path) -> Path:
    """Write the shipped validation with a camera of 30 Hz, and return where it is."""
    streams = read_streams(ROOT / 'bags' / 'validation', TOPICS)
    package, twist = streams['package'], streams['twist']
    which, rng = np.arange(12, len(package.stamps_ns), 12), np.random.default_rng(1)
    turns = np.array([exp_so3(turn) for turn in rng.normal(size=(len(which), 3)) * NOISE[1]])
    seen = (package.position[which] + rng.normal(size=(len(which), 3)) * NOISE[0],
            package.rotation[which] @ turns)
    poses = {
        TOPICS[role]: (streams[role].stamps_ns, streams[role].position, streams[role].rotation)
        for role in ('tool', 'package')}
    poses['/camera/box'] = (package.stamps_ns[which], *seen)
    write_bag(folder / 'bag', [
        *(as_messages(topic, 'geometry_msgs/msg/PoseStamped', stamps, np.hstack(
            [position, rotation_to_quaternion(rotation)]))
          for topic, (stamps, position, rotation) in poses.items()),
        as_messages(TOPICS['twist'], 'geometry_msgs/msg/TwistStamped', twist.stamps_ns,
                    np.hstack([twist.linear, twist.angular]))])
    return folder / 'bag'


@cache
def estimates(is_stated: bool = True) -> Any:
    """Return the poses by the camera, by the prediction, and by both."""
    parameters = read_parameters(ROOT / 'bags' / 'cup.yaml')
    parameters |= {**read_parameters(ROOT / 'bags' / 'package.yaml'),
                   'package.com': (BESIDE, 0.0, -0.03), 'payload.estimate': True}
    if is_stated:
        parameters |= {
            'package.com_std': (BESIDE,) * 3, 'measured.camera_std': CALIBRATED,
            'measured.marker_std': CALIBRATED,
            **{f'cup.{name}_std': [0.01 * each for each in parameters[f'cup.{name}']]
               for name in ('stiffness', 'damping')}}
    with tempfile.TemporaryDirectory() as folder:
        return replay(filmed(Path(folder)), parameters, observe='/camera/box').observed.estimates


def errors(theme: Theme) -> Any:
    """Return the figure: errors of x and of ry over time."""
    found = estimates()
    shown = (theme.measured, theme.quiet, theme.predicted)
    name = 'light' if theme is THEMES['light'] else 'dark'
    with picture('Error of the package, relative to the tool', NOTE, name, (9.0, 5.2)) as (
            figure, _):
        panels = figure.subplots(2, 1, sharex=True, gridspec_kw={**BELOW_HEAD, 'top': 0.81})
        for panel, axis in zip(panels, (0, 4), strict=True):
            factor = DISPLAY_FACTORS[axis]
            for (label, estimate), colour in zip(found.items(), shown, strict=True):
                seconds = (estimate.stamps_ns - found['both'].stamps_ns[0]) * 1e-9
                panel.plot(seconds, factor * estimate.error[:, axis], color=colour, label=label)
            panel.set_ylabel(f'{AXES[axis]} ({DISPLAY_UNITS[axis]})')
            panel.margins(x=0.0)
        figure.align_ylabels()
        panels[0].legend(loc='lower right', bbox_to_anchor=(1.0, 1.0), ncols=3)
        panels[1].set_xlabel('time (s)')
    return figure


def main() -> None:
    """Print the table."""
    by_default = {'both, by default': estimates(False)['both']}
    for name, estimate in {**estimates(), **by_default}.items():
        position, rotation = (np.linalg.norm(part) for part in np.split(estimate.scores.rms, 2))
        print(f'| {name} | {1e3 * position:.3g} | {np.degrees(rotation):.3g} |')


FIGURES = {'camera.png': errors}

if __name__ == '__main__':
    main()
