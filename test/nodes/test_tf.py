"""Tags and frames on tf, and detected corners, where their messages are installed."""

import importlib.util

from bellows_ros.core.model.structure import THESIS_LENGTH
from bellows_ros.errors import BellowsError
from bellows_ros.nodes.conversions import vector
from geometry_msgs.msg import PoseStamped, TransformStamped
from numpy.testing import assert_allclose
import pytest
from rclpy.parameter import Parameter
from sensor_msgs.msg import CameraInfo

from .conftest import ERROR, LATCHED, MS, PACKAGE, stamped, START


@pytest.fixture
def tf2_msgs():
    """Give the messages of tf."""
    return pytest.importorskip('tf2_msgs.msg', reason='no tf2_msgs here')


@pytest.fixture
def apriltag_msgs():
    """Give the messages of apriltag_ros."""
    return pytest.importorskip('apriltag_msgs.msg', reason='no apriltag_msgs here')


def test_tf_shows_the_package_where_the_pose_has_it(make_partner, tf2_msgs):
    """Send the transform from the tool's frame to the package's for every prediction."""
    partner = make_partner(PACKAGE, with_twists=False)
    got = partner.hears(tf2_msgs.TFMessage, '/tf')
    partner.connect()
    partner.wait(lambda: partner.predictor.pipeline.outputs._tf.subscribed)
    for k in range(20):  # the tool starts to move, so that no two poses are alike
        partner.send_pose(START + k * MS, (0.001 * k * k * 1e-3, 0.0, 0.5))
    partner.wait_for_poses(20)
    partner.wait(lambda: len(got) == 20)

    assert {len(message.transforms) for message in got} == {1}
    for message, pose in zip(got, partner.poses, strict=True):
        (shown,) = message.transforms
        assert shown.header == pose.header
        assert shown.child_frame_id == 'package'
        assert shown.transform.rotation == pose.pose.orientation
        assert vector(shown.transform.translation) == vector(pose.pose.position)
    assert len({message.transforms[0].transform.translation.x for message in got}) > 10


def send(writer, kind, stamp_ns, *links):
    """Send transforms of frames that are shifted along z."""
    message = kind()
    for parent, child, z in links:
        link = stamped(TransformStamped(child_frame_id=child), stamp_ns, parent)
        link.transform.translation.z = z
        message.transforms.append(link)
    writer.publish(message)


def test_the_tool_may_come_by_tf(make_predictor, tf2_msgs, listener):
    """Predict along static and moving links, and say what is missing before."""
    send(listener.writes(tf2_msgs.TFMessage, '/tf_static', LATCHED), tf2_msgs.TFMessage, 0,
         ('map', 'base', 2.0), ('flange', 'cup', -0.1))
    predictor = make_predictor({
        **PACKAGE, 'tool_pose.type': 'tf', 'frames.world': 'map', 'frames.tool': 'cup'})
    (heard,) = (end for end in predictor.subscriptions if end.topic_name == '/tf')
    got = listener.hears(PoseStamped, 'package/pose')
    moving = listener.writes(tf2_msgs.TFMessage, '/tf')
    listener.connect()
    listener.wait(lambda: heard.get_publisher_count() == 2)  # itself and the driver
    assert listener.sees('tool pose', ERROR, "lead up to 'map' and 'flange'")
    for k in range(5):
        send(moving, tf2_msgs.TFMessage, START + k * MS, ('base', 'flange', -0.5),
             ('world', 'camera', 1.0 * k))
    listener.wait(lambda: len(got) == 5)
    assert {pose.header.frame_id for pose in got} == {'map'}
    assert [pose.header.stamp.nanosec for pose in got] == [k * MS for k in range(5)]
    stretched = THESIS_LENGTH + 2.17 * 9.81 / 1.153e4
    for pose in got:
        assert_allclose(pose.pose.position.z, 2.0 - 0.5 - 0.1 - stretched - 0.03, atol=1e-6)


