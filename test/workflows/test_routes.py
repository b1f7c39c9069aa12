"""Any route to a fit: one after the other, on cores, on a cluster."""

import gc
import json
import os
from pathlib import Path
import shutil
import signal

from bellows_ros.errors import BellowsError
from bellows_ros.files.results import format_json
from bellows_ros.workflows import identify as routes
from bellows_ros.workflows.identify import identify
from bellows_ros.workflows.simulate import simulate_recording
import pytest
from ruamel.yaml import YAML


@pytest.fixture(scope='module')
def settings(root, known, true_cup, tmp_path_factory):
    """Return the parameters of two short recordings of the motion of bags/identification."""
    motion = YAML(typ='safe').load((root / 'bags/identification.yaml').read_text())
    folder = tmp_path_factory.mktemp('settings')
    bags = [str(folder / name) for name in ('first', 'second')]
    for seed, bag in enumerate(bags, 1):
        simulate_recording(true_cup, {**motion, 'seed': seed, 'duration': 6.0}, bag)
    return {**known, 'fit.method': 'least_squares', 'bags': bags}


def content_of(result):
    """Return the content of a result's JSON file as it is read."""
    return json.loads(format_json(result.as_json()))


@pytest.mark.parametrize('structure', [
    'axisymmetric', *(pytest.param(name, marks=pytest.mark.stress)
                      for name in ('diagonal', 'full'))])
def test_every_route_gives_the_same_keys_and_the_same_numbers(settings, root, structure):
    asked = {**settings, 'fit.structure': structure}
    wanted = content_of(identify(asked))
    assert wanted['recordings'][0]['noise'] and wanted['envelope']
    said = []
    for route in (identify(asked, lambda what, part: said.append(part), jobs=1),
                  identify(asked, jobs=2)):
        assert content_of(route) == wanted
    assert said[0] == 0.0 and said[-1] == 1.0 and said == sorted(said)


def test_nothing_usable(settings):
    with pytest.raises(BellowsError, match="2.*'a'"):
        identify({**settings, 'bags': ['a', 'b']}, jobs=1)


@pytest.fixture(scope='module')
def cluster(tmp_path_factory):
    """Return a Dask cluster of two workers."""
    distributed = pytest.importorskip('distributed', reason='extra dask')
    with distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, processes=True, host='127.0.0.1', scheduler_port=0,
        dashboard_address=None, local_directory=tmp_path_factory.mktemp('dask'),
    ) as started:
        yield started


@pytest.fixture(scope='module')
def simulated(settings):
    """Return the settings of a fit by simulation, and its result in this process."""
    asked = {**settings, 'fit.method': 'output_error'}
    return asked, content_of(identify(asked))


@pytest.mark.parametrize('jobs', [2, pytest.param(1, marks=pytest.mark.stress)])
def test_processes_give_the_same_cup_to_the_last_digit(simulated, jobs):
    asked, expected = simulated
    assert content_of(identify(asked, jobs=jobs)) == expected


def test_a_cluster_gives_the_same_cup_although_a_worker_is_lost(simulated, cluster):
    """Kill it in the third step of the search; a recording that is nowhere is left out."""
    asked, expected = simulated
    cluster.scheduler.allowed_failures = 3
    killed = []

    def progress(what, part=0.0):
        if 'step 3' in what and not killed:
            killed.append(next(iter(cluster.workers.values())).pid)
            os.kill(killed[0], signal.SIGKILL)

    found = content_of(identify({**asked, 'bags': [*asked['bags'], 'nowhere']},
                                dask=cluster.scheduler_address, progress=progress))
    assert killed and found['failed'][0]['bag'] == 'nowhere'
    for name in ('stiffness', 'parameters', 'samples_used', 'recordings', 'verdict'):
        assert found[name] == expected[name]


@pytest.mark.parametrize('address', [
    'nonsense://127.0.0.1:1', 'tcp://127.0.0.1:1'])
def test_no_scheduler(settings, address, monkeypatch):
    pytest.importorskip('distributed', reason='extra dask')
    monkeypatch.setattr(routes, 'ANSWER_TIMEOUT', 0.5)
    with pytest.raises(BellowsError, match=f"'{address}'.*'dask scheduler'"):
        identify(settings, dask=address)
    gc.collect()  # nothing is left that would wait for the scheduler when it is collected


def test_a_recording_counts_once_under_any_name(settings, tmp_path):
    """As it is, as the file in it, and as a copy."""
    whole = Path(settings['bags'][1])
    shutil.copytree(whole, tmp_path / 'copy')
    spelled = [str(whole), str(next(whole.glob('*.mcap'))), str(tmp_path / 'copy')]
    for again in (0, 2):
        two = {**settings, 'bags': [spelled[0], spelled[again]]}
        with pytest.raises(BellowsError, match=f"'{spelled[again]}' and '"):
            identify(two)
    bags = [spelled[0], settings['bags'][0], *spelled[1:]]
    result = identify({**settings, 'bags': bags}, jobs=1)
    assert [failed.bag for failed in result.failed] == spelled[1:]
    assert list(result.bags) == bags[:2]
