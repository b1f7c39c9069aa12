"""The library: what `import bellows_ros` offers, by its own examples."""

import doctest
from functools import partial
import inspect
import json
import subprocess
import sys
import time

import bellows_ros
from bellows_ros.core.live import Predictor
from bellows_ros.errors import BellowsError
import numpy as np
from numpy.testing import assert_allclose
import pytest
from scipy.spatial.transform import Rotation

WITHOUT_EXAMPLE = {'BellowsError', 'Prediction'}  # what others raise and return


@pytest.mark.parametrize('name', bellows_ros.__all__)
def test_examples_print_what_they_show(root, tmp_path, monkeypatch, name):
    """Run the examples of every public name, as a user at the top of a checkout would."""
    monkeypatch.chdir(root)
    names = {'bellows_ros': bellows_ros, 'np': np, 'folder': tmp_path}
    item = getattr(bellows_ros, name)
    text = doctest.DocTestParser().get_doctest(item.__doc__ or '', names, name, None, 0)
    assert bool(text.examples) == (name not in WITHOUT_EXAMPLE)
    runner = doctest.DocTestRunner()
    report = []
    runner.run(text, out=report.append)
    assert runner.failures == 0, ''.join(report)


def test_importing_it_loads_no_numbers(user_environment):
    """Load what takes long only when it is asked for."""
    code = ("import sys, bellows_ros; print('numpy' in sys.modules, dir(bellows_ros) == "
            "bellows_ros.__all__); bellows_ros.Cup; print('numpy' in sys.modules)")
    done = subprocess.run(
        [sys.executable, '-c', code], env=user_environment, capture_output=True, text=True)
    assert done.stdout == 'False True\nTrue\n', done.stderr


def test_a_cup_is_identified_from_arrays():
    """Find the cup that a simulated motion was made with, from its poses alone."""
    rng = np.random.default_rng(3)
    cup = bellows_ros.Cup(
        np.diag([5400, 5400, 9200, 4.2, 4.2, 1.35]), np.diag([55, 55, 24, 0.06, 0.06, 0.1]), 0.046)
    package = bellows_ros.Package(1.8, np.diag([0.00438, 0.00654, 0.00984]), (0.0, 0.0, -0.03))
    t = np.arange(8000) / 400
    wave = np.array([np.sin(2 * np.pi * f * t) - np.sin(2 * np.pi * 0.5 * f * t)
                     for f in (0.9, 1.1, 4.1, 1.3, 1.7, 2.3)]).T
    size = (1 - np.exp(-t))[:, None] * wave * (0.05, 0.05, 0.01, 0.12, 0.12, 0.2)
    tool = bellows_ros.savgol(bellows_ros.Trajectory(
        np.round(t * 1e9).astype(int), size[:, :3],
        Rotation.from_rotvec(size[:, 3:]).as_matrix()), 8, 6)
    held = bellows_ros.simulate(cup, package, tool)
    pair = tuple(
        bellows_ros.Trajectory(
            poses.stamps_ns, poses.position + rng.normal(scale=1e-5, size=(len(poses), 3)),
            poses.rotation, valid=np.arange(len(poses)) != 77)
        for poses in (tool, held))
    result = bellows_ros.identify([pair], package, 0.046, {'fit.method': 'least_squares'})
    assert not result.refusals
    assert_allclose(np.diag(result.cup.stiffness), np.diag(cup.stiffness), rtol=0.02)
    assert_allclose(np.diag(result.cup.damping), np.diag(cup.damping), rtol=0.1)


TOSSING = 'bags/tossing.yaml'


@pytest.mark.parametrize('make', [
    lambda: bellows_ros.plan('bags/transport.yaml', TOSSING),
    lambda: bellows_ros.steer('bags/transport.yaml', TOSSING, 'zvd'),
    lambda: bellows_ros.toss('bags/throw.yaml', TOSSING, release=3.0),
    lambda: bellows_ros.replay('bags/validation', TOSSING),
    lambda: bellows_ros.identify(
        'bags/validation', bellows_ros.read_package(TOSSING), 0.046,
        {'recording.package_frame': 'com', 'fit.method': 'least_squares'}),
], ids=['plan', 'steer', 'toss', 'replay', 'identify'])
def test_a_result_draws_and_writes_itself(root, tmp_path, monkeypatch, make):
    """Make a figure with something in it, and a file of all numbers."""
    pytest.importorskip('matplotlib', reason="no matplotlib here (pip install '.[plot]')")
    monkeypatch.chdir(root)
    found = make()
    figure = found.plot()
    assert figure.axes
    assert all(panel.has_data() for panel in figure.axes)
    found.to_json(tmp_path / 'found.json')
    content = json.loads((tmp_path / 'found.json').read_text())
    assert {*found.as_json(), 'version'} == set(content)
    assert content['version'] == bellows_ros.__version__


