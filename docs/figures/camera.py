"""The picture of a prediction alone, a camera alone, and both, and the figures below it."""

from pathlib import Path
import tempfile

from bellows_ros.core.geometry.lie import exp_so3, rotation_to_quaternion
from bellows_ros.core.signals.residuals import AXES, DISPLAY_FACTORS, DISPLAY_UNITS
from bellows_ros.files.bag_writer import as_messages, write_bag
from bellows_ros.files.bags import read_streams
from bellows_ros.files.parameter_files import read_parameters
from bellows_ros.plots.style import drawing, THEMES, write_figure
from bellows_ros.workflows.replay import replay
import numpy as np

ROOT = Path(__file__).parents[2]
TOPICS = {'tool': '/tool_arm/pose', 'twist': '/tool_arm/twist', 'package': '/package/pose'}
NOISE = 2e-3, 1e-2
BESIDE = 0.01
"""How far (m) beside its middle the package is gripped, as nobody has said."""


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


def main() -> None:
    """Draw the picture and print the table."""
    parameters = read_parameters(ROOT / 'bags' / 'cup.yaml')
    parameters |= {**read_parameters(ROOT / 'bags' / 'package.yaml'),
                   'package.com': (BESIDE, 0.0, -0.03), 'payload.estimate': True}
    with tempfile.TemporaryDirectory() as folder:
        found = replay(filmed(Path(folder)), parameters, observe='/camera/box').observed
    colours = THEMES['light']
    shown = (colours.measured, colours.quiet, colours.predicted)
    with drawing(colours) as figures:
        figure = figures.Figure(figsize=(9.0, 5.0))
        for row, axis in enumerate((0, 4)):
            panel, factor = figure.add_subplot(2, 1, row + 1), DISPLAY_FACTORS[axis]
            for (name, estimate), colour in zip(found.estimates.items(), shown, strict=True):
                seconds = (estimate.stamps_ns - found.estimates['both'].stamps_ns[0]) * 1e-9
                panel.plot(seconds, factor * estimate.error[:, axis], color=colour, label=name)
            panel.set_ylabel(f'error of {AXES[axis]} ({DISPLAY_UNITS[axis]})')
            reach = 1.05 * factor * max(np.nanmax(np.abs(estimate.error[:, axis]))
                                        for estimate in found.estimates.values())
            panel.set_ylim(-reach, reach)
        figure.align_ylabels()
        figure.axes[0].legend(loc='lower right', bbox_to_anchor=(1.0, 1.0), ncols=3)
        figure.axes[1].set_xlabel('time (s)')
        write_figure(ROOT / 'docs' / 'images' / 'camera.png', figure)
    for name, estimate in found.estimates.items():
        position, rotation = (np.linalg.norm(part) for part in np.split(estimate.scores.rms, 2))
        print(f'| {name} | {1e3 * position:.3g} | {np.degrees(rotation):.3g} |')


if __name__ == '__main__':
    main()
