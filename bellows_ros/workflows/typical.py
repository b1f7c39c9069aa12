"""Accuracy of an identified cup on the user's own motion, and what to record to improve it."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from bellows_ros.core.geometry.arrays import Array
from bellows_ros.core.geometry.lie import log_so3, quaternion_to_rotation
from bellows_ros.core.identification.identifiability import DIRECTIONS
from bellows_ros.core.model.cup_package import Cup, model_tuple, package_of
from bellows_ros.core.model.structure import structure_named
from bellows_ros.core.parameters.checks import PACKAGE_PARAMETERS, resolve
from bellows_ros.core.planning.plan import Run
from bellows_ros.workflows.identification import Identification
from bellows_ros.workflows.plan import Source
import numpy as np

STEP = 0.5
"""Step of central differences, standard errors."""

MOST_OF_IT = 0.5
"""Entries are named until they make up this fraction of the variance."""


@dataclass(frozen=True)
class Typical:
    """
    The accuracy of predictions along a plan, as far as K and P are uncertain.

    Parameters
    ----------
    plan : str
        Where it was read.
    position, rotation : (float, float)
        Standard deviation of the package's pose, its root mean square along the plan and its
        largest value: m and rad.
    shares : mapping of str to float
        Part of the variance that each entry of K and P makes alone, the largest first.
    unknown : tuple of str
        Entries that are not identifiable; they count as known to themselves, 100 %.

    """

    plan: str
    position: tuple[float, float]
    rotation: tuple[float, float]
    shares: Mapping[str, float]
    unknown: tuple[str, ...]

    @property
    def sentence(self) -> str:
        """Accuracy, its main causes, and what to record again."""
        (mm, most_mm), (mrad, most_mrad) = (
            (1e3 * value for value in each) for each in (self.position, self.rotation))
        text = (f'Along {self.plan} the prediction of the package is accurate to {mm:.2g} mm and '
                f'{mrad:.2g} mrad (root mean square; at most {most_mm:.2g} mm and '
                f'{most_mrad:.2g} mrad), given the uncertainty of K and P.')
        if self.unknown:
            text += f' Not identifiable, and counted with 100 %: {", ".join(self.unknown)}.'
        named, part = list[str](), 0.0
        for label, share in self.shares.items():
            if part >= MOST_OF_IT or share <= 0.0:
                break
            named.append(f'{label} ({100.0 * share:.0f} %)')
            part += share
        axes = dict.fromkeys(axis for label in named for axis in label.split()[1].split('-'))
        return (f'{text} The largest contributions are {" and ".join(named)}. To reduce them, '
                f'record again: {"; ".join(DIRECTIONS[axis][1] for axis in axes)}. '
                "'bellows excite' designs such a motion.")

    def as_json(self) -> dict[str, Any]:
        """Return the content of the JSON file, m and rad."""
        return {
            'plan': self.plan, 'position_std_rms': self.position[0],
            'position_std_max': self.position[1], 'rotation_std_rms': self.rotation[0],
            'rotation_std_max': self.rotation[1], 'shares': dict(self.shares),
            'not_identifiable': list(self.unknown), 'sentence': self.sentence,
        }


def typical(source: Source, found: Identification) -> Typical:
    """
    Return the accuracy of predictions along a plan.

    Parameters
    ----------
    source : Source
        The plan, as `workflows.plan.read_plan` returns it.
    found : Identification
        With K, P and their covariance, of which the predictor can take the cup.

    Raises
    ------
    BellowsError
        If the package is not known, or the cup cannot hold it along the plan.

    """
    values: dict[str, Any] = resolve(found.cup_values(), PACKAGE_PARAMETERS)
    fit, structure = found.fit, structure_named(found.fit.structure)
    x = fit.parameters
    diagonal = structure.sizes(fit.stiffness, np.maximum(fit.damping, 0.0))
    known = np.isfinite(np.diag(fit.covariance))
    covariance = np.where(known & known[:, None], fit.covariance, np.diag(diagonal**2))
    std = np.sqrt(np.diag(covariance))

    def states(parameters: Array) -> Array:
        cup = Cup(*structure.matrices(parameters), found.cup_length)
        model = model_tuple(cup, package_of(values), source.gravity)
        return Run(model, None, source.tool).at(1.0).states

    slopes: Any = []
    # so short that K stays definite where little is known
    for i, step in enumerate(STEP * np.minimum(std, 0.5 * diagonal)):
        unit = step * np.eye(len(x))[i]
        up, down = states(x + unit), states(x - unit)
        R = [quaternion_to_rotation(rows[:, 3:7]) for rows in (down, up)]
        turn = log_so3(np.swapaxes(R[0], -1, -2) @ R[1])
        slopes.append(np.hstack([up[:, :3] - down[:, :3], turn]) / (2.0 * step or 1.0))
    slopes = np.array(slopes)
    variance = np.einsum('ink,ij,jnk->nk', slopes, covariance, slopes)
    alone = std**2 * np.sum(
        slopes**2 / np.maximum(np.mean(variance, axis=0), 1e-300), axis=(1, 2))
    order = np.argsort(-alone, kind='stable').tolist()
    squares = np.maximum([variance[:, :3].sum(axis=1), variance[:, 3:].sum(axis=1)], 0.0)
    position, rotation = np.sqrt([squares.mean(axis=1), squares.max(axis=1)]).T.tolist()
    total = float(alone.sum()) or 1.0
    return Typical(
        source.path, tuple(position), tuple(rotation),
        {fit.labels[i]: float(alone[i]) / total for i in order},
        tuple(label for label, sure in zip(fit.labels, known, strict=True) if not sure))
