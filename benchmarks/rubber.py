"""
A rubber cup outside the model of this package, and the predictions of fits to its recordings.

Rubber has a nearly constant loss factor. Five branches with successive time constants approximate
this over three decades, each integrated separately. `python -m benchmarks.rubber` prints the table
of docs/evidence.md.
"""

from collections.abc import Callable
from typing import Any

from bellows_ros.core.geometry import lie
from bellows_ros.core.geometry.arrays import Array
from bellows_ros.core.geometry.jit import entry, kernel
from bellows_ros.core.geometry.lie import exp_so3, log_so3, quaternion_to_rotation
from bellows_ros.core.geometry.tuples import add, add_scaled, apply, rotation_matrix, scale
from bellows_ros.core.identification.fitting import fit
from bellows_ros.core.identification.result import Fit
from bellows_ros.core.identification.unknowns import payload_of
from bellows_ros.core.model import kernels
from bellows_ros.core.model.cup_package import Cup, model_tuple, Package
from bellows_ros.core.model.equilibrium import largest_step, static_equilibrium
from bellows_ros.core.model.simulation import row_state, simulate, state_row, tool_rows, write_row
from bellows_ros.core.model.structure import RELAXATION_TIMES
from bellows_ros.core.parameters.checks import resolve
from bellows_ros.core.recording.preparation import prepare
from bellows_ros.core.recording.recording import PrepareSettings, Recording
from bellows_ros.core.signals.trajectory import PoseStream, Trajectory
from bellows_ros.core.synthetic.motion import smooth_step
import numpy as np

TIMES = np.array([0.006, 0.03, 0.15, 0.7, 3.0])
"""Time constants of the branches, s."""

CUP = Cup(np.diag([4200.0, 4200.0, 7200.0, 3.2, 3.2, 1.05]),
          np.diag([8.0, 8.0, 8.0, 0.008, 0.008, 0.01]), 0.046)
"""Static stiffness, and a small damping besides the branches."""

PLATE = Package(1.8, np.diag([0.00438, 0.00654, 0.00984]), (0.0, 0.0, -0.03))
GRAVITY = 9.81
RUNS = 40

Path = Callable[[Array], Array]
"""Function from times (N,), s, to position (m) and rotation vector (rad) of the tool (N, 6)."""


def step(t: Array, start: float, duration: float) -> Array:
    """Return a smooth step from 0 to 1."""
    return np.asarray(smooth_step((t - start) / duration)[0])


def driven(path: Path, seconds: float, rate_hz: float = 360.0) -> Trajectory:
    """Return a path as a trajectory with twists."""
    stamps = np.round(np.arange(int(seconds * rate_hz)) * 1e9 / rate_hz).astype(np.int64)
    t, h = stamps * 1e-9, 1e-5
    x, rate = path(t), (path(t + h) - path(t - h)) / (2.0 * h)
    R = exp_so3(x[:, 3:])
    return Trajectory(stamps + 10**9, x[:, :3], R, np.hstack([
        lie.apply(np.swapaxes(R, 1, 2), rate[:, :3]),
        lie.apply(lie.dexp(-x[:, 3:]), rate[:, 3:])]))


def strengths(loss_factor: float) -> Array:
    """Return the strengths of the branches (5,) for an approximately constant loss factor."""
    per_branch = loss_factor * np.log(TIMES[1] / TIMES[0]) / (0.5 * np.pi)
    r, modulus = np.zeros(5), 1.0
    for b in range(4, -1, -1):  # the slowest first: each has its part of what is stiff below it
        r[b] = per_branch * modulus / (1.0 - 0.5 * per_branch)
        modulus += r[b]
    return r


@kernel
def _rates(model: Any, r: Any, tau: Any, tool: Any, body: Any, z: Array, dz: Array) -> Any:
    """Return the rate of the body twist, and write those of the internal strains (5, 6)."""
    cup, package, gravity = model
    R_A_B = rotation_matrix(body[1])
    o_E_S, R, v, w = kernels.lip_relative_to_tool(package[1], tool, body)
    o, l1 = kernels.spring_frames(cup, o_E_S, R), cup[0]
    a, b = kernels.strain(o, R)
    h = np.array([a[0], a[1], a[2], b[0], b[1], b[2]])
    g = h.copy()
    for k in range(5):
        dz[k] = (h - z[k]) / tau[k]
        g += r[k] * (h - z[k])
    f, m = kernels.stress_wrench(o, R, kernels.multiply_blocks(
        cup[2], (g[0], g[1], g[2]), (g[3], g[4], g[5])))
    d, n = kernels.damper_wrench(o, R, (v[0] + l1 * w[1], v[1] - l1 * w[0], v[2]), w, cup[3])
    f, m = add(f, d), add(m, n)
    f, m = kernels.wrench_at_com(package[1], f, (m[0] - l1 * f[1], m[1] + l1 * f[0], m[2]))
    return kernels.newton_euler(package, gravity, R_A_B, body[2], body[3], f, m)


