"""Estimates of a fit jointly with K and P, as the parameters of cup and cell that they replace."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
import math
from typing import Any, NamedTuple

from bellows_ros.core.geometry import lie
from bellows_ros.core.geometry.arrays import Array
from bellows_ros.core.identification.result import Fit
from bellows_ros.core.identification.segments import ReducedRecording
from bellows_ros.core.identification.unknowns import KINDS, payload_of
from bellows_ros.core.identification.validation import Validation
from bellows_ros.core.identification.verdict import CHANGED
from bellows_ros.core.model.cup_package import Cup
from bellows_ros.core.model.structure import structure_named
from bellows_ros.core.model.validity_range import Envelope, joined_envelopes
from bellows_ros.core.parameters import checks
from bellows_ros.core.parameters.values import Values
from bellows_ros.core.recording import alignment
from bellows_ros.core.recording.recording import Recording, TimeOffset
from bellows_ros.core.sensors.body import middle_of
from bellows_ros.core.sensors.corners import USUAL_EXPOSURE
import numpy as np

MAX_DELAY = 0.5
"""Largest delay and standard error of a delay in measured.latency, s."""

FREE_PARAMETERS = {
    'com': ('package.com', 'm'), 'length': ('cup.length', 'm'),
    'mass': ('package.mass', 'kg'), 'inertia': ('package.inertia', 'kg m^2')}
"""Parameter and unit of each estimated quantity of cup and package."""


class ParameterEstimate(NamedTuple):
    """A value with its standard errors, and their unit."""

    value: Any
    std: Any
    unit: str


class Estimates(NamedTuple):
    """
    Estimates jointly with K and P.

    Parameters
    ----------
    found : mapping of str to ParameterEstimate
        Estimates by parameter; empty for a search without convergence. Clock, marker and world
        are from the recording with the most certain world.
    delays : tuple of TimeOffset
        Delays of each recording's tool stamps behind the package's, if requested, in total.
    asked : tuple of str
        Parameters that fit.free or recording.package_world request.

    """

    found: Mapping[str, ParameterEstimate]
    delays: tuple[TimeOffset, ...]
    asked: tuple[str, ...]


@dataclass(frozen=True)
class ClockSettings:
    """
    Settings of the clocks in a fit.

    Parameters
    ----------
    latency : float
        Given latency of the package's poses, by which they are corrected, s.
    is_free : bool
        Whether fit.free requests the offset between the clocks of tool and package.

    """

    latency: float
    is_free: bool

    @classmethod
    def of(cls, values: Values) -> 'ClockSettings':
        """Return the settings in parameters."""
        return cls(values.measured.latency[0] if checks.is_measured(values) else 0.0,
                   'time_offset' in values.fit.free)


def estimates_of(
    fit: Fit, parts: Sequence[ReducedRecording], recordings: Sequence[Recording],
    clocks: ClockSettings,
) -> Estimates:
    """
    Return the estimates of a fit.

    Parameters
    ----------
    fit : Fit
        K and P.
    parts : sequence of ReducedRecording
        Recordings of the fit.
    recordings : sequence of Recording
        The first of them, unreduced.
    clocks : ClockSettings
        Given latency, and whether the clocks' offset is free.

    """
    delays = _delays(fit, parts) if clocks.is_free else ()
    if not fit.converged:
        return Estimates({}, delays, ())
    found = dict(_of_package(fit, parts[0].payload, parts[0].cup_length))
    if recordings:
        best = min(range(len(recordings)), key=lambda number: _world_error(parts[number]))
        found |= _of_cell(fit, recordings[best], best)
        latency = _latency(fit, clocks.latency, delays, best)
        if latency:
            found['measured.latency'] = latency
    named = {*fit.named} & CHANGED.keys() - {'time_offset'}  # has findings of its own
    asked = {'recording.package_world', 'measured.scale', *(CHANGED[name][0] for name in named)}
    return Estimates(found, delays, tuple(name for name in found if name in asked))


def _delays(fit: Fit, parts: Sequence[ReducedRecording]) -> tuple[TimeOffset, ...]:
    """Return `Estimates.delays`: by the registration, and by the fit."""
    before = tuple(part.time_offset or TimeOffset(0.0, math.inf) for part in parts)
    if 'time_offset' not in fit.nuisances:
        return before
    changes, errors = (each['time_offset'][:, 0].tolist()
                       for each in (fit.nuisances, fit.nuisances_std))
    return tuple(TimeOffset(offset.value + change, std) for offset, change, std in zip(
        before, changes, errors, strict=True))


def _world_error(part: ReducedRecording) -> float:
    """Return the sum of the standard errors of a recording's world, 0 without an estimate."""
    return float(np.sum(part.package_world.std)) if part.package_world else 0.0


def com_change(fit: Fit) -> Array:
    """Return the change (3,) of the given centre of mass by a fit, m."""
    return np.asarray(fit.nuisances.get('com', np.zeros((1, 3)))[0])


def _world_std(pose: Array, R_world_recorded: Array, middle: Array, std: Array) -> Array:
    """Return the standard deviations (6,) of a pose (7,) by those of its `shifted_pose` motion."""
    turned = np.square(R_world_recorded.T)
    across = np.square(R_world_recorded.T @ lie.hat(R_world_recorded @ pose[:3] - middle))
    variance = np.square(std)
    return np.asarray(np.sqrt(np.append(
        turned @ variance[:3] + across @ variance[3:], turned @ variance[3:])))


