"""Compare the structures of K and P on recordings; find what is identifiable from them."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any, NamedTuple

from bellows_ros.core.identification import methods, structure_selection
from bellows_ros.core.identification.identifiability import Excitation, excitation_of
from bellows_ros.core.identification.reduction import reduced
from bellows_ros.core.model.cup_package import is_gripper
from bellows_ros.core.parameters.values import Values
from bellows_ros.core.recording.recording import Recording
from bellows_ros.files import results
from bellows_ros.workflows.identification import excitation_json, selection_json
from bellows_ros.workflows.identify import FIT_ENDS, read_all, resolved
from bellows_ros.workflows.recordings import no_progress, Progress
from bellows_ros.workflows.verdict import selection
import numpy as np


class StructureAdvice(NamedTuple):
    """
    What is identifiable from recordings, and a comparison of structures.

    Parameters
    ----------
    excitation : Excitation
        For the structure of the parameter fit.structure.
    selection : StructureSelection
        The structures with their criteria.
    recordings : tuple of Recording
        That were read.
    values : mapping
        All parameters.

    """

    excitation: Excitation
    selection: structure_selection.StructureSelection
    recordings: tuple[Recording, ...]
    values: Values

    @property
    def warnings(self) -> tuple[str, ...]:
        """Warnings about the excitation, then about the recordings."""
        return (*self.excitation.warnings,
                *(text for each in self.recordings for text in each.report.warnings))

    def as_json(self) -> dict[str, Any]:
        """Return the content of the JSON file, in SI units."""
        return results.with_units({
            'excitation': excitation_json(self.excitation),
            'structures': selection_json(self.selection),
            'recordings': self.recordings,
            'warnings': self.warnings,
            'settings': dict(self.values)})


def structures(settings: Mapping[str, Any], progress: Progress = no_progress) -> StructureAdvice:
    """
    Find what is identifiable from the recordings of the parameter `bags`; compare structures.

    Parameters
    ----------
    settings : mapping
        Parameters by name; those left out have their defaults.
    progress : callable, optional
        Called with what is being done and the part (0 to 1) that is done.

    Raises
    ------
    BellowsError
        If a parameter or a recording is not usable, or no structure can be fitted.

    """
    values = resolved(settings)
    read: list[Recording] = read_all(values, True, progress)[0]
    recordings = methods.with_relaxation(read, values)
    if any(recordings[0].relaxation.strengths):  # least squares alone is biased by noise
        better = methods.fit(recordings, values.replaced({
            'fit.method': 'output_error',
            'fit.structure': 'layout' if is_gripper(values) else 'axisymmetric'}), progress).fit
        if better.converged:
            relaxation = recordings[0].relaxation._replace(
                strengths=better.relaxation, covariance=np.diag(np.square(better.relaxation_std)))
            recordings = [replace(each, relaxation=relaxation) for each in recordings]
    progress('comparing structures', FIT_ENDS)
    advice = StructureAdvice(
        excitation_of([reduced(recording, values) for recording in recordings]),
        selection(recordings, values), tuple(recordings), values)
    progress('done', 1.0)
    return advice
