"""Identification from recordings of known cups: results, freed quantities, and shared work."""

from dataclasses import replace
import json

from bellows_ros.core.parameters.checks import resolve
from bellows_ros.errors import BellowsError, UnexplainedError
from bellows_ros.files.bags import Encoded, read_streams, write_bag
from bellows_ros.files.messages import BOOL, HEAD
from bellows_ros.files.parameter_files import read_parameters, write_parameters
from bellows_ros.files.results import format_json
from bellows_ros.workflows.holds import masks_held
from bellows_ros.workflows.identification import save, UNKNOWN_STD
from bellows_ros.workflows.identify import identify
from bellows_ros.workflows.recordings import load
from bellows_ros.workflows.replay import replay
from bellows_ros.workflows.simulate import simulate_recording
import numpy as np
from numpy.testing import assert_allclose
import pytest
from ruamel.yaml import YAML

from ..files.recordings import again

CLEAN = {
    'topics.tool_pose': '/tool_arm/pose', 'topics.tool_twist': '/tool_arm/twist',
    'topics.package_pose': '/package/pose', 'recording.package_frame': 'com',
    'package.mass': 2.17, 'package.inertia': [0.0087, 0.0087, 0.0173, 0.0, 0.0, 0.0],
    'package.com': [0.0, 0.0, -0.03], 'cup.length': 0.0481, 'fit.method': 'least_squares',
}
LAB = {
    **CLEAN, 'topics.tool_pose': '/mocap/tool_arm/pose', 'topics.tool_twist': '',
    'topics.package_pose': '/mocap/plate/pose', 'recording.world': 'motive_y_up',
    'recording.package_frame': 'lip', 'recording.align_at_rest': True,
}


def ratios(fit, truth):
    """Return found over true diagonal entries of K and P."""
    return (
        np.diag(fit.stiffness) / np.diag(truth['K']), np.diag(fit.damping) / np.diag(truth['P']))


def test_a_thin_plate_is_identified_as_a_possible_body(rig, tmp_path):
    """Whose moments, free with their standard deviations, would else be those of no body."""
    bag = rig.parent / 'reports/thin_plate'
    if not bag.exists():
        pytest.skip('no ../shared/reports/thin_plate')
    settings = {**CLEAN, 'topics.tool_twist': '', 'topics.tool_pose': '/tool_arm/pose',
                'fit.method': 'output_error', 'bags': [str(bag)]}
    found = identify(settings)
    truth = np.array([6417.0, 6417.0, 11530.0, 3.868, 3.868, 1.123])
    fit = found.fit
    assert np.all(np.abs(np.diag(fit.stiffness) - truth) < 4.0 * np.diag(fit.stiffness_std))
    save(found, tmp_path / 'cup.yaml', None, cell_path=tmp_path / 'cell.yaml')
    resolve(read_parameters(tmp_path / 'cell.yaml'))


def test_motion_capture_recording_of_the_rig(rig):
    """And of another one each axis that moves is predicted to 5 %; z moves by less than a mm."""
    result = identify({**LAB, 'bags': [str(rig / 'lab')]})
    stiffness, damping = ratios(result.fit, np.load(rig / 'lab_truth.npz'))
    assert_allclose(stiffness, 1.0, atol=0.04)
    assert_allclose(damping[[0, 1, 3, 4, 5]], 1.0, atol=0.15)
    assert result.fit.samples_rejected > 0
    assert result.fit.usable
    found = replay(rig / 'lab_validation', {**LAB, **result.parameters()}).validation
    assert found.moves.tolist() == [True, True, False, True, True, True]
    assert np.all(found.scores.nrmse[found.moves] < 0.05)
    assert np.all(found.model_error[found.moves] < 0.02)


