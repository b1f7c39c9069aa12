"""Identifiability from recordings, and the recommended structure of K and P."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from bellows_ros import __version__
from bellows_ros.core.identification.identifiability import Excitation, excitation_of
from bellows_ros.core.identification.reduction import reduced
from bellows_ros.core.identification.structure_selection import StructureSelection
from bellows_ros.core.recording.recording import Recording
from bellows_ros.workflows.identify import read_all, resolved, selection
from bellows_ros.workflows.recordings import Progress
from bellows_ros.workflows.result_json import excitation_json, selection_json, with_units


@dataclass(frozen=True, eq=False)
class StructureAdvice:
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
    selection: StructureSelection
    recordings: tuple[Recording, ...]
    values: Mapping[str, Any]

    @property
    def warnings(self) -> tuple[str, ...]:
        """Warnings about the excitation, then about the recordings."""
        of_recordings = (text for own in self.recordings for text in own.report.warnings)
        return (*self.excitation.warnings, *of_recordings)

    def as_json(self) -> dict[str, Any]:
        """Return the content of the JSON file, in SI units."""
        return with_units({
            'excitation': excitation_json(self.excitation),
            'structures': selection_json(self.selection),
            'recordings': [recording.as_json() for recording in self.recordings],
            'warnings': self.warnings,
            'settings': dict(self.values),
            'version': __version__,
        })


def structures(
    settings: Mapping[str, object], progress: Progress | None = None
) -> StructureAdvice:
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
    tell, values = progress or (lambda what, part: None), resolved(settings)
    recordings, _ = read_all(values, True, tell)
    advice = StructureAdvice(
        excitation_of([reduced(recording, values) for recording in recordings]),
        selection(recordings, values, tell), tuple(recordings), values)
    tell('done', 1.0)
    return advice
