"""Quality of a cup, causes of a misfit, and the acceptance of the cup."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from itertools import permutations
import math
from types import MappingProxyType
from typing import Any, NamedTuple

from bellows_ros.core.findings import Finding, Level
from bellows_ros.core.geometry import lie
from bellows_ros.core.geometry.arrays import Array
from bellows_ros.core.identification import fitting
from bellows_ros.core.identification.estimate import MAX_NOISE_CHI2
from bellows_ros.core.identification.fitting import HELD_OUT
from bellows_ros.core.identification.result import Cause, DISTINCT, Fit, POSE_UNITS
from bellows_ros.core.identification.unknowns import as_found, given_std, payload_of
from bellows_ros.core.identification.validation import corner_scores, MAX_NRMSE, validate
from bellows_ros.core.model.cup_package import Cup, gripper_of, Package
from bellows_ros.core.model.structure import Structure
from bellows_ros.core.parameters.conversion import given_structure, one_cup_of
from bellows_ros.core.parameters.table import PARAMETERS
from bellows_ros.core.parameters.values import Values
from bellows_ros.core.recording import alignment
from bellows_ros.core.recording.recording import Recording
from bellows_ros.core.sensors import body
from bellows_ros.core.signals.residuals import AXES
from bellows_ros.core.signals.trajectory import NS_PER_S
from bellows_ros.errors import UnstableError
from bellows_ros.report.findings import entry, sets, text
import numpy as np

MAX_TESTED = 3
"""Largest number of tested recordings; more give no further information."""

MAX_SIMULATED = 50_000
"""Largest number of samples of a recording simulated freely for the verdict."""

MAX_NOISE = 1.1
"""Largest ratio of a free simulation's error to the noise of the poses, if there is no misfit."""

MAX_NOISE_RATIO = 3.0
"""Largest ratio of the held-out error to the noise, if the error also exceeds `MAX_NRMSE`."""

MAX_SOUND_RATIO = 2.0
"""Ratio of a free simulation's error to the noise above which the cause of a misfit is described:
recordings without faults, whose noise has a memory of 26 ms, have 1.06 to 1.33 (10 seeds)."""

MIN_INERTIA_RATIO = 0.05
"""Smallest logarithm of a corrected ratio of inertia and mass that makes the mass doubtful: the
usual standard deviation of an inertia by CAD."""

SIGMAS = 3.0
"""Number of stated standard deviations beyond which an estimate is a finding of its own."""

CLOCK_RATE = 'rate of the clocks (ppm)'

FREE_PARAMETERS = {
    'com': ('package.com', 'm'), 'length': ('cup.length', 'm'),
    'mass': ('package.mass', 'kg'), 'inertia': ('package.inertia', 'kg m^2')}
"""Parameter and unit of each estimated quantity of cup and package."""


class Simulated(NamedTuple):
    """
    A recording simulated freely with the cup: RMS errors, noise and motion by axis, m and rad.

    A tag is rated by its corners alone, rad, as in a replay.
    """

    bag: str
    rms: Array
    noise: Array
    motion: Array
    beginning: float = 0.0
    """Duration of the simulated beginning of a long recording, s; 0 for a whole recording."""
    held_out: Array | None = None
    """RMS errors in the last fifth with the cup of the other four, if known."""
    axes: tuple[str, ...] = AXES

    @property
    def is_at_noise(self) -> bool:
        """Whether the simulation is as accurate as the poses."""
        return bool((self.rms <= MAX_NOISE * self.noise).all())

    @property
    def unpredicted(self) -> list[str]:
        """Axes with an error beyond three times the noise and 5 % of the motion, held out."""
        error = self.rms if self.held_out is None else self.held_out
        within = error <= np.maximum(MAX_NOISE_RATIO * self.noise, MAX_NRMSE * self.motion)
        return [self.axes[i] for i in np.flatnonzero(~within)]

    def as_json(self) -> dict[str, Any]:
        """Return the content for a JSON file."""
        units = POSE_UNITS if len(self.axes) > 1 else ('rad',)
        return {**self._asdict(), 'units': {
            **dict.fromkeys(('rms', 'noise', 'motion', 'held_out'), units), 'beginning': 's'}}


