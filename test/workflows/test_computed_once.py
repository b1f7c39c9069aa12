"""
What is expensive is computed once for a recording, whatever a run asks for.

But for regressors: the searches for causes pass through some points more than once.
"""

from collections import Counter
import functools
import importlib
import pkgutil
import sys

import bellows_ros
from bellows_ros.report.build import write_page
from bellows_ros.workflows.identify import identify
import pytest

EXPENSIVE = {
    'savgol': 'core.signals.savgol',
    'noise_of': 'core.recording.recording',
    'with_noise': 'core.identification.samples',
    'envelope': 'core.identification.reduction',
}


def test_nothing_is_computed_twice(root, known, tmp_path, monkeypatch):
    """Identify with all that can be asked for and its page: no argument comes a second time."""
    joblib = pytest.importorskip('joblib', reason='extra parallel')
    for module in pkgutil.walk_packages(bellows_ros.__path__, 'bellows_ros.'):
        if not module.name.startswith(('bellows_ros.nodes', 'bellows_ros.demo')) and \
                not module.name.endswith('__main__'):
            importlib.import_module(module.name)
    calls = Counter()

    def counted(function):
        @functools.wraps(function)
        def call(*arguments, **named):
            calls[function.__name__, joblib.hash((arguments, named))] += 1
            return function(*arguments, **named)
        return call

    for name, module in EXPENSIVE.items():
        function = getattr(sys.modules[f'bellows_ros.{module}'], name)
        for other in [m for n, m in sys.modules.items() if n.startswith('bellows_ros')]:
            if getattr(other, name, None) is function:
                monkeypatch.setattr(other, name, counted(function))

    page = tmp_path / 'page.html'
    found = identify({
        **known, 'bags': [str(root / 'bags/identification')],
        'validation.bags': [str(root / 'bags/validation')], 'fit.method': 'least_squares',
        'fit.compare_structures': True, 'output.report': str(page), 'recording.end': 8.0})
    write_page(found, page)
    assert {name for name, _ in calls} == set(EXPENSIVE)
    assert [key for key, count in calls.items() if count > 1] == []