def test_a_motion_in_arrays_is_planned_as_its_file(root):
    """Predict the same of the poses of a plan as of the plan."""
    parameters = bellows_ros.read_parameters(root / TOSSING)
    of_file = bellows_ros.plan(root / 'bags/transport.yaml', parameters)
    of_arrays = bellows_ros.plan(of_file.source.tool, parameters)
    expected, found = (each.prediction.summary() for each in (of_file, of_arrays))
    assert found == pytest.approx(expected, rel=1e-9)


CUP, PACKAGE = bellows_ros.Cup.thesis(), bellows_ros.Package(1.0, 0.01 * np.eye(3), (0, 0, -0.03))
SOFT = bellows_ros.Cup(-CUP.stiffness, CUP.damping, CUP.length)
STILL = bellows_ros.Trajectory(
    [0, 1_000_000], np.zeros((2, 3)), Rotation.identity(2), np.zeros((2, 6)))


@pytest.mark.parametrize(('call', 'named'), [
    (lambda: bellows_ros.identify('bags/identification', PACKAGE, 0.046), 'frame. Set it, or'),
    (lambda: bellows_ros.identify(1, PACKAGE, 0.046), 'recordings .* PathLike'),
    *((partial(bellows_ros.identify, each, PACKAGE, 0.046, {'recording.package_frame': 'com'}), '')
      for each in ([], [3], [('a', 'b')], 'no_such_bag')),
    *((partial(bellows_ros.static_equilibrium, CUP, PACKAGE, T), 'T_world_tool') for T in (
        np.eye(3), 2.0 * np.eye(4), np.full((4, 4), np.nan), np.diag([1.0, 1.0, -1.0, 1.0]),
        np.vstack([np.eye(4)[:3], [5.0] * 4]), 'abc', Rotation.identity())),
    (lambda: bellows_ros.read_cup('bags/package.yaml'), r'cup\.stiffness, cup\.damping'),
    (lambda: bellows_ros.plan('plan.yaml', bellows_ros.parameters_of(CUP)),
     r'package\.mass.*parameters_of'),
    (lambda: bellows_ros.simulate(SOFT, PACKAGE, STILL), 'cup.stiffness'),
    (lambda: bellows_ros.static_equilibrium(SOFT, PACKAGE), 'cup.stiffness'),
    (lambda: bellows_ros.static_equilibrium(CUP, bellows_ros.Package(
        1.8, bellows_ros.box_inertia(1.8, 0.2, 0.16, 0.06), (0.0, 0.0, -30.0))), 'package.com'),
    (lambda: bellows_ros.observe('bags/validation', TOSSING, 'x'), 'the topic .* /package/pose'),
    (lambda: bellows_ros.observe('bags/validation', TOSSING, ''), 'topic'),
    (lambda: bellows_ros.replay([1], TOSSING), 'recording'),
    (lambda: bellows_ros.plan(1, TOSSING), 'motion .* Trajectory'),
    (lambda: bellows_ros.simulate(CUP, PACKAGE, None), 'tool'),
])
def test_arguments_that_are_wrong_are_named(root, monkeypatch, call, named):
    """Name them as they are called here, not as options of the command line."""
    monkeypatch.chdir(root)
    with pytest.raises(BellowsError, match=named or None):
        call()


MATRIX = np.eye(3)
IN = {'cup': CUP, 'package': PACKAGE, 'gravity': 9.81}
PLAN = {'motion': 'bags/throw.yaml', 'parameters': TOSSING, 'urdf': '', 'topic': ''}
POSE = {'stamp_ns': 8_000_000, 'frame_id': 'world', 'position': (0.0, 0.0, 0.5),
        'quaternion_xyzw': (0.0, 0.0, 0.0, 1.0), 'arrival_ns': 8_000_000}
