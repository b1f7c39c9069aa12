"""Damaged and hostile files of every reader: refused in words, or read with finite numbers."""

from functools import partial, reduce
import json
import math
from operator import getitem

from bellows_ros.core.parameters.checks import resolve
from bellows_ros.core.planning.limits import read_limits
from bellows_ros.core.signals.trajectory import PoseStream
from bellows_ros.errors import BellowsError
from bellows_ros.files import safe_yaml
from bellows_ros.files.bags import as_messages, Encoded, read_contents, topics, write_bag
from bellows_ros.files.detections import read_contents as detections_of
from bellows_ros.files.detections import TagSought
from bellows_ros.files.messages import BOOL, CAMERA_INFO, DETECTIONS, pack, TRANSFORMS
from bellows_ros.files.parameter_files import read_parameters
from bellows_ros.files.plans import (
    arm_of,
    DESCRIPTION,
    encode,
    JOINTS,
    MULTI_DOF,
    PATH,
    Plan,
    recorded_joints,
    STATES,
)
from bellows_ros.files.results import format_json
from bellows_ros.files.trajectory_files import read_motive, read_tum
from bellows_ros.workflows.holds import signals_of
from bellows_ros.workflows.info import info
from bellows_ros.workflows.plan import read_plan
from bellows_ros.workflows.recordings import load
from bellows_ros.workflows.simulate import simulate_recording
import numpy as np
import pytest

from ..core.planning.test_arm import URDF
from ..files.recordings import (
    encoded,
    header,
    ODOMETRY,
    plan_messages,
    POSE,
    POSE_COVARIANCE,
    serialized,
    TRANSFORM,
    TWIST,
)
from ..files.test_detections import calibration, detections, LENSES, views
from ..files.test_detections import encoded as of_camera

NAMES, PRESSURE = ['turn', 'slide', 'spin'], 'sensor_msgs/msg/FluidPressure'
PERIOD_NS = 10_000_000
STAMPS = 1_760_000_000_000_000_000 + PERIOD_NS * np.arange(60)
ROLES = {'tool_pose': '/tool', 'package_pose': '/box', 'tool_twist': '/twist'}
ATTEMPTS = 20  # of each seed
VALUES = (
    math.nan, math.inf, -1, 0, 10**30, 1e308, -1e-320, None, True, '', [], {}, [[1.0]], [1] * 500,
    'a' * 5000, '9' * 400, "'", '\0', '\x1b[2J', ' ', '\n', '#', '&a', '*a', '1:30', 'sqlite3',
    'FILE', '/etc/passwd', ['../bag.mcap'], '\u202e', '\U0001f600')

of_seeds = pytest.mark.parametrize('seed', [
    0, *(pytest.param(seed, marks=pytest.mark.stress) for seed in range(1, 40))])


def refused(named, read, *arguments):
    """Return whether a file is refused, in words that name something."""
    try:
        read(*arguments)
    except BellowsError as error:
        assert 10 < len(str(error)) < 3000 and named in str(error)
        return True
    return False


def damaged(rng, whole):
    """Return bytes with a few bits turned, or a block of them overwritten, lost or doubled."""
    data = bytearray(whole)
    at, size = int(rng.integers(len(data))), int(rng.integers(1, 400))
    kind = rng.integers(5)
    if kind == 0:
        for place in rng.integers(len(data), size=rng.integers(1, 20)):
            data[place] ^= 1 << rng.integers(8)
    elif kind == 1:
        data[at:at + size] = rng.bytes(len(data[at:at + size]))
    elif kind == 2:
        del data[at:at + size]
    elif kind == 3:
        data[at:at] = data[at:at + size]
    else:
        del data[at:]
    return bytes(data)


def replaced(rng, content):
    """Replace some value in nested content, or leave it out; return the content."""
    if not isinstance(content, dict | list) or not content or rng.random() < 0.1:
        return VALUES[rng.integers(len(VALUES))]
    keys = list(content) if isinstance(content, dict) else range(len(content))
    key = keys[rng.integers(len(keys))]
    if rng.random() < 0.1:
        del content[key]
    else:
        content[key] = replaced(rng, content[key])
    return content


