"""Log messages of the predictor about its input, from the counts of `LivePredictor`; no ROS."""

from collections import Counter

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
    """
    Report what `LivePredictor` refused, missed and restarted since the last call.

    Attributes
    ----------
    restarts : Counter
        Why and how often the package was taken to be at rest, between the last two calls.
    poses, alone : int
        Poses that came between these, and those of them without a twist.

    """

    def __init__(self, live: LivePredictor) -> None:
        """Start counting now."""
        self._live = live
        self._no_equilibrium_said = False
        self._before = _counts(live)

    def take(self, twists_exist: bool) -> tuple[list[str], list[str]]:
        """
        Return a sentence for each thing that went wrong since the last call, and errors.

        An error keeps the predictor from its work; it is said once until that works again.
        """
        now = _counts(self._live)
        refused, self.restarts, done = (
            new - old for new, old in zip(now, self._before, strict=True))
        self._before = now
        self.poses, self.alone = done['poses'], done['estimated']
        frame = short(self._live.frame_id)
        warnings = []
        for thing, table in (('pose', _REFUSED_POSES), ('twist', _REFUSED_TWISTS)):
            for reason, words in table.items():
                count = refused[reason]
                if count and (self.alone or reason != 'twist_unpaired'):  # else it was not needed
                    why = words.format(frame=frame)
                    warnings.append(f'{_many(count, thing)} refused: {why}.')
        for reason, words in _RESTARTS.items():
            if count := self.restarts[reason]:
                times = '' if count == 1 else f' {count} times'
                why = words.format(frame=frame)
                warnings.append(f'Started again from static equilibrium{times}: {why}.')
        if twists_exist and self.alone:
            warnings.append(
                f'{_many(self.alone, "pose")} had no twist of the same stamp; it was estimated '
                'from the poses.')
        stuck = self.restarts['no_equilibrium'] > 0
        errors = [NO_EQUILIBRIUM] if stuck and not self._no_equilibrium_said else []
        self._no_equilibrium_said = stuck or (
            self._no_equilibrium_said and not done['predictions'])
        return warnings, errors


def _counts(live: LivePredictor) -> tuple[Counter[str], Counter[str], Counter[str]]:
    """Return what was refused, fresh starts, and what came and went, all since the start."""
    done = Counter(
        poses=live.poses_in, estimated=live.twists_estimated, predictions=live.predictions)
    return Counter(live.refused), Counter(live.restarts), done


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
