"""Corners of tags that apriltag_ros records, through the lens of the camera."""

from bellows_ros.core.sensors.camera import TagCamera
from bellows_ros.errors import BellowsError
from bellows_ros.files.bags import Encoded, write_bag
from bellows_ros.files.detections import read_contents, read_views, TagSought
from bellows_ros.files.messages import DETECTIONS, message_types, pack, TRANSFORMS
import numpy as np
from numpy.testing import assert_allclose, assert_array_equal
import pytest
from scipy.spatial.transform import Rotation

from . import recordings as made

COUNT, SIDE, FRAME = 40, 0.06, 'optical'
TAG = TagSought(SIDE)
MATRIX = np.array([[910.0, 0.0, 650.0], [0.0, 930.0, 340.0], [0.0, 0.0, 1.0]])
LENSES = {
    'plumb_bob': (-0.31, 0.12, 1e-3, -2e-3, -0.02),
    'rational_polynomial': (0.4, -0.2, -1e-3, 5e-4, 0.02, 0.7, -0.1, 0.01)}
TYPES = message_types().types
"""Of apriltag_msgs too."""


def views(seed=0):
    """Return positions, rotations and directions of the corners of a tag before a camera."""
    rng = np.random.default_rng(seed)
    position = rng.uniform([-0.4, -0.25, 0.8], [0.4, 0.25, 1.4], (COUNT, 3))
    rotation = Rotation.from_rotvec(rng.uniform(-0.7, 0.7, (COUNT, 3))).as_matrix()
    points = 0.5 * SIDE * np.array([[-1, 1, 0], [1, 1, 0], [1, -1, 0], [-1, -1, 0]])
    places = position[:, None] + points @ np.swapaxes(rotation, 1, 2)
    return position, rotation, places[..., :2] / places[..., 2:]


def pixel(direction, k):
    """Return the pixel of a direction, one at a time, as the pages of OpenCV have it."""
    x, y = direction
    k1, k2, p1, p2, k3, k4, k5, k6 = np.append(k, np.zeros(8 - len(k)))
    r = np.hypot(x, y)
    radial = (1 + k1 * r**2 + k2 * r**4 + k3 * r**6) / (1 + k4 * r**2 + k5 * r**4 + k6 * r**6)
    seen = [radial * x + 2 * p1 * x * y + p2 * (r**2 + 2 * x**2),
            radial * y + p1 * (r**2 + 2 * y**2) + 2 * p2 * x * y, 1.0]
    return (MATRIX @ seen)[:2]


def encoded(topic, kind, messages):
    """Return messages to record."""
    data = [bytes(message_types().serialize_cdr(each, kind)) for each in messages]
    return Encoded(topic, kind, made.stamps(len(data)), data)


def header(stamp_ns, frame=FRAME):
    """Return a header."""
    time = TYPES['builtin_interfaces/msg/Time'](*divmod(int(stamp_ns), 10**9))
    return TYPES['std_msgs/msg/Header'](time, frame)


def detections(pixels, numbers=(7,)):
    """Return one message of detections for each view, with tags of some numbers."""
    point = TYPES['apriltag_msgs/msg/Point']
    one = TYPES['apriltag_msgs/msg/AprilTagDetection']
    found = []
    for stamp, four in zip(made.stamps(len(pixels)), pixels, strict=True):
        corners = [point(*map(float, x)) for x in four]
        found.append(TYPES[DETECTIONS](header(stamp), [
            one('36h11', number, 0, 0.0, 50.0, point(0.0, 0.0), corners, np.zeros(9))
            for number in numbers]))
    return found


def calibration(model, k, frame=FRAME, P=None, K=MATRIX, offset=(0, 0), binning=(0, 0)):
    """Return a message of the camera."""
    x, y = offset
    region = TYPES['sensor_msgs/msg/RegionOfInterest'](x, y, 0, 0, False)
    return TYPES['sensor_msgs/msg/CameraInfo'](
        header(made.EPOCH_NS, frame), 720, 1280, model, np.array(k), K.ravel(),
        np.eye(3).ravel(), np.zeros(12) if P is None else P.ravel(), *binning, region)


def recorded(path, arrays, *cameras):
    """Write a recording of detections and cameras."""
    write_bag(path, [encoded('/detections', DETECTIONS, arrays)] + [
        encoded(f'/camera{i}', 'sensor_msgs/msg/CameraInfo', [each])
        for i, each in enumerate(cameras)])
    return path