class FitVerdict(NamedTuple):
    """
    Free simulations of recordings of the fit, and deviations from given quantities.

    A definite cup of a converged search is rejected for a held-out error, for a cause without
    which K is wrong, or for given values that it contradicts without a certain cause.
    """

    simulated: tuple[Simulated, ...]
    causing: tuple[Cause, ...]
    """Causes of a misfit, the likeliest first."""
    given: Values
    excess: float = 0.0
    """Chi² beyond noise, over the chi² expected of noise."""
    faults: tuple[Any, ...] = ()
    """Faults of the recordings that were accepted."""
    sensor: tuple[Any, ...] = ()
    """Findings on poses that seem to be of another kind of sensor than stated."""
    log_inertia_ratio: float = 0.0
    """Logarithm of the ratio of inertia and mass as estimated by the fit, relative to the given
    ratio."""
    found: Mapping[str, tuple[Array, str, float]] = MappingProxyType({})
    """
    Significantly changed parameters of package and cup: value by the fit, change, and change in
    standard deviations; the largest change first.
    """

    @property
    def wrong(self) -> list[Cause]:
        """The likeliest cause, if the cup is wrong without it."""
        likely = [each for each in self.causing if each.name != 'unknown']
        return [each for each in likely[:1] if each.material]

    @property
    def contradicted(self) -> list[Finding]:
        """Given values beyond their stated errors, if no single cause explains the deviations."""
        is_open = self.causing and not self.causing[0].certain and (
            self.causing[0].name != 'unknown' or self._is_misfit)
        return self._off_given(Level.ERROR) if is_open else []

    def _off_given(self, level: Level) -> list[Finding]:
        """Return findings on given values beyond their stated errors."""
        return [Finding('off_given', level, {
            'off': off, 'pull': pull, 'order': self._in_order(name, value)}, name)
            for name, (value, off, pull) in self.found.items()
            if pull > SIGMAS and f'{name}_std' in PARAMETERS]

    @property
    def _is_misfit(self) -> bool:
        """Whether chi² or a free simulation exceeds the errors of recordings without faults."""
        return self.excess > MAX_NOISE_CHI2 - 1.0 or any(
            (each.rms > MAX_SOUND_RATIO * each.noise).any() for each in self.simulated)

    @property
    def is_at_noise(self) -> bool:
        """Whether free simulations are as accurate as the poses."""
        return bool(self.simulated) and all(each.is_at_noise for each in self.simulated)

    @property
    def doubts(self) -> tuple[Finding, ...]:
        """Findings on corrections by the fit that may be due to a wrong mass."""
        if self.refusals:
            return ()
        found = []
        inertia = self.found.get('package.inertia', (np.zeros(3),))[0]
        if abs(self.log_inertia_ratio) >= MIN_INERTIA_RATIO and not self._in_order(
                'package.inertia', inertia):
            found.append(Finding('doubtful_mass', Level.WARN, {
                'factor': math.exp(-self.log_inertia_ratio)}))
        found += self._off_given(Level.WARN)
        if self.found:
            values = ', '.join(
                f'{name} [{", ".join(f"{x:.4g}" for x in value)}] (given {off} off)'
                for name, (value, off, _) in self.found.items())
            found.append(Finding('found_values', Level.OK, {'values': values}))
        return tuple(found)

    def _in_order(self, name: str, value: Array) -> str:
        """Return a sentence on moments of inertia that were given in another order, or ''."""
        if name != 'package.inertia' or not {name} <= self.given.keys() & self.found.keys():
            return ''
        order = order_of(np.array(self.given[name])[:3], value[:3])
        return order and f' The given moments fit about other axes: {order}.'

    @property
    def cause(self) -> tuple[Any, ...]:
        """Findings on the main cause and further ones, if any."""
        if self.faults:
            return self.faults
        if not self.causing:
            return ()
        first, *_ = said = [cause_finding(each, self.given) for each in self.causing]
        if self.causing[0].certain:
            return (first,)
        likely = [each for each in self.causing if each.name != 'unknown']
        is_sound = not self.contradicted and not self.wrong and (
            self.is_at_noise or self.simulated and not self.refusals and not (
                likely and likely[0].share >= DISTINCT or self._is_misfit))
        if is_sound:
            return ()
        listed = ' '.join(f'{number}. {text(each)}' for number, each in enumerate(
            (own for own in said if own.code != 'unknown_cause'), 1))
        unknown = [own for own in said[:1] if own.code == 'unknown_cause']
        return (*(self.sensor or unknown), *(
            [Finding('likeliest', Level.WARN, {'causes': listed})] if likely else []))

    @property
    def refusals(self) -> tuple[Finding, ...]:
        """Reasons to reject the cup; empty for a usable one."""
        reasons = [Finding('not_predicted', Level.ERROR, {
            'bag': simulated.bag, 'limit': MAX_NRMSE, 'axes': ', '.join(simulated.unpredicted)})
            for simulated in self.simulated if simulated.unpredicted]
        reasons += self.contradicted
        if self.faults or self.wrong:
            names = [name for each in self.wrong[:1]
                     for name in sets(cause_finding(each, self.given))]
            reasons.append(Finding('unusable', Level.ERROR, {
                'why': 'the lines above name the cause',
                'name': ' or '.join(names) or 'the recording'}))
        return tuple(reasons)

    def as_json(self) -> dict[str, Any]:
        """Return the content for a JSON file."""
        return {
            'free_simulations': self.simulated,
            'excess': self.excess,
            'hypotheses': [
                {'name': each.name, 'value': each.value, 'share': each.share,
                 'certain': each.certain, 'material': each.material,
                 **entry(cause_finding(each, self.given))} for each in self.causing]}


