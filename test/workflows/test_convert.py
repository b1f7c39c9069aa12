"""Trajectory files to recordings."""

from dataclasses import replace

from bellows_ros.errors import BellowsError
from bellows_ros.files.bags import topics
from bellows_ros.workflows.convert import convert
import numpy as np
import pytest

from ..files.test_trajectory_files import export, layout, pose, V24

STAMPS = 1_700_000_000_000_000_000 + np.arange(20) * 2_000_000
VALUES = np.hstack([np.arange(60.0).reshape(20, 3), np.tile([0.0, 0.0, 0.6, 0.8], (20, 1))])


def write_tum(path, stamps, values=VALUES, form='%.9f'):
    """Write a TUM file, with times as a form prints them."""
    path.parent.mkdir(exist_ok=True)
    path.write_text('\n'.join(
        ' '.join([f'{t // 10**9}.{t % 10**9:09d}' if form == '%.9f' else form % (t / 1e9),
                  *map(str, row)]) for t, row in zip(stamps.tolist(), values, strict=True)))
    return path


@pytest.mark.parametrize('form, kept', [
    ('%.9f', 20), ('%.13g', 20), ('%.10g', None), ('%g', None)])
def test_times_with_too_few_digits_are_refused(tmp_path, form, kept):
    """As numpy.savetxt writes them."""
    file = write_tum(tmp_path / 'a.tum', STAMPS, form=form)
    if kept is None:
        with pytest.raises(BellowsError, match=r'of 20 lines .* %\.9f'):
            convert([file], tmp_path / 'bag')
    else:
        assert [body.poses for body in convert([file], tmp_path / 'bag').bodies] == [kept]


def test_lines_that_are_no_pose_are_left_out_and_counted(tmp_path):
    values, stamps = VALUES.copy(), STAMPS.copy()
    values[3, 0], values[4, 4], stamps[9] = np.nan, np.inf, stamps[8]
    done = convert([write_tum(tmp_path / 'a.tum', stamps, values)], tmp_path / 'bag')
    (body,) = done.bodies
    assert (body.topic, body.poses, body.left_out) == (
        '/a/pose', 17, {'not finite': 2, 'repeated stamp': 1})


def test_a_take_becomes_topics_of_its_bodies(tmp_path):
    """Write what can be used, and say what was not and how the world lies."""
    done = convert([export(tmp_path / 'take.csv')], tmp_path / 'bag', storage='sqlite3')
    assert [body.topic for body in done.bodies] == ['/tool/pose', '/plate/pose']
    assert done.bodies[0].left_out == {'too few markers': 1}
    assert done.bodies[1].left_out == {'not tracked': 1}
    assert done.world == 'motive_y_up'
    assert [(t.name, t.messages) for t in topics(tmp_path / 'bag')] == [
        ('/plate/pose', 3), ('/tool/pose', 3)]


def test_unusual_properties_of_a_take_are_reported(tmp_path):
    """Name a body that was never tracked and a take without a date; refuse one without poses."""
    never = [replace(column, cells=('', '')) for column in pose('Plate')]
    file = layout(tmp_path / 'take.csv', pose('Tool') + never, V24.replace('Start Time', 'Time'))
    done = convert([file], tmp_path / 'bag')
    assert [body.poses for body in done.bodies] == [2, 0]
    assert done.notes == (
        f"'Plate' of '{file}' was never tracked; its topic is empty.",
        f"'{file}' has no date: the stamps of 'Tool' start near zero.")
    with pytest.raises(BellowsError, match=r"take\.csv.*'not tracked': 2"):
        convert([layout(file, never, V24)], tmp_path / 'other')


def test_topics_must_differ_and_be_as_many_as_bodies(tmp_path):
    sources = [write_tum(tmp_path / folder / 'x.tum', STAMPS) for folder in ('a', 'b')]
    for names in ((), ('/one',), ('/one', 'one')):
        with pytest.raises(BellowsError, match='There are 2 bodies'):
            convert(sources, tmp_path / 'bag', names)
    with pytest.raises(BellowsError, match='none'):
        convert([tmp_path / 'none.csv'], tmp_path / 'bag')