@pytest.mark.parametrize('model', LENSES)
def test_corners_are_read_without_the_distortion_of_the_lens(tmp_path, model):
    position, rotation, true = views()
    pixels = np.apply_along_axis(pixel, -1, true, LENSES[model])
    assert np.abs(pixels - true @ MATRIX[:2, :2] - MATRIX[:2, 2]).max() > 3.0
    path = recorded(tmp_path / 'b', detections(pixels), calibration(model, LENSES[model]),
                    calibration('plumb_bob', np.zeros(5), 'another'))
    found = read_views(path, 'detections')
    assert (found.tag, found.frame_id, found.refused) == ('36h11:7', FRAME, {})
    assert_array_equal(found.stamps_ns, made.stamps(COUNT))
    assert_allclose(found.corners, true, atol=1e-8)
    stream = read_contents(path, {'package_pose': '/detections'}, TagSought(SIDE)).streams[
        'package_pose']
    assert_allclose(stream.corners, true.reshape(-1, 8), atol=1e-8)
    assert_allclose(stream.position, position, atol=1e-5)
    assert_allclose(stream.rotation, rotation, atol=1e-4)


@pytest.mark.parametrize('is_given', [False, True])
@pytest.mark.parametrize('K, rectified', [(MATRIX, True), (np.zeros((3, 3)), False)])
def test_corners_of_a_rectified_image_have_no_distortion(tmp_path, K, rectified, is_given):
    """
    Its camera is P, with another focal length, as is one that has P alone.

    A pixel (u, v) of the full image is ((u - x_offset) / binning_x, (v - y_offset) / binning_y).
    """
    true, P = views()[2], np.array([[800.0, 0, 620, 0], [0, 800.0, 350, 0], [0, 0, 1, 0]])
    window = {'offset': (200, 60), 'binning': (2, 4)} if is_given else {}
    pixels = true * 800.0 + [620.0, 350.0]
    if is_given:
        pixels = (pixels - [200.0, 60.0]) / [2.0, 4.0]
    path = recorded(tmp_path / 'b', detections(pixels), calibration(
        'plumb_bob', LENSES['plumb_bob'], P=P, K=K, **window))
    found = read_views(path, 'detections', TagSought(rectified=rectified))
    assert_allclose(found.corners, true, atol=1e-12)


def refusal(path, tag=TAG):
    """Return the reason for which a recording has no poses of a tag."""
    return str(read_contents(path, {'package_pose': '/detections'}, tag).problems['package_pose'])


def test_several_tags_are_listed_and_one_is_chosen_by_its_name(tmp_path):
    pixels = views()[2] * 900.0 + 600.0
    path = recorded(tmp_path / 'b', detections(pixels, (3, 7)), calibration('plumb_bob', ()))
    assert '36h11:3 (40 views), 36h11:7 (40 views)' in refusal(path)
    assert 'measured.child_frame' in refusal(path)
    assert 'no tag 36h11:5' in refusal(path, TagSought(SIDE, '36h11:5'))
    assert read_views(path, 'detections', TagSought(child_frame='36h11:7')).tag == '36h11:7'
    assert 'measured.tag_size' in refusal(path, TagSought(0.0, '36h11:7'))


@pytest.mark.parametrize('family, number, hamming, every, is_false', [
    ('36h11', 3, 2, 1, True), ('36h11', 3, 0, 120, True), ('16h5', 7, 0, 120, True),
    ('36h11', 3, 0, 2, False), ('16h5', 7, 0, 2, False)])
def test_a_false_detection_is_ignored_and_another_tag_is_not(
        tmp_path, family, number, hamming, every, is_false):
    """Recorded and live; the second tag has wrong bits, or is seen in a share of the views."""
    arrays = sum((detections(views()[2] * 900.0 + 600.0, (7, number)) for _ in range(3)), [])
    for place, (array, stamp) in enumerate(zip(arrays, made.stamps(3 * COUNT), strict=True)):
        array.header = header(stamp)
        array.detections[1].family, array.detections[1].hamming = family, hamming
        del array.detections[1 + (place % every == 20 % every):]
    camera, live = calibration('plumb_bob', ()), TagCamera()
    live.calibrate(camera, is_rectified=False)
    poses = [live.pose(array, SIDE) for array in arrays]
    path = recorded(tmp_path / 'b', arrays, camera)
    if is_false:
        assert len(read_views(path, 'detections').corners) == 3 * COUNT
        assert sum(each == 'tag_several' for each in poses) <= 30 and poses[-1] != 'tag_several'
    else:
        assert f'{family}:{number}' in refusal(path) and poses[-1] == 'tag_several'
        chosen = TagSought(SIDE, child_frame='36h11:7')
        assert read_views(path, 'detections', chosen).tag == '36h11:7'
        assert not isinstance(live.pose(arrays[0], SIDE, name='36h11:7'), str)


