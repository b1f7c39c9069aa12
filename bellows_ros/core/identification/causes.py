"""
Causes of a misfit after a fit: deviations from given quantities, or from settings.

The name of each is its entry in the texts of the room 'causes'.
"""

from typing import NamedTuple

from bellows_ros.core.geometry.arrays import Array
import numpy as np

MATERIAL = 0.02
"""Smallest relative change of an entry of K that makes a cup wrong."""

DISTINCT = 0.5
"""Share of the misfit, and of the likeliest cause's share, above which a cause or its rival
counts."""

NONE = np.empty(0)


class Finding(NamedTuple):
    """
    A confirmed or possible deviation from a given quantity or setting.

    Parameters
    ----------
    name, value : str
        Name of the cause: a name of fit.free, a parameter, or a property of the cup; and its
        correct setting, or the body of a marker, '' for freed quantities.
    theta, std : ndarray (n,)
        Estimates of the freed quantities, and their standard errors.
    share : float
        Share of the chi² beyond noise that the cause explains.
    moved : float
        Largest relative change of an identifiable diagonal entry of K.
    datum, certain : bool
        Whether the cause is a given quantity, and whether no other cause explains the recordings
        as well.
    instead : str
        Name or value of another given quantity that cannot be distinguished from the cause; '' for
        none.

    """

    name: str
    value: str
    theta: Array = NONE
    std: Array = NONE
    share: float = 1.0
    moved: float = 0.0
    datum: bool = True
    certain: bool = True
    instead: str = ''

    @property
    def material(self) -> bool:
        """
        Whether the cup is wrong without the cause.

        A certain error of a given quantity makes K uncertain by more than its standard errors; a
        slip is harmless where K is equal without it.
        """
        return self.datum and (self.certain and self.name != 'slip' or (
            self.share >= DISTINCT and self.moved > MATERIAL))