def verdict_of(
    fit: Fit, recordings: Sequence[Recording], length: float, values: Values,
) -> FitVerdict | None:
    """
    Return the verdict on a fit from some of its recordings, None without any.

    Parameters
    ----------
    fit : Fit
        K and P.
    recordings : sequence of Recording
        Recordings of the fit.
    length : float
        Length of the cup, m.
    values : mapping
        Parameters by name.

    """
    tested = recordings[:MAX_TESTED]
    faults, sensors = (tuple(remark for recording in tested for remark in filter(
        chosen, recording.report.remarks)) for chosen in (
            lambda remark: remark.level == Level.ERROR, lambda remark: remark.code == 'sensor'))
    if not tested:
        return None
    package = tested[0].payload
    given = values.replaced({
        'package.mass': package.mass, 'package.com': package.com,
        'package.inertia': np.diag(package.inertia)})
    simulated = values.replaced({'cup.length': length, 'fit.method': 'output_error'})
    verdict = FitVerdict(
        (), (), given, faults=faults, sensor=sensors[:1])
    verdict = _judged(verdict, fit, tested, length, values)
    if faults:
        return verdict
    if fit.method != 'output_error':
        if verdict.simulated and all(
                (each.rms <= MAX_SOUND_RATIO * each.noise).all() for each in verdict.simulated):
            return verdict  # its causes would not be described
        fit = fitting.fitted(tested, simulated, exactly=True)
    excess = max(fit.chi2 or 1.0, fit.robust_chi2 or 1.0) - 1.0
    return verdict._replace(excess=excess, causing=fit.causes)


