"""
Which messages of a recording have stamps that can be used.

They are judged as live ones are (`core.screening`), but with hindsight: where a clock was set
back, the stamps before and after overlap, and as few messages as possible are left out.
"""

from bellows_ros.core.arrays import Mask, Stamps
from bellows_ros.core.screening import LEAP_NS, LONGEST_GAP_NS, StampScreen
import numpy as np

REASONS = ('duplicate_stamp', 'backward_stamp', 'future_stamp')


def unusable_stamps(stamps_ns: Stamps, arrivals_ns: Stamps | None) -> dict[str, Mask]:
    """
    Return which messages have stamps that cannot be used, by reason.

    Parameters
    ----------
    stamps_ns : int array (N,)
        Header stamps in the order the messages came in, ns.
    arrivals_ns : int array (N,), optional
        When they came, ns, not decreasing; without them a stamp that lies ahead is known only by
        those behind it.

    Returns
    -------
    dict of str to bool array (N,)
        The messages left, those under no reason, have stamps that increase strictly.

    """
    unusable = {reason: np.zeros(len(stamps_ns), dtype=bool) for reason in REASONS}
    if _are_plain(stamps_ns, arrivals_ns):
        return unusable
    kept: list[Stamps] = []
    for part in _parts(stamps_ns, arrivals_ns, unusable):
        while len(part) and kept and stamps_ns[kept[-1][-1]] >= stamps_ns[part[0]]:
            before = kept.pop()
            ahead = stamps_ns[before] >= stamps_ns[part[0]]
            behind = stamps_ns[part] <= stamps_ns[before[-1]]
            if _is_rather_lost((ahead, before), (behind, part)):
                unusable['future_stamp'][before[ahead]] = True
                before = before[~ahead]
            else:
                unusable['backward_stamp'][part[behind]] = True
                part = part[~behind]
            if len(before):
                kept.append(before)
        if len(part):
            kept.append(part)
    unusable['backward_stamp'] &= ~_in_place(stamps_ns, unusable)
    return unusable


def _in_place(stamps_ns: Stamps, unusable: dict[str, Mask]) -> Mask:
    """Return which messages that seemed to be late lie between their neighbours after all."""
    bad = np.logical_or.reduce(list(unusable.values()))
    before = np.maximum.accumulate(np.where(bad, -1, stamps_ns))
    after = np.minimum.accumulate(np.where(bad, np.iinfo(np.int64).max, stamps_ns)[::-1])[::-1]
    found: Mask = unusable['backward_stamp'] & (before < stamps_ns) & (stamps_ns < after)
    stamps = stamps_ns[found]
    largest_before = np.maximum.accumulate(np.concatenate([[-1], stamps]))[:-1]
    found[found] = stamps > largest_before
    return found


def _is_rather_lost(one: tuple[Mask, Stamps], other: tuple[Mask, Stamps]) -> bool:
    """
    Return whether what overlaps is rather taken from one part than from the other.

    Where it costs both about as much, as after a clock was set back, the shorter part decides:
    that is the same for all topics of a recording, as chance is not.
    """
    costs = np.count_nonzero(one[0]), np.count_nonzero(other[0])
    if max(costs) > 2 * min(costs):
        return bool(costs[0] < costs[1])
    return len(one[1]) < len(other[1])


def _are_plain(stamps_ns: Stamps, arrivals_ns: Stamps | None) -> bool:
    """Return whether the screen would surely accept all stamps, so that none need be judged."""
    steps = np.diff(stamps_ns)
    if np.any(steps <= 0):
        return False
    if arrivals_ns is None or not len(steps):
        return True
    ages = arrivals_ns - stamps_ns
    leaps = np.maximum.accumulate(ages)[:-1] - ages[1:] > LEAP_NS
    unexplained = (steps > LONGEST_GAP_NS) & (2 * np.diff(arrivals_ns) < steps)
    return not np.any(leaps | unexplained)


def _parts(
    stamps_ns: Stamps, arrivals_ns: Stamps | None, unusable: dict[str, Mask]
) -> list[Stamps]:
    """Return the indices of the usable messages between the moments at which a clock was set."""
    screen = StampScreen()
    parts: list[list[int]] = [[]]
    arrivals = [None] * len(stamps_ns) if arrivals_ns is None else arrivals_ns.tolist()
    for i, (stamp_ns, arrival_ns) in enumerate(zip(stamps_ns.tolist(), arrivals, strict=True)):
        verdict = screen.judge_stamp(stamp_ns, arrival_ns)
        if verdict.refused:
            unusable[verdict.refused][i] = True
            continue
        if verdict.restart:
            parts.append([])
        parts[-1].append(i)
        screen.accept_stamp(stamp_ns, arrival_ns, verdict.restart)
    return [np.array(part, dtype=np.int64) for part in parts if part]