def test_a_tag_may_come_by_tf(make_partner, tf2_msgs):
    """Correct by the frame of the tag, and by no other, in the frame of its camera."""
    partner = make_partner({
        **PACKAGE, 'measured.type': 'tf', 'measured.child_frame': 'tag36h11:7',
        'recording.package_world': '0.0 0.0 0.0 0.0 0.0 0.0 1.0'}, with_twists=False)
    observing = partner.predictor.pipeline.observing
    tags = partner.writes(tf2_msgs.TFMessage, '/tf')
    partner.connect()
    partner.send_pose(START)
    partner.wait_for_poses(1)
    z = partner.poses[-1].pose.position.z
    for k in range(1, 5):
        send(tags, tf2_msgs.TFMessage, START + k * MS, ('camera', 'tag36h11:7', z),
             ('camera', 'tag36h11:8', 3.0))
        partner.send_pose(START + k * MS)
    partner.wait_for_poses(5)
    partner.wait(lambda: sum(observing._observer.counts.values()) >= 3)
    assert sum(observing._observer.counts.values()) <= 4


def test_a_tag_may_come_by_its_corners(make_partner, apriltag_msgs):
    """Use no view before the calibration, and see the tag where its pose has it afterwards."""
    partner = make_partner({
        **PACKAGE, 'measured.type': 'detections', 'measured.tag_size': 0.05,
        'recording.package_world': '0.0 0.0 0.0 1.0 0.0 0.0 0.0'}, with_twists=False)
    observing = partner.predictor.pipeline.observing
    tags = partner.writes(apriltag_msgs.AprilTagDetectionArray, 'package/measured')
    cameras = partner.writes(CameraInfo, 'package/camera_info')
    partner.connect()
    partner.send_pose(START)
    partner.wait_for_poses(1)
    depth = -partner.poses[-1].pose.position.z  # the camera looks down

    def see(stamp_ns, shift=0.0):
        one = apriltag_msgs.AprilTagDetection(id=7)
        for corner, (x, y) in zip(one.corners, ((-1, 1), (1, 1), (1, -1), (-1, -1)), strict=True):
            corner.x = 640.0 + shift + 900.0 * 0.025 * x / depth
            corner.y = 360.0 - 900.0 * 0.025 * y / depth
        tags.publish(stamped(apriltag_msgs.AprilTagDetectionArray(detections=[one]),
                             stamp_ns, 'optical'))

    see(START)
    partner.wait(lambda: observing._no_view == {'tag_no_camera': 1})
    info = stamped(CameraInfo(distortion_model='plumb_bob'), START, 'optical')
    info.k = [900.0, 0.0, 640.0, 0.0, 900.0, 360.0, 0.0, 0.0, 1.0]
    cameras.publish(info)
    partner.wait(lambda: observing._tag._cameras)
    for k in range(1, 5):
        see(START + k * MS, 1e-3 * k)  # an equal view is that of a lost tag
        partner.send_pose(START + k * MS)
    partner.wait_for_poses(5)
    partner.wait(lambda: observing._observer and observing._observer.counts['used'])
    counts = observing._observer.counts
    assert counts['used'] + counts['late'] == sum(counts.values())  # late: before the observer
    for size in (0.0, 1e-12):
        (result,) = partner.predictor.set_parameters([Parameter('measured.tag_size', value=size)])
        assert not result.successful and 'measured.tag_size' in result.reason


@pytest.mark.skipif(importlib.util.find_spec('apriltag_msgs') is not None, reason='it is here')
def test_corners_without_their_messages_or_the_size_of_the_tag_are_refused(make_predictor):
    """Name the missing package, or the missing parameter."""
    for size, named in ((0.0, 'measured.tag_size'), (1e-12, 'measured.tag_size'),
                        (0.05, 'ros-jazzy-apriltag-msgs')):
        with pytest.raises(BellowsError, match=named):
            make_predictor({**PACKAGE, 'measured.type': 'detections', 'measured.tag_size': size})


@pytest.mark.skipif(importlib.util.find_spec('tf2_msgs') is not None, reason='tf2_msgs is here')
def test_missing_tf_is_reported_for_a_tool_by_tf_only(make_predictor, make_partner, capfd):
    """Say what is missing, and predict; refuse what needs it."""
    with pytest.raises(BellowsError):
        make_predictor({**PACKAGE, 'tool_pose.type': 'tf'})
    for frame, named in (('', 'measured.child_frame'), ('tag', 'measured.type .* tf2_msgs')):
        with pytest.raises(BellowsError, match=named):
            make_predictor(
                {**PACKAGE, 'measured.type': 'tf', 'measured.child_frame': frame})
    make_partner(with_twists=False).predict(START)
    assert 'tf2_msgs is not installed' in capfd.readouterr().err
