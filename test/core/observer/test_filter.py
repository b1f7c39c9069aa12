"""The filter against a dense one of its own making, by differences."""

from bellows_ros.core.geometry.tuples import (
    exp_quaternion,
    quaternion_product,
    rotation_matrix,
    ZERO,
)
from bellows_ros.core.model.cup_package import model_tuple
from bellows_ros.core.model.equilibrium import (
    largest_step,
    moved_by,
    pose_error,
    static_equilibrium,
)
from bellows_ros.core.model.kernels import law_of, model_row
from bellows_ros.core.observer import dynamics, states
from bellows_ros.core.observer import filter as ekf
from bellows_ros.core.observer.correction import first_memory
from bellows_ros.core.observer.measurement import (
    filter_step,
    innovation_of,
    MeasuredPose,
    NO_MEANS,
    observation,
    posterior,
    WHITE_SHARE,
)
from bellows_ros.core.observer.states import LARGEST
import numpy as np
import pytest

from .cases import CUP, error_of, later, PACKAGE, tool_motion, with_noise
from .cases import NOISE as NOISE_STD

SIZES = np.repeat(
    [0.003, 0.02, 0.05, 0.2, 0.05, 0.004, 0.3, 0.01, 0.1, 0.1, 0.02, 0.002, 0.02, 0.002, 0.02,
     0.005, 1.0, 0.3, 0.01],
    [3, 3, 3, 3, 1, 3, 3, 3, 6, 6, 3, 3, 3, 3, 3, 1, 6, 6, 1])
OF_MOTION = range(states.MARKER)
MEMORY = first_memory()
MEMORY[3:5] = 0.5 * MEMORY[1:3]
MEMORY[ekf.SHARE] = 0.0
FACTORS = np.array([1.0, 2.0])
NO_DRIVE = np.zeros((3, 12, 12))
BODY = False, 2e-3, 1e-2, ZERO, rotation_matrix((0.0, 0.0, 0.0, 1.0)), 0.0, 0.0
TAG = (True, 1e-4, 30.0, (0.3, 0.2, -0.7), rotation_matrix(exp_quaternion((0.2, -0.3, 0.1))),
       0.03, 0.0)

pytestmark = pytest.mark.xdist_group('kernels called from Python')  # compiled by one worker alone


def propagated(model, beginning, T, Q, samples, drive):
    """Propagate to the last sample, with the package that follows the tool written before."""
    step, last_ns = largest_step(model), samples[0][-1]
    ekf.followed(model_row(model), law_of(model), beginning, samples, 0, beginning[1], step, 1.0)
    return ekf.propagated(model, beginning, T, Q, samples, last_ns, step, drive, 0.0)


def test_errors_of_a_tag_persist_in_a_view():
    """Keep them at rest for any time with the noise of a robot's poses; not over a centimetre."""
    rng, still = np.random.default_rng(1), tool_motion(np.random.default_rng(1), 0.01)[1][0]
    bodies = [with_noise(rng, still, np.repeat([2e-5, 5e-5], 3)) for _ in range(31)]
    T, known = np.zeros((12, states.MARKER)), np.zeros((states.ROWS, states.ROWS))
    T[:12, :12] = np.eye(12)
    T[:6, 6:12] = 0.03 * np.eye(6)
    kept = [ekf.correlation_of_view(*pair, known, T)
            for pair in zip(bodies, bodies[1:], strict=False)]
    assert np.prod(kept) > 0.8  # after 1 s
    vague = known.copy()
    vague[6:12, 6:12] = np.diag(np.repeat([0.2, 1.0], 3) ** 2)
    for swing in np.diag(np.repeat([0.01, 0.05], 3)):
        other = moved_by(still, np.r_[swing, np.zeros(6)])
        assert ekf.correlation_of_view(still, other, known, T) < 1e-9
        assert ekf.correlation_of_view(still, other, vague, T) == 1.0