@entry
def _simulate(
    model: Any, r: Any, tau: Any, body: Any, rows: Array, durations: Array, count: int, out: Array
) -> None:
    """Write the package's rows, starting at rest, by RK4 of everything."""
    z, dz = np.zeros((5, 6)), np.zeros((5, 6))
    _rates(model, r, tau, row_state(rows[0]), body, z, dz)
    for k in range(5):
        z[k] = dz[k] * tau[k]  # h, as z was zero
    write_row(out[0], body)
    for k in range(len(durations)):
        segment = kernels.tool_segment(row_state(rows[k]), row_state(rows[k + 1]), durations[k])
        h = durations[k] / count
        for i in range(count):
            o = s = v = w = sum_o = sum_s = sum_v = sum_w = (0.0, 0.0, 0.0)
            dz, sum_z = np.zeros((5, 6)), np.zeros((5, 6))
            for stage in range(4):
                at, weight = 0.5 * ((stage + 1) // 2), 1.0 if stage % 3 == 0 else 2.0
                b = kernels.stage_state(body, at * h, o, s, v, w)
                o = apply(rotation_matrix(b[1]), b[2])
                s = kernels.rotation_rate(scale(at * h, s), b[3])
                tool = kernels.tool_at(segment, (i + at) / count)
                v, w = _rates(model, r, tau, tool, b, z + at * h * dz, dz)
                sum_o, sum_s = add_scaled(sum_o, weight, o), add_scaled(sum_s, weight, s)
                sum_v, sum_w = add_scaled(sum_v, weight, v), add_scaled(sum_w, weight, w)
                sum_z += weight * dz
            body = kernels.stage_state(body, h / 6.0, sum_o, sum_s, sum_v, sum_w)
            z = z + h / 6.0 * sum_z
        write_row(out[k + 1], body)


def rubber_moves(loss_factor: float, tool: Trajectory) -> Trajectory:
    """Return the true motion of the plate under a tool, from rest."""
    model = model_tuple(CUP, PLATE, GRAVITY)
    rows, durations = tool_rows(tool), np.diff(tool.stamps_ns) * 1e-9
    start = static_equilibrium(model, state_row(rows[0, :3], rows[0, 3:7]))
    out = np.empty((len(rows), 13))
    count = int(np.ceil(durations.max() / (0.5 * largest_step(model))))
    _simulate(model, strengths(loss_factor), TIMES, start, rows, durations, count, out)
    return Trajectory(tool.stamps_ns, out[:, :3], quaternion_to_rotation(out[:, 3:7]), out[:, 7:])


def multisine(seed: int, seconds: float = 20.0, hold: float = 7.0, tilt: float = 0.31) -> Path:
    """Return lines of 0.3 to 5 Hz in all axes, then a hold of a tilt about x and about y."""
    rng = np.random.default_rng(seed)
    frequency = np.array([0.35, 1.2, 2.6, 4.4]) * rng.uniform(0.85, 1.15, (6, 4))
    phase = rng.uniform(0.0, 2.0 * np.pi, (6, 4))
    size = np.array([[0.05, 0.05, 0.05, 0.15, 0.15, 0.2], [0.01, 0.01, 0.012, 0.05, 0.05, 0.15],
                     [0.002, 0.002, 0.004, 0.012, 0.012, 0.05],
                     [8e-4, 8e-4, 3e-3, 3e-3, 3e-3, 0.01]]).T

    def path(t: Array) -> Array:
        shake = step(t, 1.0, 1.5) - step(t, seconds - 1.5, 1.5)
        x = shake[:, None] * np.sum(
            size * np.sin(2.0 * np.pi * frequency * t[:, None, None] + phase), axis=2)
        held = step(t, seconds, 0.8) - step(t, seconds + hold, 0.8)
        x[:, 3:5] += tilt * held[:, None] * np.sqrt(0.5)
        return x

    return path


def slow_carry(t: Array) -> Array:
    """Return a slide of 0.5 m in 5 s with a tilt of 15 degrees."""
    tilt = np.radians(15.0) * (step(t, 0.5, 1.5) - step(t, 8.0, 1.5))
    return np.outer(0.5 * step(t, 2.5, 5.0), [1.0, 0, 0, 0, 0, 0]) + np.outer(
        tilt, [0, 0, 0, 0, 1.0, 0])


def recorded(loss_factor: float, seed: int, path: Path, seconds: float) -> Recording:
    """Return the prepared recording of a path; package noise of 0.1 mm and 0.5 mrad."""
    rng, tool = np.random.default_rng(seed), driven(path, seconds)
    body = rubber_moves(loss_factor, tool)
    streams = [PoseStream(
        name, 'world', motion.stamps_ns, motion.position + o * rng.standard_normal((len(tool), 3)),
        motion.rotation @ exp_so3(phi * rng.standard_normal((len(tool), 3))))
        for name, motion, o, phi in (('tool', tool, 2e-5, 5e-5), ('package', body, 1e-4, 5e-4))]
    return prepare(*streams, PrepareSettings(payload=PLATE, gravity=GRAVITY))


def error(fit: Fit, loss_factor: float, path: Path, seconds: float) -> float:
    """Return the RMS error of the bending predicted by a fit, relative to the RMS bending."""
    tool, free = driven(path, seconds), {name: row[0] for name, row in fit.nuisances.items()}
    cup = Cup(fit.stiffness, fit.damping, CUP.length + float(free.get('length', [0.0])[0]),
              fit.law['relaxation'])
    true, found = (log_so3(np.swapaxes(tool.rotation, 1, 2) @ body.rotation) for body in (
        rubber_moves(loss_factor, tool),
        simulate(cup, payload_of(PLATE, free), tool, gravity=GRAVITY)))
    return float(np.linalg.norm(found - true) / np.linalg.norm(true))


VALIDATIONS: dict[str, tuple[Path, float]] = {
    'multisine, 0.3 to 5 Hz': (multisine(9, hold=0.0, tilt=0.0), 20.0),
    'transport of 0.6 m in 0.6 s': (
        lambda t: np.outer(0.6 * step(t, 1.0, 0.6), [1.0, 0, 0, 0, 0, 0]), 4.0),
    'slow carry at 15 degrees': (slow_carry, 10.0), 'hold of 20 degrees, 7 s': (
        lambda t: np.outer(np.radians(20.0) * step(t, 0.5, 0.8), [0, 0, 0, 1.0, 0, 0]), 8.3)}


def stiffening(strength: Array, times: Array, frequency: float) -> complex:
    """Return the complex stiffness over the static one at a frequency (Hz), without damping."""
    s = 2j * np.pi * frequency * np.asarray(times)
    return complex(1.0 + np.sum(np.asarray(strength) * s / (1.0 + s)))


def identified(recording: Recording, relaxation: str) -> Fit:
    """Return the fit to a recording with fit.relaxation auto or off."""
    values = resolve({
        'fit.method': 'output_error', 'fit.relaxation': relaxation, 'cup.length': CUP.length,
        'package.mass': PLATE.mass, 'package.com': PLATE.com.tolist(),
        'package.inertia': [*np.diag(PLATE.inertia).tolist(), 0.0, 0.0, 0.0]})
    return fit([recording], values)


def study(loss_factor: float, seed: int = 1) -> tuple[dict[str, Fit], dict[str, list[float]]]:
    """Return fits to a multisine with one hold, and the relative errors of each."""
    recording = recorded(loss_factor, seed, multisine(seed), 30.0)
    fits = {name: identified(recording, name) for name in ('off', 'auto')}
    return fits, {name: [error(own, loss_factor, *motion) for own in fits.values()]
                  for name, motion in VALIDATIONS.items()}


def main() -> None:
    """Print the table, and the number of cups without relaxation in which one is found."""
    for loss_factor in (0.05, 0.10):
        fits, errors = study(loss_factor)
        print(f'loss factor {loss_factor:g}')
        for name, (before, after) in errors.items():
            print(f'  {name:30} {before:8.1%} {after:8.1%}')
        true = abs(stiffening(strengths(loss_factor), TIMES, 2.0))
        found = abs(stiffening(fits['auto'].law['relaxation'], RELAXATION_TIMES, 2.0))
        print(f'  stiffness at 2 Hz over static: {found:.3f}, true {true:.3f}; static K rx: '
              f'{fits["auto"].stiffness[3, 3]:.3f}, without relaxation '
              f'{fits["off"].stiffness[3, 3]:.3f}, true {CUP.stiffness[3, 3]:.3f}')
    relaxing = sum(any(identified(recorded(0.0, seed, multisine(seed, 8.0, 4.0), 14.0), 'auto')
                       .law['relaxation']) for seed in range(RUNS))
    print(f'found in {relaxing} of {RUNS} cups that do not relax')


if __name__ == '__main__':
    main()
