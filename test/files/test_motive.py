"""Motive's CSV exports, against files written as Motive writes them."""

from pathlib import Path

from bellows_ros.errors import BellowsError
from bellows_ros.files.motive import is_motive, read_motive
import numpy as np
import pytest

RATE = 360.0
ABOUT = ('Format Version,1.23,Take Name,shake,Capture Frame Rate,360.000000,Export Frame Rate,'
         '360.000000,Capture Start Time,2021-05-11 02.31.05.250 PM,Total Frames in Take,4,'
         'Total Exported Frames,4,Rotation Type,Quaternion,Length Units,Meters,'
         'Coordinate Space,Global')


def export(path: Path, about: str = ABOUT, scale: float = 1.0, quality: bool = True) -> Path:
    """Write two bodies, three markers each; a pose is missing and a marker is bad."""
    kinds, names, quantities, axes = [], [], [], []
    for body in ('Tool', 'Plate'):
        for quantity, letters in (('Rotation', 'XYZW'), ('Position', 'XYZ')):
            for axis in letters:
                kinds.append('Rigid Body')
                names.append(body)
                quantities.append(quantity)
                axes.append(axis)
        kinds.append('Rigid Body')
        names.append(body)
        quantities.append('Mean Marker Error')
        axes.append('')
        for marker in range(3 if quality else 0):
            for quantity, axis in (('Position', 'X'), ('Marker Quality', '')):
                kinds.append('Rigid Body Marker')
                names.append(f'{body}:Marker{marker + 1}')
                quantities.append(quantity)
                axes.append(axis)
    rows = [about, '', ',Type,' + ','.join(kinds), ',Name,' + ','.join(names),
            ',ID,' + ','.join('1' for _ in kinds), ',,' + ','.join(quantities),
            'Frame,Time (Seconds),' + ','.join(axes)]
    for frame in range(4):
        cells = [str(frame), f'{frame / RATE:.6f}']
        for number, body in enumerate(('Tool', 'Plate')):
            pose = [0.0, 0.0, 0.6, 0.8, *(scale * np.array([0.1, 1.2 - number * 0.1, frame]))]
            missing = body == 'Plate' and frame == 2
            cells += ['' if missing else repr(float(x)) for x in pose] + ['0.0001']
            for marker in range(3 if quality else 0):
                bad = body == 'Tool' and frame == 1 and marker == 2
                cells += ['0.1', '0.42' if bad else '0.998']
        rows.append(','.join(cells))
    path.write_text('\r\n'.join(rows) + '\r\n', encoding='utf-8-sig')
    return path


def test_bodies_are_read_and_bad_frames_left_out(tmp_path: Path) -> None:
    """Count missing poses and such with too few markers apart (appendix H)."""
    file = export(tmp_path / 'take.csv')
    assert is_motive(file)
    tool, plate = read_motive(file)
    assert (tool.name, tool.missing, tool.unseen) == ('Tool', 0, 1)
    assert (plate.name, plate.missing, plate.unseen) == ('Plate', 1, 0)
    np.testing.assert_allclose(tool.values[-1], [0.1, 1.2, 3.0, 0.0, 0.0, 0.6, 0.8])
    np.testing.assert_allclose(np.diff(plate.stamps_ns), [2777780, 5555550], atol=1000)  # 1 us
    # 2021-05-11 14:31:05.250 UTC
    assert tool.stamps_ns[0] == 1_620_743_465_250_000_000


def test_fewer_markers_may_be_allowed(tmp_path: Path) -> None:
    """Keep the pose that was made of two markers."""
    tool, _ = read_motive(export(tmp_path / 'take.csv'), fewest_markers=2)
    assert tool.unseen == 0 and len(tool.stamps_ns) == 4


def test_without_marker_quality_all_poses_count(tmp_path: Path) -> None:
    """Do not ask for what was not exported."""
    tool, _ = read_motive(export(tmp_path / 'take.csv', quality=False))
    assert len(tool.stamps_ns) == 4


def test_millimetres_become_metres(tmp_path: Path) -> None:
    """Scale positions by the unit that the header names."""
    about = ABOUT.replace('Meters', 'Millimeters')
    tool, _ = read_motive(export(tmp_path / 'take.csv', about, scale=1000.0))
    np.testing.assert_allclose(tool.values[0, :3], [0.1, 1.2, 0.0])


@pytest.mark.parametrize(
    ('change', 'words'),
    [
        (('Quaternion', 'XYZ'), 'Rotation Type XYZ; Quaternion is needed'),
        (('Global', 'Local'), 'Coordinate Space Local'),
        (('Length Units,Meters', 'Length Units,Feet'), 'lengths in Feet'),
        (('Format Version', 'Version'), 'no CSV export of Motive'),
    ],
)
def test_other_exports_are_refused(change: tuple[str, str], words: str, tmp_path: Path) -> None:
    """Say what to change in the export."""
    file = export(tmp_path / 'take.csv', ABOUT.replace(*change))
    with pytest.raises(BellowsError, match=words):
        read_motive(file)


@pytest.mark.parametrize(
    'content', ['', 'Format Version,1.23\n', 'Format Version,1.2\n\nFrame,T\n'])
def test_torn_files_are_refused(content: str, tmp_path: Path) -> None:
    """End in an error that names the file."""
    (tmp_path / 'take.csv').write_text(content)
    with pytest.raises(BellowsError, match='take.csv'):
        read_motive(tmp_path / 'take.csv')
