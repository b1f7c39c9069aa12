"""What to say about a parameter's name that nobody knows: the name that was meant, or a choice."""

from collections.abc import Collection, Iterable
from difflib import SequenceMatcher
from operator import itemgetter
from types import MappingProxyType

LIKELY = 0.6
"""A name less alike than this is not what was meant."""

LIKELY_BESIDE = 0.5
"""The same among the names of the same group."""

LIKELY_WORD = 0.8
"""The same for other words."""

ELSEWHERE = 0.9
"""Factor on the likeness of names in different groups whose last parts alone are alike."""

OTHER_WORDS = MappingProxyType(
    {
        'weight': 'package.mass',
        'payload': 'package.mass',
        'center_of_mass': 'package.com',
        'centre_of_mass': 'package.com',
        'spring': 'cup.stiffness',
        'nominal_length': 'cup.length',
    }
)
"""What else people call some of the parameters."""


def hint(name: str, known: Collection[str]) -> str:
    """
    Return a sentence that helps to find the right name.

    Parameters
    ----------
    name : str
        Dotted name that nobody knows.
    known : collection of str
        The names to choose from, the likelier first where two are equally alike.

    """
    group, leaf = _split(name)
    beside = [other for other in known if group and _split(other)[0] == group]
    inside = [other for other in known if other.startswith(f'{name}.')]
    words = ((_ratio(leaf, w), other) for w, other in OTHER_WORDS.items() if other in known)
    nearest = _best(words, LIKELY_WORD) or _best(
        ((_ratio(leaf, _split(other)[1]), other) for other in beside), LIKELY_BESIDE)
    if not (nearest or inside):
        nearest = _best(((_likeness(name, other), other) for other in known), LIKELY)
    if nearest:
        return f"Did you mean '{nearest}'?"
    near = inside or beside
    return f'Known {"there " if near else ""}are: {", ".join(near or known)}.'


def _likeness(name: str, other: str) -> float:
    """Return how alike two names are, 0 to 1, as a whole or in their last parts."""
    leaves = _ratio(_split(name)[1], _split(other)[1])
    same_group = _split(name)[0] == _split(other)[0]
    return leaves if same_group else max(ELSEWHERE * leaves, _ratio(name, other))


def _ratio(a: str, b: str) -> float:
    """Return how alike two texts are, 0 to 1."""
    return SequenceMatcher(None, a[:80], b).ratio()


def _split(name: str) -> tuple[str, str]:
    """Return the group and the last part of a dotted name."""
    group, _, leaf = name.rpartition('.')
    return group, leaf


def _best(scored: Iterable[tuple[float, str]], least: float) -> str:
    """Return the first name with the highest score, '' where none has at least so much."""
    score, name = max(scored, key=itemgetter(0), default=(0.0, ''))
    return name if score >= least else ''
