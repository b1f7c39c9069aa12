"""One picture for each kind of result, as `result.plot()` and the commands draw it."""

from collections.abc import Callable, Mapping
from typing import Any

from bellows_ros.plots.plan import excite_figure, plan_figure, steer_figure, toss_figure
from bellows_ros.plots.prediction import prediction_figure
from bellows_ros.workflows.excite import DesignedMotion
from bellows_ros.workflows.plan import PlanReport
from bellows_ros.workflows.replay import Replay
from bellows_ros.workflows.result import CommandResult
from bellows_ros.workflows.steer import SteerReport
from bellows_ros.workflows.toss import TossResult

FIGURES: Mapping[type, Callable[[Any, str], Any]] = {
    PlanReport: lambda found, theme: plan_figure(found, found.source.path, theme),
    SteerReport: lambda found, theme: steer_figure(found.motions, found.source.path, theme),
    TossResult: lambda found, theme: toss_figure(found, f'Toss of {found.source.path}', theme),
    DesignedMotion: lambda found, theme: excite_figure(
        found.design, f'{found.design.motion.duration:g} s', theme),
    Replay: lambda found, theme: prediction_figure(
        found.recording.since_start(found.validation.stamps_ns), found.validation,
        'Measured and simulated', f'{found.bag}, relative to the tool', theme),
}


def figure_of(found: CommandResult, theme: str = 'light') -> Any:
    """Return the matplotlib Figure of a result."""
    return FIGURES[type(found)](found, theme)
