"""Plans as `ros2 topic echo` prints them, and damages of them."""

from copy import deepcopy
import json

BAD = (
    float('inf'), float('nan'), -1, 2**31, 2**62, 2**63, 10**400, 1e308, -1e308, 0.5, True, None,
    '', 'x', '1e5', [], [[]], {})
"""What stands in place of something."""


def cartesian(times_ns, poses, twists):
    """Return a plan of the tool, from poses (N, 7) and twists (N, 6)."""
    def parts(axes, row):
        return dict(zip(axes, map(float, row), strict=True))

    return {'header': {'stamp': {'sec': 0, 'nanosec': 0}, 'frame_id': 'base'},
            'joint_names': ['tool'], 'points': [{
                'transforms': [{
                    'translation': parts('xyz', p[:3]), 'rotation': parts('xyzw', p[3:])}],
                'velocities': [{'linear': parts('xyz', v[:3]), 'angular': parts('xyz', v[3:])}],
                'accelerations': [],
                'time_from_start': dict(zip(
                    ('sec', 'nanosec'), divmod(int(at), 10**9), strict=True)),
            } for at, p, v in zip(times_ns, poses, twists, strict=True)]}


def plan_messages(count=4):
    """Return a plan of each type that lasts 0.1 s per point."""
    rows = [(0.01 * k, -0.0, 1e-05, 0.0, 0.0, 0.0, 1.0) for k in range(count)]
    multi = cartesian(
        [k * 10**8 for k in range(count)], rows, [(0.1, 0.0, 0.0, 0.0, 0.0, 0.0)] * count)
    header = multi['header']
    poses = [each['transforms'][0] for each in multi['points']]
    times = [each['time_from_start'] for each in multi['points']]
    return json.loads(json.dumps({  # without parts that YAML would write as aliases
        'multi': multi,
        'path': {'header': header, 'poses': [{
            'header': {'stamp': at, 'frame_id': 'base'},
            'pose': {'position': pose['translation'], 'orientation': pose['rotation']},
        } for pose, at in zip(poses, times, strict=True)]},
        'joints': {'header': header, 'joint_names': ['turn', 'slide', 'spin'], 'points': [{
            'positions': [pose['translation']['x'], 0.0, 0.0], 'velocities': [],
            'accelerations': [], 'effort': [], 'time_from_start': at,
        } for pose, at in zip(poses, times, strict=True)]}}))


def places_in(content, keys=()):
    """Yield the keys that lead to each part of nested content; of points only the third's."""
    if keys:
        yield keys
    parts = content.items() if isinstance(content, dict) else (
        enumerate(content) if isinstance(content, list) else ())
    for key, part in parts:
        if len(keys) != 1 or key in (2, 'stamp', 'frame_id'):
            yield from places_in(part, (*keys, key))


def damaged_at(content, keys, value):
    """Return content with a value in place of a part of it, or without that part."""
    found = part = deepcopy(content)
    for key in keys[:-1]:
        part = part[key]
    if value is ...:
        del part[keys[-1]]
    else:
        part[keys[-1]] = value
    return found