def test_each_recording_may_have_its_own_topics(root, true_cup, tmp_path):
    """Take topics and axes of each recording from its file; the package's from there, too."""
    motion = YAML(typ='safe').load((root / 'bags/identification.yaml').read_text()) | {
        'duration': 12.0, 'seed': 7, 'world': 'motive_y_up'}
    own = {'package.mass': 1.2, 'package.inertia': [0.003, 0.0045, 0.0068, 0.0, 0.0, 0.0],
           'package.com': [0.0, 0.0, -0.03], 'recording.package_frame': 'com'}
    bags = [str(root / 'bags/identification'), str(tmp_path / 'other')]
    simulate_recording({**true_cup, **own}, motion, tmp_path / 'first')
    streams = read_streams(tmp_path / 'first', {'/arm': '/tool_arm/pose', '/box': '/package/pose'})
    write_bag(bags[1], [again(stream, topic) for topic, stream in streams.items()])
    write_parameters(tmp_path / 'other.yaml', {
        **own, 'topics.tool_pose': '/arm', 'topics.package_pose': '/box', 'topics.tool_twist': '',
        'recording.world': 'motive_y_up'}, [])
    settings = {'bags': bags, 'cup.length': true_cup['cup.length'],
                'topics.tool_pose': '/tool_arm/pose', 'topics.package_pose': '/package/pose'}
    result = identify({
        **settings, 'fit.method': 'least_squares',
        'package.files': [str(root / 'bags/package.yaml'), str(tmp_path / 'other.yaml')]})
    K = np.diag(np.reshape(true_cup['cup.stiffness'], (6, 6)))
    assert_allclose(np.diag(result.fit.stiffness), K, rtol=0.03)
    assert [part.report['tool_pose']['topic'] for part in result.parts] == [
        '/tool_arm/pose', '/arm']
    assert [part.payload.mass for part in result.parts] == [1.8, 1.2]
    with pytest.raises(BellowsError, match=r'topics\.tool_pose.*package\.files'):
        identify({**own, **settings})


def test_recordings_at_rest_beside_a_motion_give_the_length(shipped, weights, tmp_path):
    """Start from a wrong length: it is found, and the stiffness with it."""
    result, truth = shipped
    own = result.values.package.mass
    files = [tmp_path / f'{mass}.yaml' for mass in (own, *weights.values())]
    for file in files:
        file.write_text(f"package.mass: {file.stem}\ntopics.tool_twist: ''")
    given = {**result.values, 'topics.tool_twist': '', 'fit.method': 'output_error',
             'cup.length': 0.0475, 'fit.free': ['length']}
    joined = identify({**given, 'bags': [*result.values.bags, *weights],
                       'package.files': list(map(str, files))})
    assert joined.succeeded and not any('rests throughout' in each for each in joined.warnings)
    length, std, _ = joined.found['cup.length']
    assert abs(length - truth['cup.length']) < 4.0 * std and std < 2e-4
    K = np.diag(np.reshape(truth['cup.stiffness'], (6, 6)))
    assert_allclose(np.diag(joined.fit.stiffness), K, rtol=0.01)
    save(joined, tmp_path / 'cup.yaml', tmp_path / 'fit.json', cell_path=tmp_path / 'cell.yaml')
    values = read_parameters(tmp_path / 'cup.yaml')
    assert values['cup.length'] == length and values['cup.length_std'] == pytest.approx(std)
    content = json.loads((tmp_path / 'fit.json').read_text())
    assert [entry['package']['mass'] for entry in content['recordings']] == [
        own, *weights.values()]
    assert content['settings']['cup.length'] == 0.0475, 'what was given, not what was found'
    assert len(content['provenance']['recordings']) == 1 + len(weights)
    with pytest.raises(UnexplainedError, match='rests throughout.*Record a motion'):
        identify({**given, 'bags': list(weights)})


def test_what_is_not_identifiable_is_infinite_everywhere(shipped, true_cup, tmp_path):
    """See torsion unknown in the fit, null in JSON, 1e9 in the cup file."""
    simulate_recording(true_cup, {
        'kind': 'multi_sine', 'duration': 5.0, 'rest_duration': 1.0, 'seed': 4,
        'multi_sine': {'position': {'x': {'amplitude': [0.03, 0.003], 'frequency': [0.6, 2.6]}}},
        'tool': {'rate_hz': 200.0}, 'package': {
            'rate_hz': 200.0, 'noise': {'position': 1e-4, 'rotation': 5e-4}}}, tmp_path / 'bag')
    result = identify({
        **shipped[0].values, 'bags': [str(tmp_path / 'bag')]})
    fit = result.fit
    assert np.isinf(fit.stiffness_std[5, 5]) and np.isinf(fit.damping_std[5, 5])
    assert np.isfinite(fit.stiffness_std[0, 0])
    assert all(any(f'{label} is not identifiable' in warning for warning in result.warnings)
               for label in ('K rz', 'P rz'))
    content = json.loads(format_json(result.as_json()))
    assert content['stiffness_std'][5][5] is None
    label = content['parameters']['labels'].index('K rz')
    assert content['parameters']['covariance'][label][label] is None
    values = resolve(result.parameters() | {'cup.stiffness': shipped[1]['cup.stiffness'],
                                            'cup.damping': shipped[1]['cup.damping']})
    assert values['cup.stiffness_std'][35] == UNKNOWN_STD