@pytest.mark.parametrize('is_off', [False, True])
def test_transition_is_that_by_differences(is_off):
    """Carry an error for 1 ms as the difference of two packages goes on, and its covariance."""
    rng = np.random.default_rng(1)
    stamps, tool = tool_motion(rng, 0.3, period_ns=1_000_000)
    model, h = model_tuple(CUP, PACKAGE, 9.81), 1e-3
    theta = rng.normal(size=states.ROWS - 12) * SIZES[12:] * 0.5 * is_off
    start, end = tool[250:252]
    body = moved_by(static_equilibrium(model, start), rng.normal(size=12) * 0.01)
    drive = dynamics.driving(model, start, body, np.repeat([1e-4, 5e-4], 3))
    rows = [np.array([[*o, *q, *v, *w]] * 2) for o, q, v, w in (start, end, end)]
    T, Q = ekf.identity_transition(), np.zeros((12, 12))
    _, found = propagated(
        model, (stamps[250], start, body, theta), T, Q, (stamps[250:252], *rows, 2), drive)
    middle = later(body, theta, start, end, h)
    np.testing.assert_allclose(error_of(middle, found), 0.0, atol=2e-6)
    F, memory, step = np.eye(states.ROWS), MEMORY, 1e-4
    for row in OF_MOTION:
        ends = []
        for sign in (step, -step):
            by = np.zeros(states.ROWS)
            by[row] = sign * SIZES[row]
            ends.append(later(moved_by(body, by[:12]), theta + by[12:], start, end, h))
        F[:12, row] = (error_of(middle, ends[0]) - error_of(middle, ends[1])) / (
            2 * step * SIZES[row])
    noise = range(states.NOISE, states.NOISE + 6)
    F[noise, noise] = kept = 0.5 ** (h / memory[0])
    scale = SIZES[None] / SIZES[:, None]
    np.testing.assert_allclose(
        T * scale[:12, OF_MOTION], (F * scale)[:12, OF_MOTION], atol=5e-4)
    P, walk = np.diag(SIZES**2), np.arange(12.0) * 1e-4
    of_rows = np.zeros(states.ROWS)
    half = np.zeros((states.ROWS, states.ROWS))
    walks = [*range(states.WRENCH, states.WRENCH + 6), *range(states.CAMERA, states.CAMERA + 6)]
    half[walks, walks] = h / 2 * walk
    of_rows[walks] = walk
    half[:12, :12] = h * h / 2 * drive[0]
    dense = F @ (P + half) @ F.T + half
    dense[noise, noise] += (1.0 - kept**2) * np.repeat(FACTORS, 3)
    own = ekf.propagated_covariance(
        P, T, Q, h, of_rows, ekf.correlations(memory, h), FACTORS)
    np.testing.assert_allclose(
        own / np.outer(SIZES, SIZES), dense / np.outer(SIZES, SIZES), atol=1e-3)


@pytest.mark.parametrize('row', [states.STIFFNESS, states.DAMPING])
def test_transition_of_a_cup_that_is_much_stiffer_is_stable(row):
    """Let an error fade within 0.4 s, though steps are as long as the nominal cup allows."""
    stamps, tool = tool_motion(np.random.default_rng(1), 0.4, period_ns=8_000_000)
    model, theta = model_tuple(CUP, PACKAGE, 9.81), np.zeros(states.ROWS - 12)
    theta[row - 12:row - 6] = 2.5
    body = static_equilibrium(dynamics.with_theta(model, theta), tool[0])
    rows = [np.array([[*o, *q, *v, *w] for o, q, v, w in states])
            for states in ([tool[0], *tool[:-1]], tool, tool)]
    T = ekf.identity_transition()
    propagated(model, (stamps[0], tool[0], body, theta), T, np.zeros((12, 12)),
               (stamps, *rows, len(stamps)), NO_DRIVE)
    assert np.abs(np.linalg.eigvals(T[:12, :12])).max() < 1.0