def _judged(
    verdict: FitVerdict, fit: Fit, tested: Sequence[Recording], length: float, values: Values
) -> FitVerdict:
    """Return a verdict with free simulations of recordings, and with the corrections of a fit."""
    log_inertia_ratio = float(  # one of the three moments may be uncertain
        np.median(fit.nuisances['inertia']) - np.mean(fit.nuisances.get('mass', 0.0))) if (
        'inertia' in fit.nuisances and not {'mass', 'inertia'} & {*fit.named}) else 0.0
    length += float(fit.nuisances['length'][0, 0]) if 'length' in fit.nuisances else 0.0
    structure = given_structure(verdict.given)
    cup = gripper_of(replace(
        one_cup_of(verdict.given), stiffness=fit.stiffness, damping=fit.damping, length=length,
        relaxation=fit.relaxation, stretch=fit.stretch), structure.places)
    held = None if fit.held_out is None else _cup_of(fit.held_out, cup, structure)
    return verdict._replace(
        simulated=tuple(
            _simulated(cup, as_found(recording, fit.nuisances, number),
                       fit.noise_in_motion.get(number), held)
            for number, recording in enumerate(tested) if fit.usable),
        log_inertia_ratio=log_inertia_ratio, found=_found(fit, values, tested[0], length))


def _found(
    fit: Fit, values: Values, recording: Recording, length: float
) -> Mapping[str, tuple[Array, str, float]]:
    """Return `FitVerdict.found` of a converged fit; length in m."""
    if not fit.converged:
        return {}
    std, free = given_std(values), {name: rows[0] for name, rows in fit.nuisances.items()
                                    if name not in ('exposure', *fit.named)}
    estimates = estimates_of(recording.payload, free, length)
    parameters = {name: (FREE_PARAMETERS[name][0], estimates[name])
                  for name in ('com', 'length', 'inertia')}
    parameters['clock_rate'] = CLOCK_RATE, 1e6 * free.get('clock_rate', np.zeros(1))
    pulls = {name: float(np.max(np.abs(free[name]) / std[name]))
             for name in parameters if name in free and name in std}
    if max(pulls.values(), default=0.0) <= 0.5:  # standard deviations
        return {}
    changes = {name: f'{1e3 * np.linalg.norm(free[name]):.2g} mm' for name in pulls}
    if 'inertia' in pulls:
        changes['inertia'] = f'{100.0 * np.max(np.abs(np.expm1(free["inertia"]))):.2g} %'
    if 'clock_rate' in pulls:
        changes['clock_rate'] = f'{abs(parameters["clock_rate"][1][0]):.2g} ppm'
    return {parameters[name][0]: (parameters[name][1], changes[name], pulls[name])
            for name in sorted(pulls, key=pulls.__getitem__, reverse=True)}


def estimates_of(
    payload: Package, free: Mapping[str, Array], length: float
) -> Mapping[str, Array]:
    """Return the `FREE_PARAMETERS` with the changes of a fit; the length (m) is of the fit."""
    found = payload_of(payload, free)
    return {'com': found.com, 'mass': np.array([found.mass]), 'length': np.array([length]),
            'inertia': found.inertia[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]}


def _cup_of(theta: Array, cup: Cup, structure: Structure) -> Cup | None:
    """Return a cup with other parameters (p,), None if indefinite."""
    K, P = structure.matrices(theta)
    if min(np.linalg.eigvalsh(K)[0], np.linalg.eigvalsh(P)[0]) <= 0.0:
        return None
    return gripper_of(replace(cup, stiffness=K, damping=P), structure.places)


def _simulated(
    cup: Cup, recording: Recording, noise_in_motion: Array | None = None, held: Cup | None = None,
) -> Simulated:
    """Return a free simulation of a recording; a failed simulation explains no motion."""
    if recording.views and noise_in_motion is not None:
        recording = recording.with_noise(noise_in_motion)
    try:
        result = validate(cup, recording, MAX_SIMULATED)
    except UnstableError:
        unknown = np.full(6, np.nan)
        return Simulated(recording.name, unknown, unknown, unknown)
    seconds = float(np.ptp(result.stamps_ns)) / NS_PER_S
    beginning = seconds if len(recording.valid) > MAX_SIMULATED else 0.0
    held_out = _held_out(held, recording) if held else None
    if corners := result.corners:
        rms, noise, motion = map(np.atleast_1d, (corners.rms, corners.noise, corners.motion))
        return Simulated(recording.name, rms, noise, motion, beginning, held_out,
                         axes=('corners',))
    noise = result.noise
    if noise_in_motion is not None:
        noise = np.sqrt(noise**2 + np.maximum(
            noise_in_motion**2 - recording.body_noise[1].std**2, 0.0))
    return Simulated(recording.name, result.scores.rms, noise, result.scores.motion, beginning,
                     held_out)


