"""Damaged and hostile files of every reader: refused, read as if sound, or the loss reported."""

from pathlib import Path
import shutil

from bellows_ros.core.parameters.checks import resolve
from bellows_ros.core.signals.trajectory import PoseStream
from bellows_ros.files import safe_yaml
from bellows_ros.files.bag_writer import as_messages, write_bag
from bellows_ros.files.bags import read_contents, topics
from bellows_ros.files.parameter_files import read_parameters
from bellows_ros.files.results import format_json
from bellows_ros.files.trajectory_files import read_motive, read_tum
from bellows_ros.workflows.info import info
from bellows_ros.workflows.plan import read_plan
from bellows_ros.workflows.recordings import load
from bellows_ros.workflows.simulate import simulate_recording
import numpy as np
import yaml

from .frame import CLEAN, COUNTED, damaged, Failed, judged, replaced, scrambled, SILENT
from ..core.planning.test_arm import URDF
from ..files.yaml_plans import BAD, damaged_at, places_in, plan_messages

ROOT = Path(__file__).parents[2]
POSE = 'geometry_msgs/msg/PoseStamped'
TWIST = 'geometry_msgs/msg/TwistStamped'
START_NS = 1_760_000_000_000_000_000
PERIOD_NS = 10_000_000
HOUR_NS = 3_600_000_000_000
ROLES = {'tool_pose': '/tool', 'package_pose': '/box', 'tool_twist': '/twist'}
ATTEMPTS = 60  # of each turn


def motion(rng, count=300):
    """Return a tool, its twist, and a package below it."""
    t = np.arange(count) * PERIOD_NS * 1e-9
    stamps = START_NS + PERIOD_NS * np.arange(count)
    angle = 0.3 * (1.0 - np.cos(3.0 * t))
    poses = np.column_stack([
        0.1 * np.sin(4.0 * t), 0.1 * np.cos(3.0 * t), 1.0 + 0.0 * t, 0.0 * t, 0.0 * t,
        np.sin(angle / 2), np.cos(angle / 2)])
    below = poses - [0.0, 0.0, 0.08, 0.0, 0.0, 0.0, 0.0]
    below[:, :3] += 1e-4 * rng.normal(size=(count, 3))
    return (
        ('/tool', POSE, stamps, poses), ('/box', POSE, stamps, below),
        ('/twist', TWIST, stamps, np.gradient(poses[:, :6], t, axis=0)))


def bags(rng, folder):
    """Damage recordings of every form; messages of ours in MCAP have checksums."""
    bag, storage = folder / 'bag', ('mcap', 'sqlite3')[rng.integers(2)]
    write_bag(bag, [as_messages(*own) for own in motion(rng, 60)], storage, bool(rng.integers(2)))
    (stored,) = (p for p in bag.iterdir() if p.suffix != '.yaml')
    sound, good = stored.read_bytes(), read_contents(bag, ROLES)
    for _ in range(ATTEMPTS):
        stored.write_bytes(damaged(rng, sound))
        yield judged(str(bag), read_again, bag, good, storage == 'mcap')


def read_again(bag, good, summed):
    """Return what became of a recording; with checksums it must not change without a word."""
    found = read_contents(bag, ROLES)
    counted = {t.name: t.messages for t in topics(bag)}
    info(bag)
    lost = 0
    for role, stream in found.streams.items():
        require_sound(stream)
        lost += sum(map(len, stream.refused.values()))
        if len(stream) + sum(map(len, stream.refused.values())) != counted[ROLES[role]]:
            raise Failed(f'{role} does not add up')
    if found.notes or found.problems or lost:
        return COUNTED
    if all(same(found.streams[role], good.streams[role]) for role in ROLES):
        return CLEAN
    if summed:
        raise Failed('a change that the checksums show was not reported')
    return SILENT


def arrays(stream):
    """Return the numbers of a stream of poses or twists."""
    names = ('position', 'rotation') if isinstance(stream, PoseStream) else ('linear', 'angular')
    return [getattr(stream, name) for name in names]


