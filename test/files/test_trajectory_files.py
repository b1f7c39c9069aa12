"""TUM files, and Motive's CSV exports in the layouts of formats 1.22 to 1.25."""

import csv
from dataclasses import dataclass, replace
from datetime import datetime, UTC

from bellows_ros.errors import BellowsError
from bellows_ros.files.trajectory_files import is_motive, read_motive, read_tum
import numpy as np
import pytest


def test_tum_takes_exponents_and_comments(tmp_path):
    """Read what other tools write, with every nanosecond, which floats of seconds would lose."""
    (tmp_path / 'a.txt').write_text(
        '# a comment\n\n1.5e3 0 0 0 0 0 0 1\n1700000000.123456789 1 2 3 0 0 0.6 0.8\n')
    stamps, values = read_tum(tmp_path / 'a.txt')
    np.testing.assert_array_equal(stamps, [1500 * 10**9, 1_700_000_000_123_456_789])
    np.testing.assert_array_equal(values[1], [1.0, 2.0, 3.0, 0.0, 0.0, 0.6, 0.8])


@pytest.mark.parametrize(('text', 'figures'), [
    ('1 2 3\n', r'line 1: .*\b8 numbers\b.*1 2 3'), ('# nothing\n', ''),
    ('1 0 0 0 0 0 zero 1\n', 'line 1'), (12 * '1 ', r'line 1: .*\b8 numbers\b'),
    *((f'{time} 0 0 0 0 0 0 1\n', 'line 1: .* in s ')
      for time in ('-1', '9999999999', '9' * 5000 + '.5', '².1'))])
def test_bad_lines_are_named(text, figures, tmp_path):
    """Name the line, and what a line must be."""
    (tmp_path / 'a.txt').write_text(text)
    with pytest.raises(BellowsError, match=rf"a\.txt'.*{figures}"):
        read_tum(tmp_path / 'a.txt')


RATE = 360.0
ABOUT = ('Format Version,1.23,Take Name,shake,Capture Frame Rate,360.000000,Export Frame Rate,'
         '360.000000,Capture Start Time,2021-05-11 02.31.05.250 PM,Total Frames in Take,4,'
         'Total Exported Frames,4,Rotation Type,Quaternion,Length Units,Meters,'
         'Coordinate Space,Global')


@dataclass(frozen=True)
class Column:
    """A column of a table as Motive lays it out, with a cell for each frame."""

    kind: str
    name: str
    quantity: str
    axis: str
    cells: tuple[str, ...]
    parent: str = ''


def layout(path, columns, settings, timecode=False):
    """Write a file with the rows that formats 1.22 to 1.25 have, as Motive and editors save it."""
    version = settings.split(',')[1]
    extra = [''] if timecode else []
    labels = [('Type', 'kind'), ('Name', 'name'), ('ID', 'name')]
    labels += [('Parent', 'parent')] if version >= '1.25' else []
    rows = [settings.split(','), [''] * 4]  # spreadsheets fill the blank row with commas
    rows += [['', label, *extra, *(getattr(c, field) for c in columns)] for label, field in labels]
    rows.append(['', '', *extra, *(c.quantity for c in columns)])
    rows.append(['Frame', 'Time (Seconds)', *(['TimeCode'] if timecode else []),
                 *(c.axis for c in columns)])
    for frame in range(len(columns[0].cells)):
        rows.append([str(frame), f'{frame / RATE:.6f}', *(['15:26:46:12.02'] if timecode else []),
                     *(c.cells[frame] for c in columns)])
    with path.open('w', newline='', encoding='utf-8-sig') as file:
        csv.writer(file, lineterminator='\r\n').writerows(rows)
    return path


def pose(name, rows=2 * [(0.0, 0.6, 0.0, -0.8, 100.0, 1200.0, 5.0)], kind='Rigid Body'):
    """Return the columns of a body, one row a frame or None, with its mean marker error."""
    axes = [('Rotation', axis) for axis in 'XYZW'] + [('Position', axis) for axis in 'XYZ']
    found = [Column(kind, name, quantity, axis, tuple(
        '' if row is None else repr(float(row[i])) for row in rows))
        for i, (quantity, axis) in enumerate(axes)]
    return [*found, Column(kind, name, 'Mean Marker Error', '', ('0.02',) * len(rows))]


def marker(kind, name, cells, quality=False):
    """Return the columns of a marker: position, and in some exports its quality."""
    found = [Column(kind, name, 'Position', axis, cells, 'Tool') for axis in 'XYZ']
    quantity = [Column(kind, name, 'Marker Quality', '', cells, 'Tool')] if quality else []
    return found + quantity


def export(path):
    """Write two bodies, three markers each, in four frames; a pose is missing, a marker bad."""
    columns = []
    for number, body in enumerate(('Tool', 'Plate')):
        rows = [(0.0, 0.0, 0.6, 0.8, 0.1, 1.2 - 0.1 * number, frame) for frame in range(4)]
        columns += pose(body, rows if body == 'Tool' else [*rows[:2], None, rows[3]])
        for k in range(3):
            cells = ('0.998', '0.42' if (body, k) == ('Tool', 2) else '0.998', '0.998', '0.998')
            columns += marker('Rigid Body Marker', f'{body}:Marker{k + 1}', cells, True)
    return layout(path, columns, ABOUT)


V22 = ('Format Version,1.22,Take Name,Take 2018-10-04 01.43.11 PM_001,Capture Frame Rate,360,'
       'Export Frame Rate,360,Capture Start Time,2018-10-05 12.05.03.445 A.M.,Total Frames in '
       'Take,2,Total Exported Frames,2,Rotation Type,Quaternion,Length Units,Millimeters,'
       'Coordinate Space,Global')