def test_a_rejected_cup_is_written_only_by_force_with_a_note(shipped, tmp_path):
    result = identify({**shipped[0].values, 'cup.length': 0.047, 'recording.end': 8.0})
    with pytest.raises(BellowsError, match=r'cup\.length is off by (0\.99|1)'):
        save(result, tmp_path / 'cup.yaml', tmp_path / 'fit.json')
    assert not (tmp_path / 'cup.yaml').exists() and (tmp_path / 'fit.json').exists()
    save(result, tmp_path / 'cup.yaml', None, force=True)
    assert 'REFUSED, but written all the same' in (tmp_path / 'cup.yaml').read_text()


@pytest.fixture(scope='module')
def settings(root, known):
    """Return the parameters of a short recording."""
    return {**known, 'bags': [str(root / 'bags/validation')]}


@pytest.mark.parametrize(('change', 'named'), [
    ({'fit.free': ['com'], 'fit.method': 'least_squares'}, 'com.* fit.method: output_error'),
    ({'fit.free': ['mass'], 'package.files': ['a', 'b']}, 'mass.* package.files'),
    ({'fit.free': ['weight']}, "time_offset, clock_rate, com,.* 'weight'"),
])
def test_what_cannot_be_free_is_refused(settings, change, named):
    with pytest.raises(BellowsError, match=f'fit.free.*{named}'):
        identify({**settings, 'recording.end': 4.0, **change})


@pytest.mark.parametrize('method', ['least_squares', 'output_error'])
def test_only_the_holds_of_a_recording_of_work_are_fitted(root, tmp_path, method):
    """The package lies on a table before, between and after its two holds."""
    streams = read_streams(root / 'bags' / 'identification', {
        role: CLEAN[f'topics.{role}'] for role in ('tool_pose', 'tool_twist', 'package_pose')})
    tool, twist, package = (streams[role] for role in ('tool_pose', 'tool_twist', 'package_pose'))
    first = package.stamps_ns[0]

    def held(stamps_ns):
        seconds = (stamps_ns - first) * 1e-9
        return ((seconds > 2.0) & (seconds < 10.0)) | ((seconds > 12.0) & (seconds < 22.0))

    last = np.maximum.accumulate(np.where(
        held(package.stamps_ns), np.arange(len(package.stamps_ns)), 0))  # lies where it was left
    stamps_ns = np.arange(first, package.stamps_ns[-1], 50_000_000)
    lying = replace(package, position=package.position[last], rotation=package.rotation[last])
    vacuum = Encoded('/vacuum/held', BOOL, stamps_ns, [
        HEAD + bytes([each]) for each in held(stamps_ns).tolist()])
    write_bag(tmp_path / 'work', [*map(again, (tool, lying, twist)), vacuum])
    given = {**read_parameters(root / 'bags' / 'package.yaml'), 'fit.method': method,
             'bags': [str(tmp_path / 'work')], 'vacuum.signal': 'bool'}
    fit = identify(given).fit
    parts = load(tmp_path / 'work', resolve(given), held=True).segments()
    assert len(parts) == 2 and all(
        held(np.array([part.first_ns, part.last_ns])).all() for part in parts)
    renamed = resolve({**given, 'topics.vacuum': 'gripper/grasped'})
    with pytest.raises(BellowsError, match='on gripper/grasped; it has: /vacuum/held. Set topics'):
        load(tmp_path / 'work', renamed, held=True)
    streams['tool_pose'] = replace(tool, stamps_ns=tool.stamps_ns - tool.stamps_ns[0])
    with pytest.raises(BellowsError, match='mixes two clocks'):  # simulated time
        masks_held(tmp_path / 'work', streams, resolve(given))
    truth = read_parameters(root / 'bags' / 'cup.yaml')
    found, expected = (np.diag(np.reshape(K, (6, 6))) for K in (
        fit.stiffness, truth['cup.stiffness']))
    assert fit.usable
    assert_allclose(found, expected, rtol=0.05)