def test_views_that_show_no_single_tag_are_counted_by_reason(tmp_path):
    pixels = views()[2] * 900.0 + 600.0
    pixels[5] = pixels[5, 0]  # a point
    arrays = detections(pixels)
    arrays[8] = detections(pixels, (7, 7))[8]
    arrays[9].detections.clear()
    arrays[11].header = header(made.stamps(COUNT)[10])
    arrays[12].header = header(made.stamps(COUNT)[12], 'another')
    found = read_views(recorded(tmp_path / 'b', arrays, calibration('', ())), 'detections')
    assert found.refused == {
        'tag_no_pose': (5,), 'tag_twice': (8,), 'duplicate_stamp': (11,), 'frame_id': (12,)}
    assert len(found.stamps_ns) == COUNT - 5


@pytest.mark.parametrize('cameras, named', [
    ([], 'camera_info'), ([calibration('plumb_bob', (), 'another')], "'optical'"),
    ([calibration('plumb_bob', ()), calibration('plumb_bob', (0.1,))],
     '/camera0, /camera1'),
    ([calibration('fisheye', (0.1,))], 'fisheye')])
def test_a_camera_that_is_not_known_is_refused(tmp_path, cameras, named):
    assert named in refusal(recorded(tmp_path / 'b', detections(views()[2] * 900), *cameras))


def test_a_live_camera_shows_what_the_reader_of_recordings_reads(tmp_path):
    """One message at a time; without a pose, with the reason."""
    pixels = np.apply_along_axis(pixel, -1, views()[2], LENSES['plumb_bob'])
    pixels[5] = pixels[5, 0]  # a point
    camera = calibration('plumb_bob', LENSES['plumb_bob'], offset=(200, 60), binning=(2, 0))
    pixels = (pixels - [200.0, 60.0]) / [2.0, 1.0]
    arrays = detections(pixels)
    arrays[8] = detections(pixels, (7, 7))[8]
    arrays[9].detections.clear()
    stream = read_views(recorded(tmp_path / 'b', arrays, camera), 'detections').poses(SIDE)
    live = TagCamera()
    assert live.pose(arrays[0], SIDE) == 'tag_no_camera'
    live.calibrate(camera, is_rectified=False)
    seen = [live.pose(array, SIDE) for array in arrays]
    assert (seen[5], seen[8], seen[9]) == ('tag_no_pose', 'tag_twice', '')
    position, rotation = zip(*(each for each in seen if not isinstance(each, str)), strict=True)
    assert_allclose(position, stream.position, atol=1e-7)
    assert_allclose(rotation, stream.rotation, atol=1e-6)
    assert_allclose(position[:5], views()[0][:5], atol=1e-5)
    both = detections(pixels, (3, 7))[0]
    assert live.pose(both, SIDE) == live.pose(arrays[0], SIDE) == 'tag_several'
    assert_allclose(live.pose(both, SIDE, '36h11:7')[0], position[0])
    with pytest.raises(BellowsError, match='fisheye'):
        live.calibrate(calibration('fisheye', (0.1,)), is_rectified=False)


def test_a_tag_on_tf_is_read_in_the_frame_of_its_camera(tmp_path):
    """Poses of the frame with one parent; other names are refused with the frames there are."""
    values = np.hstack([np.arange(12.0).reshape(4, 3), np.tile([0.0, 0.6, 0.0, 0.8], (4, 1))])
    data = [pack(TRANSFORMS, names, 10**18 + k * 10**7, *row)
            for k, row in enumerate(values) for names in (('lens', 'box'), ('lens', 'other'))]
    data.append(pack(TRANSFORMS, ('hall', 'other'), 10**18, *values[0]))
    times = 10**18 + np.arange(len(data))
    write_bag(tmp_path / 'b', [Encoded('/tf', TRANSFORMS, times, data)])
    stream = read_contents(
        tmp_path / 'b', {'package_pose': '/tf'}, TagSought(child_frame='/box')).streams[
            'package_pose']
    assert stream.frame_id == 'lens' and stream.refused == {}
    assert_allclose(stream.position, values[:, :3])
    for child, named in (('other', 'the parents hall, lens'), ('none', 'box, other')):
        problem = read_contents(tmp_path / 'b', {'package_pose': 'tf'}, TagSought(
            child_frame=child)).problems['package_pose']
        assert named in str(problem)