@pytest.mark.parametrize(('of_lip', 'sensor'), [(False, BODY), (True, BODY), (False, TAG)])
def test_innovations_agree_with_their_covariance(of_lip, sensor):
    """Make of a small error in each row what its derivative says, by differences."""
    rng = np.random.default_rng(2)
    _, tool = tool_motion(rng, 0.3)
    model, noise = model_tuple(CUP, PACKAGE, 9.81), np.diag(NOISE_STD**2)
    body = moved_by(static_equilibrium(model, tool[60]), rng.normal(size=12) * 0.01)
    none, P = np.zeros(states.ROWS - 12), np.diag(SIZES**2)
    marker = ZERO, (0.0, 0.0, 0.0, 1.0), of_lip

    def pose(e):
        """Give the pose that a camera sees of a package with an error (n,)."""
        seen = moved_by(body, np.r_[-e[states.LATENCY] * np.r_[body[2], body[3]], np.zeros(6)])
        seen = moved_by(seen, np.r_[e[:6], np.zeros(6)])
        seen = moved_by(seen, np.r_[e[states.MARKER:states.MARKER + 6], np.zeros(6)])
        if of_lip:
            com = PACKAGE.com + e[states.COM:states.COM + 3]
            seen = moved_by(seen, np.r_[-com, np.zeros(9)])
        noise_of_pose = np.sqrt(1 - WHITE_SHARE) * NOISE_STD * e[states.NOISE:states.NOISE + 6]
        seen = moved_by(seen, np.r_[noise_of_pose, np.zeros(6)])
        shift, turn = np.split(e[states.CAMERA:states.CAMERA + 6], 2)
        shift = shift + np.cross(turn, seen[0])
        turn = exp_quaternion(tuple(turn.tolist()))
        return tuple((seen[0] + shift).tolist()), quaternion_product(turn, seen[1])

    def seen(e):
        step = filter_step(
            model_row(model), law_of(model), (0, tool[60], body, none, P.copy(), MEMORY),
            (np.zeros(1, int), *np.zeros((3, 1, 25)), 1), 0, 1.0,
            (NO_DRIVE, np.zeros(states.ROWS), False),
            MeasuredPose(*pose(e), noise, (*marker, sensor), 1.0, LARGEST, np.inf,
                         NO_MEANS, np.ones(4)),
            False, False)
        z, W = step.z, step.whitener
        H = observation(states.ROWS, step.exposed, np.diag(NOISE_STD), of_lip, WHITE_SHARE)
        root = np.linalg.inv(W)
        return root @ z, H, root

    _, H, root = seen(np.zeros(states.ROWS))
    v = np.r_[body[2], body[3]]
    own = WHITE_SHARE * noise + MEMORY[ekf.JITTER] * np.outer(v, v)
    turned = root @ root.T - H @ P @ H.T
    if not sensor[0]:
        np.testing.assert_allclose(np.trace(turned), np.trace(own), rtol=0.1)
    for row in range(states.ROWS):
        e = np.zeros(states.ROWS)
        e[row] = 1e-4 * SIZES[row]
        slope = (seen(e)[0] - seen(-e)[0]) / 2e-4
        if of_lip and (0 <= row - states.NOISE < 6 or 3 <= row - states.MARKER < 6) or (
                sensor[0] and 0 <= row - states.NOISE < 6):
            continue  # turns about the marker, not about B; noise of corners, not of a pose
        np.testing.assert_allclose(
            slope / NOISE_STD, H[:, row] * SIZES[row] / NOISE_STD, atol=2e-3)


@pytest.mark.parametrize('updates', [400, pytest.param(500_000, marks=pytest.mark.stress)])
def test_covariance_stays_positive_definite_after_very_many_updates(updates):
    """Take in measurements without noise to speak of and ones with, turn and turn about."""
    rng = np.random.default_rng(2)
    model = model_tuple(CUP, PACKAGE, 9.81)
    tool = ((0.0, 0.0, 0.5), (0.0, 0.0, 0.0, 1.0), (0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
    body = own = static_equilibrium(model, tool)
    theta, P = np.zeros(states.ROWS - 12), np.diag(SIZES**2)
    T, Q = ekf.identity_transition(), np.zeros((12, 12))
    rows = [np.array([[*o, *q, *v, *w]] * 2) for o, q, v, w in (tool,) * 3]
    propagated(model, (0, tool, body, theta), T, Q, (np.array([0, 1_000_000]), *rows, 2), NO_DRIVE)
    seen = [(noise, *with_noise(rng, body, NOISE_STD * np.sqrt(noise))[:2])
            for noise in (1e-8, 1.0, 1e-4, 1.0, 1e-6) for _ in range(20)]
    walk = np.full(states.ROWS, 1e-12)
    for k in range(updates):
        P = ekf.propagated_covariance(
            P, T, Q, 1e-3, walk, ekf.correlations(MEMORY, 1e-3), np.ones(2))
        scale, *pose = seen[37 * k % len(seen)]
        noise, difference = np.diag(NOISE_STD**2) * scale, np.ravel(pose_error(own, *pose))
        found = innovation_of(
            own, theta, P, difference, np.sqrt(noise), noise,
            (ZERO, (0.0, 0.0, 0.0, 1.0), False, BODY), 4e-6)
        possible, own, theta = posterior(own, theta, P, found, LARGEST)
        assert possible
    scale = np.sqrt(np.diag(P))
    assert np.linalg.eigvalsh(P / np.outer(scale, scale))[0] > 0.0
    np.testing.assert_array_equal(P, P.T)