RIGHT = {
    'Cup': {'stiffness': CUP.stiffness, 'damping': CUP.damping, 'length': CUP.length,
            'relaxation': (0.0, 0.0), 'relaxation_times': (0.1, 1.0), 'stretch': (0.0, 0.0)},
    'Package': {'mass': 1.0, 'inertia': 0.01 * MATRIX, 'com': (0.0, 0.0, -0.03)},
    'Trajectory': {'stamps_ns': [0, 1_000_000], 'position': np.zeros((2, 3)),
                   'rotation': np.tile(MATRIX, (2, 1, 1)), 'twist': np.zeros((2, 6)),
                   'acceleration': np.zeros((2, 6)), 'valid': [True, True]},
    'box_inertia': {'mass': 1.8, 'depth': 0.2, 'width': 0.16, 'height': 0.06},
    'identify': {'recordings': 'bags/validation', 'package': PACKAGE, 'cup_length': 0.046,
                 'settings': {}},
    'parameters_of': {'cup': CUP, 'package': PACKAGE},
    'read_cup': {'path': 'bags/cup.yaml'}, 'read_package': {'path': 'bags/cup.yaml'},
    'read_parameters': {'path': 'bags/cup.yaml', 'node': 'predictor'},
    'savgol': {'trajectory': bellows_ros.Trajectory(
        np.arange(40) * 10**6, np.zeros((40, 3)), Rotation.identity(40)),
        'half_window': 8, 'order': 4, 'is_tapered': False},
    'simulate': {**IN, 'tool': STILL},
    'static_equilibrium': {**IN, 'T_world_tool': np.eye(4)},
    'write_cup': {'path': '/dev/null', 'cup': CUP, 'package': PACKAGE},
    'write_parameters': {'path': '/dev/null', 'values': {}, 'header': ()},
    'plan': PLAN, 'fastest': PLAN, 'steer': {**PLAN, 'method': 'zvd', 'limits': ''},
    'toss': {**PLAN, 'release': 3.0, 'target': (1.0, 0.0)},
    'replay': {'recording': 'bags/validation', 'parameters': TOSSING},
    'observe': {'recording': 'bags/validation', 'parameters': TOSSING, 'topic': 'x'},
    'LivePredictor': {**IN, 'twist_frame': 'world', 'coast_limit_ns': 10**8},
    'LivePredictor.from_parameters': {'parameters': {}},
    'LivePredictor.covariance': {'stamp_ns': 0}, 'LivePredictor.phase': {'arrival_ns': 0},
    'LivePredictor.is_ok_at': {'arrival_ns': 0}, 'LivePredictor.coast': {'arrival_ns': 0},
    'LivePredictor.set_parameters': {'parameters': {}}, 'LivePredictor.use': {'values': {}},
    'LivePredictor.reset': {'reason': 'gap'}, 'LivePredictor.flush': {},
    'LivePredictor.expect_twists': {'expected': True},
    'LivePredictor.set_attached': {'attached': True},
    'LivePredictor.on_valve': {'on': True, 'stamp_ns': 0},
    'LivePredictor.on_vacuum': {'held': True, 'stamp_ns': 0, 'cup': -1},
    'LivePredictor.on_pressure': {'pressure': 1e5, 'frame_id': ''},
    'LivePredictor.on_pose': POSE,
    'LivePredictor.on_measured': {**POSE, 'covariance': np.eye(6)},
    'LivePredictor.on_twist': {'stamp_ns': 0, 'linear': (0.0,) * 3, 'angular': (0.0,) * 3,
                               'frame_id': None},
    'LivePredictor.on_wrench': {'stamp_ns': 0, 'frame_id': 'world', 'force': (0.0,) * 3,
                                'moment': (0.0,) * 3},
    'LivePredictor.watch': {'prediction': None}}
"""Arguments of every public function and method, and of the constructors that users call."""

WRONG = (10**400, object(), 1j, 1j * np.eye(6), np.ma.masked_array(np.eye(6), np.eye(6) > 0.0),
         [], {}, b'x', [['a']], {'a': 1j}, [10**400], float('nan'), np.zeros(0))


def public_function(name):
    """Return a function of the library, or a method of a predictor, by its name."""
    owner, _, method = name.partition('.')
    if not method:
        return getattr(bellows_ros, owner)
    return getattr(bellows_ros.LivePredictor(CUP, PACKAGE, 9.81), method)


def test_all_public_functions_are_tested_for_wrong_arguments():
    methods = {f'LivePredictor.{name}' for name in dir(bellows_ros.LivePredictor)
               if not name.startswith('_') and callable(getattr(bellows_ros.LivePredictor, name))}
    assert {*RIGHT} == {*bellows_ros.__all__, *methods} - WITHOUT_EXAMPLE
    for name, arguments in RIGHT.items():
        assert {*arguments} == {*inspect.signature(
            public_function(name)).parameters} - {'is_checked'}, name


@pytest.mark.parametrize(('name', 'argument'), [
    (name, argument) for name, arguments in RIGHT.items() for argument in arguments])
def test_an_argument_of_any_other_form_is_refused(root, monkeypatch, name, argument):
    """Put each wrong value in place of each argument of each public function."""
    monkeypatch.chdir(root)
    function = public_function(name)
    hint = str(inspect.signature(function).parameters[argument].annotation)
    for value in WRONG:
        is_right = isinstance(value, int) and 'int' in hint or isinstance(
            value, dict) and 'Mapping' in hint
        if not is_right:
            with pytest.raises(BellowsError):
                function(**{**RIGHT[name], argument: value})


def test_checks_of_a_pose_cost_little():
    """Compare with the predictor of the nodes, in turns: 1.15 times its time, 3.2 before."""
    own, checked = (cls(CUP, PACKAGE, 9.81) for cls in (Predictor, bellows_ros.LivePredictor))
    durations = {own: list[int](), checked: list[int]()}
    for number in range(600):
        stamp_ns = 2_000_000 * number
        for predictor, found in durations.items():
            begin = time.perf_counter_ns()
            predictor.on_pose(
                stamp_ns, 'world', (1e-4 * number, 0.0, 0.5), (0.0, 0.0, 0.0, 1.0), stamp_ns)
            found.append(time.perf_counter_ns() - begin)
    assert np.median(durations[checked]) < 1.4 * np.median(durations[own])
