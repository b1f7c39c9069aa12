"""What an identification has found beside the cup, in sentences."""

from typing import TYPE_CHECKING

from bellows_ros.core.identification.judgement.validation import LIMIT
from bellows_ros.core.identification.result import Fit
from bellows_ros.core.recording.preparation import TimeOffset
from bellows_ros.core.score import AXES
from bellows_ros.workflows.recordings import offset_sentence
from bellows_ros.workflows.static import AtRest
from bellows_ros.workflows.validate import Validated
import numpy as np

if TYPE_CHECKING:
    from bellows_ros.workflows.identify import Identification

NARROWED = 0.95
"""A standard error above this part of what it was is not worth a word."""

SHOWN = 6
"""Parameters that a sentence names."""


def findings(result: 'Identification') -> tuple[str, ...]:
    """Return what was asked for: of standstills, recordings, structures and validation."""
    offsets = map(TimeOffset, result.fit.delays, result.fit.delays_std)
    lines = [
        sentence for bag, offset in zip(result.values['bags'], offsets, strict=False)
        for sentence in offset_sentence(bag, offset)
    ]  # fmt: skip
    if result.at_rest is not None and result.fit.rest is not None:
        lines += rest_sentences(result.fit, result.at_rest, bool(result.values['static.length']))
    if result.spring is not None:
        lines.append(result.spring.sentence)
    if result.consistency is not None and not result.consistency.differs:
        lines.append(result.consistency.verdict)
    if result.ladder is not None:
        lines += result.ladder.advice
    for validated in result.validations:
        lines += [*offset_sentence(validated.bag, validated.time_offset),
                  validation_sentence(validated)]
    return tuple(lines)


def rest_sentences(fit: Fit, at_rest: AtRest, length_used: bool) -> list[str]:
    """Return what standstills have added to a fit, and the nominal length that they tell."""
    if fit.rest is None:
        return []
    lines = [
        f'{fit.rest.holds} standstills count in the fit (chi^2 per degree of freedom '
        f'{fit.rest.chi2:.2g}): {_narrowed(fit)}.'
    ]
    if at_rest.length is not None:
        lines.append(
            f'Nominal length by the loads alone: {1e3 * at_rest.length.length:.3f} ± '
            f'{1e3 * at_rest.length.length_std:.3f} mm.'
        )
    if length_used:
        lines.append(
            f'Nominal length with the fit: {1e3 * fit.rest.length:.3f} ± '
            f'{1e3 * fit.rest.length_std:.3f} mm.'
        )
    return lines


def _narrowed(fit: Fit) -> str:
    """Return which standard errors standstills have made smaller, the most first."""
    ratios = fit.rest.narrowed if fit.rest else np.ones(len(fit.labels))
    order = [i for i in np.argsort(ratios, kind='stable').tolist() if ratios[i] < NARROWED]
    if not order:
        return 'they change no standard error'
    parts = [
        f'of {fit.labels[i]} {100.0 * ratios[i]:.0f} %' if ratios[i] > 0.0
        else f'{fit.labels[i]} from them alone' for i in order[:SHOWN]
    ]  # fmt: skip
    more = f' and {len(order) - SHOWN} more' if len(order) > SHOWN else ''
    return f'standard errors with over without them: {", ".join(parts)}{more}'


def validation_sentence(validated: Validated) -> str:
    """Return what a recording that the fit has not seen says of the cup."""
    found = validated.validation
    moving = [
        f'{name} {100.0 * ratio:.2f} %'
        for name, moves, ratio in zip(AXES, found.moves, found.scores.nrmse, strict=True) if moves
    ]  # fmt: skip
    if not moving:
        return f'{validated.bag}: no axis moves enough to validate on.'
    failing = found.failing()
    limit = f'{100.0 * LIMIT:g} %'
    verdict = f'above {limit}: {", ".join(failing)}' if failing else f'all within {limit}'
    return f'Validated on {validated.bag}, error over motion: {", ".join(moving)}; {verdict}.'