def _of_package(
    fit: Fit, payload: Any, length: float
) -> Iterator[tuple[str, ParameterEstimate]]:
    """Yield the estimates of a package, and of the length of a cup that was given as (m)."""
    free = {name: rows[0] for name, rows in fit.nuisances.items()}
    changed = payload_of(payload, free)
    estimates = {
        'com': changed.com, 'mass': np.array([changed.mass]),
        'length': np.array([length + float(np.sum(free.get('length', 0.0)))]),
        'inertia': changed.inertia[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]}
    for name, (parameter, unit) in FREE_PARAMETERS.items():
        if name not in fit.nuisances_std:
            continue
        value, error = np.squeeze(estimates[name]), fit.nuisances_std[name][0]
        if name in ('mass', 'inertia'):  # logarithms of factors
            error = error * estimates[name][:len(error)]
        error = np.pad(error, (0, value.size - len(error)))  # products of inertia are given
        yield parameter, ParameterEstimate(value.tolist(), np.resize(error, value.shape), unit)


def _of_cell(
    fit: Fit, recording: Recording, number: int
) -> Iterator[tuple[str, ParameterEstimate]]:
    """Yield the estimates of scale, world, marker and tag from the recording with a number."""
    free, std = ({
        name: rows[number if KINDS[name].each else 0] for name, rows in each.items()}
        for each in (fit.nuisances, fit.nuisances_std))
    settings, world = recording.settings, recording.report.package_world
    scale = 1.0 + float(free.get('scale', np.zeros(1))[0])
    if 'scale' in std:
        yield 'measured.scale', ParameterEstimate(
            recording.report.scale * scale, std['scale'][0], '1')
    if world:
        middle = middle_of(recording.tracked_package)[:3]
        pose = alignment.shifted_pose(
            world.pose, settings.R_world_recorded, middle, free.get('package_world', np.zeros(6)))
        error = world.std if 'package_world' not in std else _world_std(
            pose, settings.R_world_recorded, middle, std['package_world'])
        if settings.tag is None:
            pose[:3] *= scale
        yield 'recording.package_world', ParameterEstimate(
            checks.pose_text(pose), error, 'm, rad')
    if 'package_marker' in free or world and settings.align_at_rest:
        shift = np.array(settings.moves_with_com) * com_change(fit)
        yield 'measured.offset', ParameterEstimate(
            _marker_offset(recording, shift, free.get('package_marker', np.zeros(6))),
            std.get('package_marker', np.zeros(6)), 'm, rad')
    noise = fit.noise_in_motion.get(number)
    if settings.tag and noise is not None:
        change = 1.0 + float(free.get('exposure', np.zeros(1))[0])
        given = settings.tag.exposure or (
            USUAL_EXPOSURE / recording.report.package.timing.rate_hz)
        yield 'measured.noise', ParameterEstimate(
            [noise[0], noise[1] / max(change**2, 0.01)], np.zeros(2), 'rad, 1/rad')
        yield 'measured.exposure', ParameterEstimate(
            given * abs(change), given * std.get('exposure', np.ones(1))[0], 's')


def _marker_offset(recording: Recording, shift: Array, marker: Array) -> list[float]:
    """
    Return the pose of the marker relative to B, position (m) and rotation vector (rad).

    The centre of mass has moved by a shift (3,), the marker by an estimated error (6,).
    """
    R = recording.alignment.R_package_markers_lip
    T = lie.inverse_transform(
        lie.transform(R, R @ (recording.alignment.origin_to_com + shift))
        @ lie.transform(lie.exp_so3(marker[3:]), marker[:3]))
    return np.append(T[:3, 3], lie.log_so3(T[:3, :3])).tolist()


def _latency(
    fit: Fit, before: float, delays: Sequence[TimeOffset], number: int
) -> ParameterEstimate | None:
    """
    Return the latency (s) of the package's poses by a recording; None if unknown or none.

    `before` is the given latency, by which the poses are corrected.
    """
    if delays:
        delay, std = delays[number]
    else:
        delay, std = (float(each['time_offset'][number][0]) if 'time_offset' in each else 0.0
                      for each in (fit.nuisances, fit.nuisances_std))
    if not delay or abs(delay) >= MAX_DELAY or not math.isfinite(std):
        return None
    return ParameterEstimate([before - delay, min(std, MAX_DELAY)], np.zeros(2), 's')


def terms_of(fit: Fit, given: Cup) -> dict[str, Any]:
    """Return the fitted terms of a cup, with given numbers for unidentifiable ones of K and P."""
    structure = structure_named(fit.structure)
    identifiable = np.isfinite(np.diag(fit.covariance))
    K, P = structure.matrices(np.where(
        identifiable, fit.parameters, structure.parameters(given.stiffness, given.damping)))
    is_definite = min(np.linalg.eigvalsh(M)[0] for M in (K, P)) > 0.0
    if fit.usable and not is_definite:
        return fit.terms
    return {**fit.terms, 'stiffness': K, 'damping': P}


def envelope_of(
    simulations: Sequence[Validation], parts: Sequence[ReducedRecording], holding: float
) -> Envelope:
    """
    Return the validity range of a fit; `holding` is the vacuum, Pa.

    Poses of a tag are too noisy: its recordings have the range of their free simulations.
    """
    simulated = [each.envelope for each in simulations if each.recording.views]
    return joined_envelopes(simulated or [part.envelope for part in parts], holding)
