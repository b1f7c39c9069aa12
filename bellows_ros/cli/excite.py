"""Design a motion with the most information on a cup."""

import argparse
import math
from pathlib import Path

from bellows_ros.core.identification.result import MAX_RELATIVE_ERROR, parameter_units
from bellows_ros.files.safe_yaml import load
from bellows_ros.report.text import column, with_error
from bellows_ros.workflows.excite import DesignedMotion, excite, write_motion

from .console import Console
from .options import Outcome, read_settings


def run(arguments: argparse.Namespace, console: Console) -> Outcome:
    """Design a motion within the limits, and write it."""
    result = excite(
        read_settings(arguments, cup_for=console), load(arguments.limits), arguments.time,
        str(arguments.urdf or ''), arguments.beside, arguments.seed, console.progress,
        arguments.hold)
    write_motion(arguments.out, result, arguments.csv, arguments.urscript, arguments.force)
    return Outcome(result, inputs=(), draw=arguments.plot)


def print_result(result: DesignedMotion, console: Console) -> None:
    """Print the expected errors and the active limits."""
    motion, design, errors = result.design.motion, result.design, result.errors
    tilt = math.degrees(math.hypot(*motion.tilt))
    console.line(f'A motion of {motion.duration:g} s', 'bold')
    console.line(f'(up to {motion.highest_frequency:.3g} Hz; {result.structure.name}'
                 + (f'; at the end {motion.hold:g} s at a tilt of {tilt:.0f} degrees)'
                    if motion.hold else ')'), 'dim')
    parts = column([100.0 * error / abs(value) if value else 0.0
                    for value, error in zip(result.guess, errors, strict=True)])
    ratios = [column((others / errors).tolist()) for others in result.beside.values()]
    rows = [['entry', 'expected', '', *(Path(name).stem for name in result.beside)]]
    for label, unit, value, error, part, *beside in zip(
            result.structure.labels, parameter_units(result.structure), result.guess.tolist(),
            errors.tolist(), parts, *ratios, strict=True):
        std = error if error <= MAX_RELATIVE_ERROR * abs(value) or not value else math.inf
        rows.append([label, with_error(value, std, unit), f'{part} %' if value else '',
                     *(f'{ratio} times' for ratio in beside)])
    console.table(rows)
    if result.beside:
        console.paragraph(
            'The expected values are standard errors if the guess is right; the other columns '
            'are the errors of other motions, as multiples of these.')
    console.table([['limit', 'taken', 'share in limiting the motion']] + [
        [name, f'{100.0 * ratio:.1f} %', f'{100.0 * design.shares.get(name, 0.0):.0f} %']
        for name, ratio in design.ratios.items()])
    console.warn(*result.warnings)