def scrambled(rng, text, nested):
    """Return a text with a value or words of it replaced, or with its bytes damaged."""
    if nested and rng.random() < 0.5:
        return json.dumps(replaced(rng, json.loads(nested)))
    if rng.random() < 0.3:
        return damaged(rng, text.encode()).decode(errors='replace')
    cells = text.split(' ')
    for _ in range(rng.integers(1, 4)):
        other = (str(VALUES[rng.integers(len(VALUES))]), cells[rng.integers(len(cells))])
        cells[rng.integers(len(cells))] = other[rng.integers(2)]
    return ' '.join(cells)


def require_finite(found):
    """Require numbers in nested content to be finite."""
    if isinstance(found, dict | list | tuple):
        for item in found.values() if isinstance(found, dict) else found:
            require_finite(item)
    assert not isinstance(found, float) or math.isfinite(found)


def recorded():
    """Return topic, type, stamps and values of a tool, a package below it, and a twist."""
    t = 1e-9 * (STAMPS - STAMPS[0])
    angle = 0.3 * (1.0 - np.cos(3.0 * t))
    poses = np.column_stack([
        0.1 * np.sin(4.0 * t), 0.1 * np.cos(3.0 * t), 1.0 + 0.0 * t, 0.0 * t, 0.0 * t,
        np.sin(angle / 2), np.cos(angle / 2)])
    return (
        ('/tool', POSE, STAMPS, poses),
        ('/box', POSE, STAMPS, poses - [0.0, 0.0, 0.08, 0.0, 0.0, 0.0, 0.0]),
        ('/twist', TWIST, STAMPS, np.gradient(poses[:, :6], t, axis=0)))


def arrays(stream):
    """Return stamps and numbers of a stream."""
    names = ('position', 'rotation') if isinstance(stream, PoseStream) else ('linear', 'angular')
    return [stream.stamps_ns, *(getattr(stream, name) for name in names)]


def read_again(bag):
    """Read a recording: finite and counted."""
    found = read_contents(bag, ROLES)
    counted = {topic.name: topic.messages for topic in topics(bag)}
    info(bag)
    for role, stream in found.streams.items():
        left_out = sum(map(len, stream.refused.values()))
        found_all = len(stream) + left_out == counted[ROLES[role]]
        assert found_all or any('read were' in note for note in found.notes)
        assert all(np.all(np.isfinite(array)) for array in arrays(stream))
        assert np.all(np.diff(stream.stamps_ns) > 0)


@of_seeds
@pytest.mark.parametrize('zstd', [False, True])
@pytest.mark.parametrize('storage', ['mcap', 'sqlite3'])
def test_damaged_recordings(storage, zstd, seed, tmp_path):
    """Damage the storage, and then the metadata."""
    rng, bag = np.random.default_rng(seed), tmp_path / 'bag'
    write_bag(bag, [as_messages(*own) for own in recorded()], storage, zstd)
    (stored,) = (path for path in bag.iterdir() if path.suffix != '.yaml')
    sound = stored.read_bytes()
    for _ in range(ATTEMPTS):
        stored.write_bytes(damaged(rng, sound))
        refused(str(bag), read_again, bag)
    stored.write_bytes(sound)
    file = bag / 'metadata.yaml'
    text = file.read_text()
    nested = json.dumps(safe_yaml.load(file))
    for _ in range(ATTEMPTS):
        file.write_text(scrambled(rng, text, nested), errors='replace')
        refused(str(bag), read_again, bag)


def leaves(content, *path):
    """Yield the paths of all values in nested content."""
    for key, value in content.items() if isinstance(content, dict) else enumerate(content):
        yield *path, key
        if isinstance(value, dict | list):
            yield from leaves(value, *path, key)