V24 = ('Format Version,1.24,Take Name,sweep,Take Notes,,Capture Frame Rate,360.000000,Export Frame'
       ' Rate,360.000000,Capture Start Time,2023-06-02 12.09.45.344 PM,Capture Start Frame,246045,'
       'Total Frames in Take,2,Total Exported Frames,2,Rotation Type,Quaternion,Length Units,'
       'Millimeters,Coordinate Space,Global')


@pytest.mark.parametrize(('settings', 'timecode'), [
    (V22, False), (V24.replace('1.24', '1.23'), False), (V24, True),
    (V24.replace('1.24', '1.25'), False)])
def test_all_layouts_are_read(settings, timecode, tmp_path):
    """Find poses by their heads, among skeletons, markers and time codes, in millimetres."""
    columns = [*pose('Hip', kind='Bone'), *pose('Tool'), *marker('Marker', 'Loose 1', ('1', ''))]
    (tool,) = read_motive(layout(tmp_path / 'take.csv', columns, settings, timecode))
    np.testing.assert_allclose(tool.values[0], [0.1, 1.2, 0.005, 0.0, 0.6, 0.0, -0.8])
    start = datetime(2018, 10, 5, 0, 5, 3, tzinfo=UTC) if settings == V22 else datetime(
        2023, 6, 2, 12, 9, 45, tzinfo=UTC)
    assert tool.stamps_ns[0] // 10**9 == start.timestamp()


def test_axes_may_be_lower_case_and_rows_of_the_header_short(tmp_path):
    """As other programs write a take again."""
    columns = [replace(each, axis=each.axis.lower()) for each in pose('Tool')]
    file = layout(tmp_path / 'take.csv', [*columns, *marker('Marker', '', ('', ''))], V24, True)
    text = file.read_text(encoding='utf-8-sig')
    file.write_text(text.replace(',Marker,Marker,Marker', ''))
    (tool,) = read_motive(file)
    np.testing.assert_allclose(tool.values[0], [0.1, 1.2, 0.005, 0.0, 0.6, 0.0, -0.8])


def test_markers_belong_to_the_body_with_the_longest_name(tmp_path):
    """Do not count the markers of Tool_2 for Tool."""
    columns = pose('Tool') + pose('Tool_2')
    for number in range(3):
        columns += marker('Rigid Body Marker', f'Tool:Marker{number}', ('0.5', '1.0'), True)
        columns += marker('Rigid Body Marker', f'Tool_2:Marker{number}', ('1.0', '1.0'), True)
    tool, second = read_motive(layout(tmp_path / 'take.csv', columns, V24))
    assert (tool.left_out, second.left_out) == ({'too few markers': 1}, {})


def test_measured_markers_tell_where_there_is_no_quality(tmp_path):
    """Count positions that are not blank; where a body expects its markers says nothing."""
    columns = pose('Tool')
    for number in range(3):
        columns += marker('Rigid Body Marker', f'Tool:Marker{number}', ('7', '7'))
        columns += marker('Marker', f'Tool:Marker{number}', ('7', '' if number else '7'))
    (tool,) = read_motive(layout(tmp_path / 'take.csv', columns, V24.replace('1.24', '1.25')))
    assert (tool.left_out, len(tool.stamps_ns)) == ({'too few markers': 1}, 1)


def test_bodies_are_read_and_bad_frames_left_out(tmp_path):
    """Count missing poses and such with too few markers apart (appendix H)."""
    file = export(tmp_path / 'take.csv')
    assert is_motive(file) and not is_motive(tmp_path)  # which cannot be read
    tool, plate = read_motive(file)
    assert (tool.name, tool.left_out) == ('Tool', {'too few markers': 1})
    assert (plate.name, plate.left_out) == ('Plate', {'not tracked': 1})
    np.testing.assert_allclose(tool.values[-1], [0.1, 1.2, 3.0, 0.0, 0.0, 0.6, 0.8])
    np.testing.assert_allclose(np.diff(plate.stamps_ns), [2777780, 5555550], atol=1000)  # 1 us


@pytest.mark.parametrize(('change', 'named'), [
    (('Quaternion', 'XYZ'), "Rotation Type 'XYZ'.* Quaternion"),
    (('Global', 'Local'), "Coordinate Space 'Local'.* Global"),
    (('Length Units,Meters', 'Length Units,Feet'), 'Feet.* Meters or Centimeters'),
    (('Length Units,Meters,', ''), 'Meters or Centimeters'),
    (('Format Version', 'Version'), None), ((',', ';'), 'line 1: .*Header Information'),
    (('Format Version,1.23', 'Format Version,1.1'), r'Format Version 1\.1; expected 1\.2'),
    ((',Type,', ',Kind,'), "line 7: expected the row 'Type'"),
    (('Frame,Time', 'Image,Time'), 'line 11: expected the row of axes'),
    (('0.998', 'good'), 'line 8: expected a number in column 14'),
    (('Plate', 'Tool'), "line 7: expected one rigid body 'Tool', got several"),
    (('Position', 'Place'), "line 7: expected the column 'position x' of 'Tool'"),
    ((f'3,{3 / RATE:.6f}', '3,1e20'), 'time in s')])
def test_other_exports_are_refused(change, named, tmp_path):
    """Name what to change in the export; make no stamp of a time that none can hold."""
    file = export(tmp_path / 'take.csv')
    file.write_text(file.read_text().replace(*change))
    if named is None:
        assert not is_motive(file)
        return
    with pytest.raises(BellowsError, match=rf"take\.csv'.*{named}"):
        read_motive(file)
