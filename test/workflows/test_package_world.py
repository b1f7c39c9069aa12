"""A tool that a robot's driver knows in its base, and a package that motion capture sees."""

from dataclasses import replace
import json

from bellows_ros.core.geometry import lie
from bellows_ros.errors import BellowsError
from bellows_ros.files.parameter_files import read_parameters
from bellows_ros.files.results import format_json
from bellows_ros.workflows.identification import save
from bellows_ros.workflows.identify import identify
from bellows_ros.workflows.replay import replay
from bellows_ros.workflows.simulate import simulate_recording
import numpy as np
import pytest

from .two_clocks import rewritten

T_BASE_MOCAP = lie.transform(lie.exp_so3(np.array([0.1, -0.2, 2.5])), np.array([1.2, -0.7, 0.3]))


STANDSTILLS = {
    'kind': 'static', 'rest_duration': 1.0, 'start_time_ns': 1_700_000_027_000_000_000,
    'start': {'position': [0.45, -0.10, 0.60]},
    'static': {'move': 1.0, 'hold': 1.2, 'poses': [
        {'position': [0.50, -0.05, 0.62], 'rpy': [0.25, 0.0, 0.1]},
        {'position': [0.40, -0.15, 0.58], 'rpy': [-0.15, 0.2, 0.5]},
        {'position': [0.45, -0.05, 0.60], 'rpy': [-0.1, -0.25, -0.4]}]},
    'tool': {'rate_hz': 500.0, 'noise': {'position': 2e-5, 'rotation': 5e-5}},
    'package': {'rate_hz': 360.0, 'noise': {'position': 1e-4, 'rotation': 5e-4}},
}


@pytest.fixture(scope='module')
def settings(known):
    """Return the parameters of the shipped package."""
    return {**known, 'topics.tool_twist': '', 'fit.method': 'least_squares',
            'recording.start': 10.0}


@pytest.fixture(scope='module')
def bag(root, true_cup, tmp_path_factory):
    """Return the usual motion and three tilted standstills in two worlds, the tool 4 ms late."""
    folder = tmp_path_factory.mktemp('two_worlds')
    simulate_recording(true_cup, STANDSTILLS, folder / 'static')
    T = lie.inverse_transform(T_BASE_MOCAP)

    def seen(role, stream):
        """Return a stream as a driver, or as motion capture gives it."""
        if role == 'package_pose':
            return replace(
                stream, frame_id='mocap', rotation=T[:3, :3] @ stream.rotation,
                position=T[:3, 3] + lie.apply(T[:3, :3], stream.position))
        return replace(stream, frame_id='base', stamps_ns=stream.stamps_ns + 4_000_000)

    return rewritten((root / 'bags/identification', folder / 'static'), folder / 'both', seen)


@pytest.fixture(scope='module')
def result(bag, settings):
    """Return what is identified from it."""
    return identify({**settings, 'bags': [bag], 'recording.package_world': 'estimate',
                     'fit.free': ['time_offset']})


def test_offset_is_printed_and_written_into_its_file(result, bag, settings, tmp_path):
    """Replay with the cup file: the transform is in it."""
    assert any('recording.package_world was estimated: position 1' in line and 'degrees' in line
               for line in result.notes)
    save(result, tmp_path / 'cup.yaml', None, cell_path=tmp_path / 'cell.yaml')
    kept = read_parameters(tmp_path / 'cell.yaml')
    pose = result.parts[0].package_world.pose
    ((offset, error),) = result.delays
    assert any(f'{1e3 * offset:.3f} ms ±' in line and 'later than' in line
               for line in result.notes)
    assert 'later than the camera stamp of the same instant' in (tmp_path / 'cup.yaml').read_text()
    np.testing.assert_allclose(  # in ten digits
        np.array(kept['recording.package_world'].split(), float), pose, rtol=0.0, atol=5e-10)
    content = json.loads(format_json(result.as_json()))
    assert content['time_offsets'] == [offset] and content['time_offsets_std'] == [error]
    (recording,) = content['recordings']
    assert recording['time_offset'] == {'value': offset, 'std': error, 'unit': 's'}
    assert recording['package_world']['units']['position'] == 'm'
    assert kept['measured.latency'] == pytest.approx((-offset, error), abs=1e-9)
    assert replay(bag, {
        **kept, **read_parameters(tmp_path / 'cup.yaml')}).validation.failing() == ()


def test_without_it_two_frames_are_refused(bag, settings):
    with pytest.raises(BellowsError, match='recording.package_world: estimate'):
        identify({**settings, 'bags': [bag]})
