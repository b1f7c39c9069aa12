"""Log messages of the predictor about its input, from the counts of `LivePredictor`; no ROS."""

from collections.abc import Iterator

from ..core.live import LivePredictor, LONGEST_GAP_NS
from ..core.parameter_table import short

_REFUSED_POSES = {
    'nan': 'nan (a number in it is not finite)',
    'zero_quaternion': 'zero quaternion',
    'not_unit': 'quaternion not of unit length',
    'zero_stamp': 'no valid stamp',
    'duplicate_stamp': 'repeated stamp',
    'backward_stamp': 'backward stamp',
    'future_stamp': 'stamp in the future',
    'repeated_pose': 'the pose repeats although the tool moves (tracking lost?)',
    'jump': 'too far from the pose before (tracking lost, or two tools on one topic?)',
    'frame_id': "frame_id is not '{frame}'",
}
_REFUSED_TWISTS = {
    'twist_nan': 'nan (a number in it is not finite)',
    'twist_too_fast': 'faster than any arm',
    'twist_frame_id': 'frame_id has changed',
    'twist_misses_pose': 'does not match the motion from pose to pose',
    'twist_unpaired': 'no pose near its stamp',
}
_RESTARTS = {
    'gap': f'no usable pose arrived for more than {LONGEST_GAP_NS * 1e-9:g} s',
    'clock_set_back': 'the stamps went back (a clock was set, or a recording started again)',
    'clock_set_forward': 'the stamps jumped ahead of the elapsed time',
    'clock_jump': 'the clock of the simulation was set, or switched on or off',
    'frame_changed': "the tool's poses are now in another frame, '{frame}'",
    'moved': "the tool's poses jumped further than it can move",
    'failure': 'a callback failed, a fault of this node',
    'diverged': 'the prediction diverged, with its lip further away than any cup reaches; check '
                'cup.stiffness, cup.damping and the package',
}
NO_EQUILIBRIUM = (
    'Nothing is published: the cup cannot hold the package at rest in this tool pose. '
    'Check package.mass, package.com, cup.stiffness and their units, and that z of the tool '
    'points from the cup back into the arm.'
)


class InputReport:
    """Say at each call what `LivePredictor` has refused, missed and restarted since the last."""

    def __init__(self, live: LivePredictor) -> None:
        """Start to count from now."""
        self._live = live
        self._no_equilibrium_said = False
        self._remember()

    def _remember(self) -> None:
        """Keep the counts as they are now."""
        live = self._live
        self._refused, self._restarts = dict(live.refused), dict(live.restarts)
        self._predictions, self._estimated = live.predictions, live.twists_estimated

    def warnings(self, twists_exist: bool) -> list[str]:
        """Return one sentence for each thing that went wrong since the last call."""
        sentences = [*self._refusals(), *self._fresh_starts()]
        estimated = self._live.twists_estimated - self._estimated
        if twists_exist and estimated:
            sentences.append(
                f'{_many(estimated, "pose")} had no twist of the same stamp; it was estimated '
                'from the poses.'
            )
        return sentences

    def errors(self) -> list[str]:
        """Return what keeps the predictor from its work, once until it works again."""
        new = self._live.restarts['no_equilibrium'] > self._restarts['no_equilibrium']
        works = self._live.predictions > self._predictions
        said, self._no_equilibrium_said = self._no_equilibrium_said, new or (
            self._no_equilibrium_said and not works
        )
        return [NO_EQUILIBRIUM] if new and not said else []

    def take(self, twists_exist: bool) -> tuple[list[str], list[str]]:
        """Return the warnings and the errors since the last call."""
        sentences = self.warnings(twists_exist), self.errors()
        self._remember()
        return sentences

    def _refusals(self) -> Iterator[str]:
        """Yield how many poses and twists were refused, and why."""
        refused = self._live.refused
        alone = self._live.twists_estimated > self._estimated
        for thing, table in (('pose', _REFUSED_POSES), ('twist', _REFUSED_TWISTS)):
            for reason, words in table.items():
                count = refused[reason] - self._refused[reason]
                if count and (alone or reason != 'twist_unpaired'):  # else it was not needed
                    why = words.format(frame=short(self._live.frame_id))
                    yield f'{_many(count, thing)} refused: {why}.'

    def _fresh_starts(self) -> Iterator[str]:
        """Yield why the package was taken to be at rest again."""
        for reason, words in _RESTARTS.items():
            count = self._live.restarts[reason] - self._restarts[reason]
            if count:
                times = '' if count == 1 else f' {count} times'
                why = words.format(frame=short(self._live.frame_id))
                yield f'Started again from static equilibrium{times}: {why}.'


def summary(live: LivePredictor) -> str:
    """Return all counts in one sentence."""
    refused = {name: count for name, count in live.refused.items() if count}
    detail = ' ({})'.format(', '.join(f'{n} {name}' for name, n in refused.items()))
    return (
        f'{_many(live.poses_in, "pose")} and {_many(live.twists_in, "twist")} in, '
        f'{_many(live.predictions, "prediction")} out, {sum(refused.values())} refused'
        f'{detail if refused else ""}, {_many(live.twists_estimated, "twist")} estimated.'
    )


def _many(count: int, thing: str) -> str:
    """Return a count with its noun."""
    return f'{count} {thing}' if count == 1 else f'{count} {thing}s'
