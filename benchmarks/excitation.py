"""
What three kinds of motion tell of K and P, in the same time and under the same limits.

    python -m benchmarks.excitation

prints the table of docs/exciting.md: expected standard errors of the truth in percent, for random
waypoints, our multisine, and a motion designed by `bellows excite`.
"""

import argparse
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

from bellows_ros.core.excitation.arm_limits import ArmLimits, limits_from
from bellows_ros.core.excitation.fisher import motion_information, standard_errors, Tracking
from bellows_ros.core.excitation.motion_design import cups_near, design, everyday
from bellows_ros.core.geometry.arrays import Array
from bellows_ros.core.model.cup_package import Cup, cup_of, model_tuple, Package, package_of
from bellows_ros.core.model.structure import STRUCTURES
from bellows_ros.core.parameters.checks import PACKAGE_PARAMETERS, resolve
from bellows_ros.core.synthetic.motion import Motion
from bellows_ros.core.synthetic.recipe import read_recipe
from bellows_ros.files import safe_yaml
from bellows_ros.files.parameter_files import read_parameters
from bellows_ros.workflows.excite import tracking_from
import numpy as np

ROOT = Path(__file__).resolve().parents[1]
SECONDS = 20.0
STRUCTURE = STRUCTURES['axisymmetric']


def motions(
    limits: ArmLimits, cup: Cup, package: Package, tracking: Tracking
) -> Iterator[tuple[str, Motion]]:
    """Yield names and motions."""
    models = [model_tuple(each, package, 9.81) for each in cups_near(cup)]
    yield 'random waypoints', everyday(limits, models, None, SECONDS, 1)
    ours: Any = read_recipe(
        safe_yaml.load(ROOT / 'bags' / 'identification.yaml'), package.com).motion
    yield 'multisine', replace(ours, duration=SECONDS)
    found = design(
        cup, package, 9.81, None, STRUCTURE, limits, tracking, SECONDS, 0, lambda what, part: None)
    yield '`bellows excite`', found.motion


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.parse_args()
    given = read_parameters(ROOT / 'bags' / 'cup.yaml')
    values: dict[str, Any] = resolve(given, PACKAGE_PARAMETERS)
    limits, block = limits_from(safe_yaml.load(ROOT / 'config' / 'limits_example.yaml'), 1.5)
    tracking, cup, package = tracking_from(block), cup_of(values), package_of(values)
    truth: Array = STRUCTURE.parameters(cup.stiffness, cup.damping)
    print('| motion | ' + ' | '.join(STRUCTURE.labels) + ' | condition number |')
    print('|---' * (len(truth) + 2) + '|')
    for name, motion in motions(limits, cup, package, tracking):
        M = motion_information(
            cup, package, 9.81, motion.at_rate(1.0 / tracking.package_period), tracking, STRUCTURE)
        errors = 100.0 * standard_errors(M) / truth
        condition = np.linalg.cond(M * np.outer(truth, truth))
        print(f'| {name} | ' + ' | '.join(f'{e:.2g}' for e in errors) + f' | {condition:.2g} |',
              flush=True)


if __name__ == '__main__':
    main()