def test_each_value_of_metadata_with_a_wrong_type(tmp_path):
    """Put each kind of value into each place of metadata.yaml."""
    bag = tmp_path / 'bag'
    write_bag(bag, [as_messages(*own) for own in recorded()])
    text = json.dumps(safe_yaml.load(bag / 'metadata.yaml'))
    tried = refusals = 0
    for path in leaves(json.loads(text)):
        for value in (None, 'x', '', -1, 1.5, True, [], ['x'], {}):
            content = json.loads(text)
            inner = reduce(getitem, path[:-1], content)
            inner[path[-1]] = value
            (bag / 'metadata.yaml').write_text(json.dumps(content))
            refusals += refused(str(bag), read_contents, bag, ROLES)
            refused(str(bag), topics, bag)
            tried += 1
    assert tried > 400 and refusals > tried / 3


def recorded_cell():
    """Return the messages of every topic that a command reads, by topic."""
    poses, count = recorded()[0][3], len(STAMPS)
    way = np.linspace(0.0, 0.3, count)[:, None] * np.ones(3)
    plan = Plan(MULTI_DOF, 0, 'base', ('tool',), PERIOD_NS * np.arange(8), poses[:8])
    joints = plan._replace(kind=JOINTS, names=NAMES, points=way[:8], rates=way[:8])
    pixels = views()[2] * 900.0 + 600.0
    motions = [Encoded(topic, kind, STAMPS, [
        encoded(kind, stamp, pose=pose, twist=pose[:6])
        for stamp, pose in zip(STAMPS, poses, strict=True)]) for topic, kind in (
            ('/covariance', POSE_COVARIANCE), ('/transform', TRANSFORM), ('/odometry', ODOMETRY))]
    others = {
        ('/joint_states', STATES): [
            serialized(STATES, (header(stamp, ''), NAMES, q, 0.5 + 0.0 * q, []))
            for stamp, q in zip(STAMPS, way, strict=True)],
        ('/tf', TRANSFORMS): [
            pack(TRANSFORMS, ('camera', 'box'), int(stamp), *pose)
            for stamp, pose in zip(STAMPS, poses, strict=True)],
        ('/vacuum/held', BOOL): [serialized(BOOL, (k % 20 < 10,)) for k in range(count)],
        ('/vacuum/pressure', PRESSURE): [
            serialized(PRESSURE, (header(stamp), 3e4 + stamp % 5e4, 0.0)) for stamp in STAMPS],
        ('/robot_description', DESCRIPTION): [serialized(DESCRIPTION, (URDF,))],
        ('/plan', MULTI_DOF): [encode(plan)], ('/plan_joints', JOINTS): [encode(joints)],
        ('/plan_path', PATH): [encode(plan._replace(kind=PATH))]}
    return {each.topic: each for each in (
        *(as_messages(*own) for own in recorded()), *motions,
        of_camera('/detections', DETECTIONS, detections(pixels)),
        of_camera('/camera', CAMERA_INFO, [calibration('plumb_bob', LENSES['plumb_bob'])]),
        *(Encoded(*names, STAMPS[:len(data)], data) for names, data in others.items()))}


def streamed(topic, role='measured'):
    """Return a function that reads poses with covariances, corners of a tag, or twists."""
    def read(bag):
        tag = TagSought(0.06, child_frame='box' if topic == '/tf' else '')
        found = detections_of(bag, {role: topic}, tag)
        for stream in found.streams.values():
            assert all(np.all(np.isfinite(array)) for array in arrays(stream))

    return read


def planned(topic):
    """Return a function that reads a plan, or recorded joints."""
    def read(bag):
        urdf = str(bag.with_name('arm.urdf')) if 'joint' in topic else ''
        tool = read_plan(bag, resolve({'tool_link': 'tool'}), urdf, topic).tool
        assert np.all(np.isfinite(tool.position)) and np.all(np.isfinite(tool.twist))

    return read


def signalled(kind):
    """Return a function that reads when packages are held."""
    return lambda bag: signals_of(bag, resolve({'vacuum.signal': kind}))