def _held_out(cup: Cup, recording: Recording) -> Array:
    """Return the RMS errors of a free simulation in the last fifth, of a tag in its corners."""
    try:
        result = validate(cup, recording, MAX_SIMULATED)
    except UnstableError:
        return np.full(1 if recording.views else 6, np.inf)
    first, last = result.stamps_ns[[0, -1]]
    later = last - (last - first) // HELD_OUT
    if recording.views:
        seen = corner_scores(
            recording, result.package.select(result.package.stamps_ns > later))
        return np.atleast_1d(seen.rms if seen else 0.0)
    return result.select(result.stamps_ns > later).scores.rms


# ------------------------------------------------------------------------- causes as findings

SIDES = {'time_offset': ('earlier', 'later'), 'scale': ('large', 'small'),
         'length_drift': ('shortens', 'lengthens')}
"""Words for a number that is not positive, and for a positive one, by cause."""

Given = Mapping[str, Any]
Differing = tuple[str, str, str]
"""Name of a parameter, by how much its given value is wrong, and the value by the recordings."""


def cause_finding(cause: Cause, given: Given) -> Finding:
    """Return a cause with its size, its share of the misfit, and given values corrected by it."""
    is_part = cause.name != 'unknown' and cause.share > 0.0
    share = f' It explains {100.0 * cause.share:.0f} % of the misfit.' if is_part else ''
    if cause.name in ('com', 'length') and cause.instead:
        return Finding('length', Level.WARN, {'offset': abs(float(cause.theta[-1]))})
    if cause.name in DIFFERING:
        topic, off, value = DIFFERING[cause.name](cause, given)
        return Finding('differs', Level.WARN, {'off': off, 'found': value, 'share': share}, topic)
    theta, std = cause.theta.tolist(), cause.std.tolist()
    numbers: dict[str, Any] = {'share': share}
    if theta:
        numbers |= {'first': theta[0], 'last': theta[-1], 'magnitude': abs(theta[0]),
                    'size': f'{1e3 * abs(theta[0]):.3f} ± {1e3 * std[0]:.2g} mm',
                    'side': SIDES.get(cause.name, ('', ''))[theta[0] > 0.0]}
    if cause.name in MORE:
        numbers |= MORE[cause.name](cause, given)
    code = cause.name if cause.name != 'unknown' else 'unknown_cause'
    return Finding(code, Level.WARN, numbers, given.get('topics.package_pose', ''))


def order_of(given: Array, moments: Array) -> str:
    """Return the axes of which the given moments of inertia (3,) seem to be, '' if as given."""
    off = {order: float(np.max(np.abs(np.log(moments / given[list(order)]))))
           for order in permutations(range(3))}
    best = min(off, key=lambda order: off[order])
    if best == (0, 1, 2) or 2.0 * off[best] > off[(0, 1, 2)]:
        return ''
    axes = ', '.join('xyz'[best.index(axis)] for axis in range(3))
    return f'those of x, y and z seem to be given as those of {axes}'


def _inertia(cause: Cause, given: Given) -> Differing:
    """Return moments of inertia, and their order or their ratio to the mass."""
    before = np.array(given['package.inertia'][:3])
    moments = before * np.exp(cause.theta)
    factor, order = float(np.exp(-cause.theta[0])), order_of(before, moments)
    off = f'{factor:.3g} ± {factor * cause.std[0]:.2g} times the value that fits package.mass' if (
        np.ptp(cause.theta) < 3.0 * np.max(cause.std)) else 'wrong'
    found = f'{", ".join(f"{x:.3g}" for x in moments)} kg m^2 (ixx, iyy, izz)'
    return 'package.inertia', off, found + (order and f'; {order}')


