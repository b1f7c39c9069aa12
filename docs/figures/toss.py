"""Print the error of a landing with the cup ignored, and with an identified cup."""

from pathlib import Path

from bellows_ros.core.model.cup_package import Cup, model_tuple
from bellows_ros.core.parameters.checks import resolve
from bellows_ros.core.parameters.conversion import cup_of, grip_of, package_of, release_of
from bellows_ros.core.toss.release import HeldMotion, landing_error, toss
from bellows_ros.errors import BellowsError
from bellows_ros.files.parameter_files import read_parameters
from bellows_ros.workflows.plan import read_plan
import numpy as np

ROOT = Path(__file__).parents[2]
PLAN = ROOT / 'bags' / 'throw.yaml'
TIMES = np.arange(2.7, 3.25, 0.025)


def main() -> None:
    """Print the table."""
    values = resolve(read_parameters(ROOT / 'bags' / 'tossing.yaml'))
    cup, package, release = cup_of(values), package_of(values), release_of(values)
    tool, grip = read_plan(PLAN, values).tool, grip_of(values)
    soft = np.diag([1.0, 1.0, 1.0, 1e-3, 1e-3, 1.0])
    better = np.diag([1.004] * 6)
    models = {
        'cup ignored (rigid)': Cup(300.0 * cup.stiffness, 20.0 * cup.damping, cup.length),
        'rigid pendulum': Cup(soft @ cup.stiffness, soft @ cup.damping, cup.length),
        'ours, as identified': Cup(better @ cup.stiffness, 1.02 * cup.damping, cup.length),
    }
    truth = HeldMotion(model_tuple(cup, package, 9.81), grip, tool)
    for name, other in models.items():
        held = HeldMotion(model_tuple(other, package, 9.81), grip, tool)
        off, failed = [], 0
        for time in TIMES:
            try:
                found = toss(held, release, time)
            except BellowsError:
                failed += 1
                continue
            off.append(np.concatenate(landing_error(
                found.landing, toss(truth, release, time).landing, truth.model[2])))
        metres = 1e3 * np.linalg.norm(np.array(off)[:, :3], axis=1)
        turned = np.degrees(np.linalg.norm(np.array(off)[:, 3:], axis=1))
        print(f'| {name} | {np.median(metres):.3g} | {metres.max():.3g} | '
              f'{np.median(turned):.3g} | {turned.max():.3g} |')


if __name__ == '__main__':
    main()