READERS = {
    **{topic: streamed(topic) for topic in (
        '/tool', '/covariance', '/transform', '/odometry', '/tf', '/detections')},
    '/camera': streamed('/detections'), '/twist': streamed('/twist', 'tool_twist'),
    **{topic: planned(topic) for topic in ('/plan', '/plan_path', '/plan_joints')},
    **dict.fromkeys(('/joint_states', '/robot_description'), lambda bag: recorded_joints(
        bag, arm_of('', 'tool', bag))),
    '/vacuum/held': signalled('bool'), '/vacuum/pressure': signalled('pressure')}
"""Functions that read a recording, by the topic on which they depend."""
TOGETHER = ('/detections', '/camera'), ('/joint_states', '/robot_description')
"""Topics that are read together."""


def with_a_wrong_number(rng, message):
    """Return a message with eight or four bytes of another number, or damaged."""
    data, width = bytearray(message), int(rng.choice([8, 4]))
    if len(data) < 12 or rng.random() < 0.3:
        return damaged(rng, message)
    at = int(rng.integers(4, len(data) - 7)) // 4 * 4
    number = np.float64(rng.choice([np.nan, np.inf, -1e300, 1e-320, 0.0])) if width == 8 else (
        np.uint32(rng.choice([0, 1, 2**31, 2**32 - 1, 10**9])))
    data[at:at + width] = number.tobytes()
    return bytes(data)


