"""What recordings can tell about a cup, and which structure of K and P to take."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
import os
from typing import Any

from bellows_ros import __version__
from bellows_ros.core.identification.advice.added_noise import FilterNoise
from bellows_ros.core.identification.advice.excitation import describe_excitation, Excitation
from bellows_ros.core.identification.advice.ladder import Ladder, structure_ladder
from bellows_ros.core.identification.methods import filtered_samples
from bellows_ros.core.identification.structure import structure_named
from bellows_ros.core.model import package_of
from bellows_ros.core.parameters import PACKAGE_PARAMETERS, resolve
from bellows_ros.core.recording.preparation import Report
from bellows_ros.errors import BellowsError
from bellows_ros.workflows.recordings import load, values_of_each
from bellows_ros.workflows.result_json import excitation_json, ladder_json, recording_json

Progress = Callable[[str, float], None]


@dataclass(frozen=True, eq=False)
class Climb:
    """
    What recordings tell, and the structures compared.

    Parameters
    ----------
    excitation : Excitation
        For the structure of the parameter fit.structure.
    ladder : Ladder
        The structures, judged.
    reports : tuple of Report
        What became of each recording.
    values : mapping
        All parameters.

    """

    excitation: Excitation
    ladder: Ladder
    reports: tuple[Report, ...]
    values: Mapping[str, Any]

    @property
    def warnings(self) -> tuple[str, ...]:
        """What the user must know: of the excitation, then of the recordings."""
        return self.excitation.warnings + tuple(w for r in self.reports for w in r.warnings)

    def as_json(self) -> dict[str, Any]:
        """Return the content of the JSON file, in SI units."""
        return {
            'excitation': excitation_json(self.excitation),
            'ladder': ladder_json(self.ladder),
            'recordings': [
                recording_json(str(bag), report)
                for bag, report in zip(self.values['bags'], self.reports, strict=True)
            ],
            'warnings': self.warnings,
            'settings': dict(self.values),
            'version': __version__,
        }


def climb(settings: Mapping[str, object], progress: Progress | None = None) -> Climb:
    """
    Say what the recordings that the parameter `bags` names can tell, and compare structures.

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
    required = () if settings.get('package.files') else PACKAGE_PARAMETERS
    values: dict[str, Any] = resolve(settings, required)
    bags, tell = values['bags'], progress or (lambda what, part: None)
    if not bags:
        raise BellowsError(
            'No recording to look at: the parameter bags is empty. Name at least one rosbag2 '
            'folder, or a .mcap or .db3 file.'
        )
    recordings, samples = [], []
    for number, (bag, own) in enumerate(zip(bags, values_of_each(values), strict=True)):
        tell(f'reading {os.fspath(bag)}', number / (len(bags) + 2))
        recordings.append(load(bag, own).recording)
        samples.append(filtered_samples(recordings[-1], package_of(own), own))
    noises = [FilterNoise.of(recording) for recording in recordings]
    tell('looking at the excitation', len(bags) / (len(bags) + 2))
    structure = structure_named(values['fit.structure'])
    excitation = describe_excitation(samples, values['cup.length'], structure, noises)
    tell('comparing structures', (len(bags) + 1) / (len(bags) + 2))
    ladder = structure_ladder(samples, values['cup.length'], noises)
    tell('done', 1.0)
    return Climb(excitation, ladder, tuple(r.report for r in recordings), values)
