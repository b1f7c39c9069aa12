"""Several cups in one parameter file, of which `cup.name` chooses one."""

from collections.abc import Iterable, Mapping
import difflib
from typing import Any

from bellows_ros.core.parameters import NAMED_CUP
from bellows_ros.errors import BellowsError


def cup_names(names: Iterable[str]) -> list[str]:
    """Return the names of the cups that parameters of the form cups.NAME.* describe."""
    found = (NAMED_CUP.fullmatch(name) for name in names)
    return list(dict.fromkeys(match[1] for match in found if match))


def with_chosen_cup(values: Mapping[str, Any]) -> dict[str, Any]:
    """
    Return parameter values with those of the cup named by cup.name in the place of cup.*.

    What the named cup leaves out is taken from cup.*, but for what the identification of cup.* has
    seen, envelope.*, which says nothing about another cup.

    Raises
    ------
    BellowsError
        If there is no cup of that name, or its stiffness is not given.

    """
    name = values.get('cup.name', '')
    if not name:
        return dict(values)
    prefix = f'cups.{name}.'
    known = cup_names(values)
    if f'{prefix}stiffness' not in values:
        raise BellowsError(_why_unknown(name, known))
    chosen = {
        f'cup.{key.removeprefix(prefix)}': value
        for key, value in values.items() if key.startswith(prefix)
    }
    kept = {key: value for key, value in values.items() if not key.startswith('envelope.')}
    return {**kept, **chosen}


def _why_unknown(name: str, known: list[str]) -> str:
    """Return what to say about the name of a cup that is not described."""
    if name in known:
        return (
            f"cup.name is '{name}', but cups.{name}.stiffness is not set. Give the cup's "
            'stiffness, damping and length there.'
        )
    near = difflib.get_close_matches(name, known, n=1, cutoff=0.5)
    hint = f"Did you mean '{near[0]}'?" if near else (
        f'Cups there: {", ".join(known) or "none"}.')
    return f"cup.name is '{name}', but there are no parameters cups.{name}.*. {hint}"