@of_seeds
@pytest.mark.filterwarnings('error::RuntimeWarning')
@pytest.mark.parametrize('topic', READERS)
def test_damaged_messages(topic, seed, tmp_path):
    """Damage some or all messages of a topic in a recording that is whole."""
    rng, bag, cell = np.random.default_rng(seed), tmp_path / 'bag', recorded_cell()
    (tmp_path / 'arm.urdf').write_text(URDF)
    sound = cell[topic].data
    for number in range(ATTEMPTS // 2):
        share = rng.choice([0.1, 1.0]) if len(sound) > 1 else 1.0
        cell[topic] = cell[topic]._replace(data=[
            with_a_wrong_number(rng, each) if number and rng.random() < share else each
            for each in sound])
        names = next((names for names in TOGETHER if topic in names), (topic,))
        write_bag(bag, [cell[name] for name in names], replace=True)
        assert not refused('', READERS[topic], bag) or number
        refused('', lambda: format_json(info(bag).as_json()))


STRANGE = {
    'in pairs': lambda rng, s: s // (2 * PERIOD_NS) * 2 * PERIOD_NS + np.arange(len(s)) % 2 * 1000,
    'in bursts': lambda rng, s: np.maximum.accumulate(s + rng.choice([0, 90_000_000], len(s))),
    'jittering': lambda rng, s: s + rng.integers(0, 3 * PERIOD_NS, len(s)),
    'some ahead': lambda rng, s: s + rng.choice([0, 0, 0, 5_000_000_000], len(s)),
    'set back': lambda rng, s: s - (np.arange(len(s)) > rng.integers(len(s))) * 2_000_000_000,
    'repeated': lambda rng, s: s // (3 * PERIOD_NS) * 3 * PERIOD_NS,
    'anything': lambda rng, s: rng.integers(0, 2**31 * 10**9, len(s)),  # all that a stamp holds
    'three': lambda rng, s: s[:3] + rng.integers(0, 10**10, 3)}


@of_seeds
@pytest.mark.parametrize('stamps', STRANGE)
def test_strange_stamps_and_values(stamps, seed, tmp_path):
    """Describe and prepare what a faulty driver records."""
    rng = np.random.default_rng(seed)
    values = resolve({
        'topics.tool_pose': '/tool', 'topics.package_pose': '/box', 'cup.length': 0.05,
        'topics.tool_twist': '/twist', 'package.mass': 2.0, 'package.com': (0.0, 0.0, -0.03),
        'package.inertia': (0.01, 0.01, 0.01, 0.0, 0.0, 0.0), 'recording.package_frame': 'com'})

    def prepare(bag):
        format_json(info(bag).as_json())
        found = load(bag, values)
        for body in (found.tool, found.package):
            assert all(np.all(np.isfinite(x)) for x in (body.position, body.rotation, body.twist))

    for number in range(2):
        bag, messages = tmp_path / f'bag{number}', []
        for topic, kind, good_stamps, good in recorded():
            strange_ns = np.asarray(STRANGE[stamps](rng, good_stamps))
            some, rows = good[:len(strange_ns)].copy(), rng.integers(len(strange_ns), size=5)
            some[rows, rng.integers(some.shape[1])] = rng.choice([np.nan, np.inf, 0.0, 1e300])
            messages.append(as_messages(
                topic, kind, strange_ns, some, ('world', '', 'x' * 3000)[rng.integers(3)]))
        write_bag(bag, messages)
        refused('', prepare, bag)


TUM = '# time x y z qx qy qz qw\n' + ''.join(
    f'{1.7e9 + 0.01 * k:.4f} 0.1 0.2 {0.3 + 1e-3 * k:.4f} 0 0 0 1\n' for k in range(30))
MOTIVE = (
    'Format Version,1.23,Take Name,x,Capture Start Time,2021-05-11 02.31.05.250 PM,'
    'Rotation Type,Quaternion,Length Units,Meters,Coordinate Space,Global\n\n'
    ',Type' + ',Rigid Body' * 7 + '\n,Name' + ',box' * 7 + '\n,ID' + ',1' * 7 + '\n'
    ',' + ',Rotation' * 4 + ',Position' * 3 + '\nFrame,Time (Seconds),X,Y,Z,W,X,Y,Z\n'
    + ''.join(f'{k}, {0.01 * k}, 0, 0, 0, 1, {1e-3 * k}, 1, 2\n' for k in range(30)))


def plan_in(file):
    """Read a plan, one of joints with its arm, and return its positions."""
    urdf = ''
    if file.name == 'joints.yaml':
        file.with_name('arm.urdf').write_text(URDF)
        urdf = str(file.with_name('arm.urdf'))
    return read_plan(file, resolve({'tool_link': 'tool'}), urdf).tool.position.tolist()


def arm_in(file):
    """Read the arm of a URDF, and return the pose of its tool."""
    arm = arm_of(file, 'tool')
    return arm.tool(np.zeros((1, len(arm.moving))))[0].tolist()


def simulated(root, file):
    """Simulate a motion file, and return the positions that are recorded."""
    out = file.with_name('out')
    simulate_recording(
        read_parameters(root / 'bags/cup.yaml'), safe_yaml.load(file), out, replace=True)
    stream = read_contents(out, {'tool_pose': '/tool_arm/pose'}).streams['tool_pose']
    return stream.position.tolist()


@pytest.fixture(scope='module')
def texts(root):
    """Give text and reader of each kind of file."""
    return {
        'motion.tum': (TUM, read_tum), 'take.csv': (MOTIVE, read_motive),
        'predictor.yaml': ((root / 'config/predictor.yaml').read_text(), read_parameters),
        'cup.yaml': ((root / 'bags/cup.yaml').read_text(), read_parameters),
        'limits.yaml': ((root / 'config/limits_example.yaml').read_text(),
                        lambda file: read_limits(safe_yaml.load_names(file))),
        'arm.urdf': (URDF, arm_in),
        **{f'{kind}.yaml': (json.dumps(plan), plan_in) for kind, plan in plan_messages().items()},
        'motion.yaml': ((root / 'bags/static.yaml').read_text(), partial(simulated, root))}


@of_seeds
@pytest.mark.parametrize('name', [
    'motion.tum', 'take.csv', 'predictor.yaml', 'cup.yaml', 'multi.yaml', 'path.yaml',
    'joints.yaml', 'motion.yaml', 'limits.yaml', 'arm.urdf'])
def test_scrambled_texts(name, seed, texts, tmp_path):
    """Tables, parameters, plans and motions."""
    (text, read), rng, file = texts[name], np.random.default_rng(seed), tmp_path / name
    file.write_text(text)
    read(file)
    nested = json.dumps(safe_yaml.load(file)) if file.suffix == '.yaml' else ''
    for _ in range(5 if name == 'motion.yaml' else ATTEMPTS):
        file.write_text(scrambled(rng, text, nested), errors='replace')
        refused('', lambda: require_finite(read(file)))