def require_sound(stream):
    """Fail on numbers that are not finite and stamps that do not increase."""
    if not all(np.all(np.isfinite(array)) for array in arrays(stream)):
        raise Failed(f'{stream.name} holds numbers that are not finite')
    if np.any(np.diff(stream.stamps_ns) <= 0):
        raise Failed(f'the stamps of {stream.name} do not increase')


def same(one, other):
    """Tell whether two streams are equal."""
    return all(map(np.array_equal, (one.stamps_ns, *arrays(one)),
                   (other.stamps_ns, *arrays(other))))


def metadata(rng, folder):
    """Scramble metadata.yaml, or replace values in it: an error, a note, or no harm."""
    bag = folder / 'bag'
    write_bag(bag, [as_messages(*own) for own in motion(rng, 60)], 'mcap')
    file, good = bag / 'metadata.yaml', read_contents(bag, ROLES)
    text = file.read_text()
    for _ in range(ATTEMPTS):
        file.write_text(scrambled(rng, text) if rng.random() < 0.5 else yaml.safe_dump(
            replaced(rng, yaml.safe_load(text))))
        yield judged(str(bag), read_again, bag, good, True)


STAMPS = {
    'in pairs': lambda rng, s: s // (2 * PERIOD_NS) * 2 * PERIOD_NS + s % 1000 + np.arange(
        len(s)) % 2 * 1000,
    'in bursts': lambda rng, s: np.maximum.accumulate(s + rng.choice([0, 90_000_000], len(s))),
    'jittering': lambda rng, s: s + rng.integers(0, 3 * PERIOD_NS, len(s)),
    'one ahead': lambda rng, s: s + (np.arange(len(s)) == rng.integers(len(s))) * HOUR_NS,
    'some ahead': lambda rng, s: s + rng.choice([0, 0, 0, 5_000_000_000], len(s)),
    'set back': lambda rng, s: s - (np.arange(len(s)) > rng.integers(len(s))) * 2_000_000_000,
    'repeated': lambda rng, s: s // (3 * PERIOD_NS) * 3 * PERIOD_NS,
    'backward': lambda rng, s: s[::-1],
    'anything': lambda rng, s: rng.integers(0, 2**62, len(s)),
    'three': lambda rng, s: s[:3] + rng.integers(0, 10**10, 3),
}
VALUES = (np.nan, np.inf, 0.0, 1e300, -1e7, 1e-320)


def recordings(rng, folder):
    """Record strange stamps and values, and look into what is recorded as the commands do."""
    plain = resolve({
        'topics.tool_pose': '/tool', 'topics.package_pose': '/box', 'cup.length': 0.05,
        'topics.tool_twist': '/twist', 'package.mass': 2.0, 'package.com': (0.0, 0.0, -0.03),
        'package.inertia': (0.01, 0.01, 0.01, 0.0, 0.0, 0.0), 'recording.package_frame': 'com'})
    for number in range(ATTEMPTS):
        values = plain.replaced({
            'recording.package_world': ('', '0 0 0 0 0 0 1')[rng.integers(2)]})
        topics_ = [hostile(rng, *own) if rng.random() < 0.6 else as_messages(*own)
                   for own in motion(rng, int(rng.integers(3, 400)))]
        bag = folder / f'bag{number}'
        write_bag(bag, topics_)
        yield judged('', looked_into, bag, values)
        shutil.rmtree(bag)


def hostile(rng, topic, kind, good_stamps, good_values):
    """Return a topic with strange stamps, some strange values, and arrivals as they were."""
    stamps = np.asarray(STAMPS[str(rng.choice(list(STAMPS)))](rng, good_stamps))
    values = np.array(good_values[:len(stamps)])
    if rng.random() < 0.5:
        rows = rng.integers(len(values), size=rng.integers(1, 9))
        values[rows, rng.integers(values.shape[1])] = rng.choice(VALUES)
    arrivals = good_stamps[:len(stamps)] + 1_000_000 if rng.random() < 0.7 else None
    frame = ('world', '', '\x1b[2J' * 9, 'x' * 3000)[rng.integers(4)]
    return as_messages(topic, kind, stamps, values, frame, log_times_ns=arrivals)


