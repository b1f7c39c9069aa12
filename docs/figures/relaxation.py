"""Draw stiffness and loss of rubber over frequency, beside the models fitted to a recording."""

from functools import cache
from pathlib import Path
import sys
from typing import Any

from bellows_ros.core.model.structure import RELAXATION_TIMES
from bellows_ros.plots.style import drawing, Theme
import numpy as np

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT))
from benchmarks.rubber import (  # noqa: E402, I100
    CUP,
    identified,
    multisine,
    recorded,
    stiffening,
    strengths,
    TIMES,
)

LOSS_FACTOR = 0.10


@cache
def fitted() -> dict[str, Any]:
    """Return fits of a recording without and with relaxation."""
    recording = recorded(LOSS_FACTOR, 1, multisine(1), 30.0)
    return {name: identified(recording, name) for name in ('off', 'auto')}


def frequencies(theme: Theme) -> Any:
    """Return the figure: stiffness against bending over the static one, and loss factor."""
    fits = fitted()
    f = np.geomspace(0.01, 10.0, 200)
    lines = [('rubber', theme.measured, 4.0, CUP.stiffness[3, 3], CUP.damping[3, 3],
              strengths(LOSS_FACTOR), TIMES)]
    for name, own, colour in (('without relaxation', fits['off'], theme.error),
                              ('two branches', fits['auto'], theme.predicted)):
        lines.append((name, colour, 1.4, own.stiffness[3, 3], own.damping[3, 3], own.relaxation,
                      RELAXATION_TIMES))
    with drawing(theme) as figures:
        figure = figures.Figure(figsize=(7.6, 2.8), layout='constrained')
        left, right = figure.subplots(1, 2)
        for name, colour, width, K, P, r, tau in lines:
            K_star = np.array([K * stiffening(r, tau, x) + 2j * np.pi * x * P for x in f])
            left.semilogx(f, K_star.real / CUP.stiffness[3, 3], color=colour, linewidth=width)
            right.semilogx(f, K_star.imag / K_star.real, color=colour, linewidth=width,
                           label=name)
        left.set_ylabel('stiffness over the static one')
        right.set_ylabel('loss factor')
        right.set_ylim(0.0, 0.3)
        right.legend(loc='upper left')
        for panel in (left, right):
            panel.set_xlabel('frequency (Hz)')
    return figure


FIGURES = {'relaxation.svg': frequencies}