def _com(cause: Cause, given: Given) -> Differing:
    """Return the significant shift of a centre of mass, and its position."""
    moved = np.where(np.abs(cause.theta) > 3.0 * cause.std, cause.theta, 0.0)
    off = ', '.join(f'{axis} {1e3 * x:+.2f} ± {1e3 * s:.2g} mm'
                    for axis, x, s in zip('xyz', moved, cause.std, strict=True) if x)
    return 'package.com', f'off by {off}', _listed(np.add(given['package.com'], moved))


def _length(cause: Cause, given: Given) -> Differing:
    """Return a length of the cup."""
    size, std = float(cause.theta[0]), float(cause.std[0])
    side = 'short' if size > 0.0 else 'long'
    return ('cup.length', f'{1e3 * abs(size):.3f} ± {1e3 * std:.2g} mm too {side}',
            f'{given["cup.length"] + size:.5f}')


def _gravity(cause: Cause, given: Given) -> Differing:
    """Return gravity.direction after a rotation about x and y."""
    angle = math.degrees(math.hypot(*cause.theta[:2].tolist()))
    doubt = ', or a hose or cable pulls at the package: these recordings cannot tell which' * (
        cause.instead == 'force')
    return 'gravity.direction', f'{angle:.1f} degrees off{doubt}', _down(
        given, lie.exp_so3(np.append(-cause.theta, 0.0)) @ alignment.DOWN)


def _marker(cause: Cause, given: Given) -> dict[str, Any]:
    """Return the shift and rotation of a marker frame, and the settings that correct it."""
    shift, angle = map(np.linalg.norm, np.split(cause.theta, [len(cause.theta) - 3]))
    by_rest = '' if given.get('recording.align_at_rest') else (
        ", or recording.align_at_rest: true if it is the tool's and the recording begins at rest")
    return {'shift': float(shift), 'angle': float(angle),
            'setting': f'fit.free: [package_marker]{by_rest}'}


def _down(given: Given, down: Array) -> str:
    """Return gravity.direction of a direction in the levelled world."""
    return _listed(
        alignment.levelling(given.get('gravity.direction', alignment.DOWN)).T @ down)


def _listed(values: Array) -> str:
    """Return a list with four decimals."""
    return f'[{", ".join(f"{x:.4f}" for x in np.round(values, 4) + 0.0)}]'


DIFFERING: Mapping[str, Callable[[Cause, Given], Differing]] = {
    'inertia': _inertia, 'com': _com, 'length': _length, 'gravity': _gravity,
    'gravity.direction': _gravity,
    'package.files': lambda cause, given: (cause.name, cause.value, 'the other order')}
"""Causes that are wrong parameters."""

MORE: Mapping[str, Callable[[Cause, Given], dict[str, Any]]] = {
    'time_offset': lambda cause, given: {
        'size': f'{1e3 * abs(cause.theta[0]):.3f} ± {1e3 * cause.std[0]:.2g} ms'},
    'exposure': lambda cause, given: {
        'time': body.EXPOSURE * math.sqrt(max(float(cause.theta[0]), 0.0))},
    'package_world': lambda cause, given: {
        'why': alignment.motion_words(cause.theta, cause.std)},
    'slip': lambda cause, given: {
        'position': math.hypot(*cause.theta[:2]), 'rotation': 0.0, 'at': float(cause.theta[-1])},
    'package_marker': _marker,
    'unknown': lambda cause, given: {
        'axis': cause.value, 'second': float(cause.theta[min(1, len(cause.theta) - 1)]),
        'band': ', at {:.1f} to {:.1f} Hz'.format(*cause.theta[2:4])
        if np.all(np.isfinite(cause.theta[2:4])) else ''}}
"""Numbers of other causes."""