def looked_into(bag, values):
    """Return what becomes of a recording that is described and prepared."""
    found = info(bag)
    format_json(found.as_json())
    prepared = load(bag, values)
    for body in (prepared.tool, prepared.package):
        if not all(np.all(np.isfinite(x)) for x in (body.position, body.rotation, body.twist)):
            raise Failed('numbers that are not finite')
    return COUNTED if found.notes or any(t.refused or t.outliers for t in found.topics) else CLEAN


def texts(files):
    """Return the round that scrambles text files; what is read must be finite."""
    def run(rng, folder):
        for _ in range(ATTEMPTS):
            name = str(rng.choice(list(files)))
            text, read = files[name]
            file = folder / Path(name).name
            file.write_text(text)
            good = repr(read(file))
            file.write_text(scrambled(rng, text), errors='replace')
            yield judged('', compared, read, file, good)

    return run


def compared(read, file, good):
    """Return whether a file is read as it was before."""
    found = read(file)
    require_finite(found)
    return CLEAN if repr(found) == good else SILENT


def require_finite(found):
    """Fail where a number in nested content is not finite."""
    if isinstance(found, dict):
        found = list(found.values())
    if isinstance(found, list | tuple):
        for item in found:
            require_finite(item)
    elif isinstance(found, float) and found != found:
        raise Failed('a number that is not finite')


TUM = '# time x y z qx qy qz qw\n' + ''.join(
    f'{1.7e9 + 0.01 * k:.4f} 0.1 0.2 {0.3 + 1e-3 * k:.4f} 0 0 0 1\n' for k in range(30))
MOTIVE = (
    'Format Version,1.23,Take Name,x,Capture Start Time,2021-05-11 02.31.05.250 PM,'
    'Rotation Type,Quaternion,Length Units,Meters,Coordinate Space,Global\n\n'
    ',Type' + ',Rigid Body' * 7 + '\n,Name' + ',box' * 7 + '\n,ID' + ',1' * 7 + '\n'
    ',' + ',Rotation' * 4 + ',Position' * 3 + '\nFrame,Time (Seconds),X,Y,Z,W,X,Y,Z\n'
    + ''.join(f'{k},{0.01 * k},0,0,0,1,{1e-3 * k},1,2\n' for k in range(30)))
tables = texts({'tum.csv': (TUM, read_tum), 'motive.csv': (MOTIVE, read_motive)})


def motions(rng, folder):
    """Scramble the motions that `bellows simulate` takes."""
    text = (ROOT / 'bags' / 'static.yaml').read_text()
    values = read_parameters(ROOT / 'bags' / 'cup.yaml')
    for number in range(ATTEMPTS // 6):
        file, out = folder / 'motion.yaml', folder / f'out{number}'
        file.write_text(scrambled(rng, text), errors='replace')
        yield judged('', simulated, values, file, out)


def simulated(values, file, out):
    """Simulate a motion; what is recorded of it must be sound."""
    simulate_recording(values, safe_yaml.load(file), out)
    for stream in read_contents(out, {'tool_pose': '/tool_arm/pose'}).streams.values():
        require_sound(stream)
    return CLEAN


def plans(rng, folder):
    """Scramble plans as YAML, and put bad values in every place of them."""
    file, messages, urdf = folder / 'plan.yaml', plan_messages(), folder / 'arm.urdf'
    urdf.write_text(URDF)
    values = resolve({'tool_link': 'tool'})

    def read():
        require_finite(read_plan(file, values, str(urdf)).tool.position.tolist())
        return CLEAN

    for _ in range(ATTEMPTS):
        content = messages[str(rng.choice(list(messages)))]
        if rng.random() < 0.5:
            places = list(places_in(content))
            value = (*BAD, ...)[rng.integers(len(BAD) + 1)]
            text = yaml.safe_dump(damaged_at(content, places[rng.integers(len(places))], value))
        else:
            text = scrambled(rng, yaml.safe_dump(content))
        file.write_text(text, errors='replace')
        yield judged('', read)


parameters = texts({
    name: ((ROOT / name).read_text(), read_parameters)
    for name in ('config/predictor.yaml', 'bags/cup.yaml', 'bags/package.yaml')})
