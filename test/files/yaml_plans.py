"""Plans as `ros2 topic echo` prints them, and damages of them."""

from copy import deepcopy
import json

BAD = (
    float('inf'), float('nan'), -1, 2**31, 2**62, 2**63, 10**400, 1e308, -1e308, 0.5, True, None,
    '', 'x', '1e5', [], [[]], {})
"""What stands in place of something."""


def plan_messages(count=4):
    """Return a plan of each type that lasts 0.1 s per point."""
    header = {'stamp': {'sec': 0, 'nanosec': 0}, 'frame_id': 'base'}
    times = [dict(zip(('sec', 'nanosec'), divmod(k * 10**8, 10**9), strict=True))
             for k in range(count)]
    places = [{'x': 0.01 * k, 'y': -0.0, 'z': 1e-05} for k in range(count)]
    upright, still = {'x': 0.0, 'y': 0.0, 'z': 0.0, 'w': 1.0}, {'x': 0.0, 'y': 0.0, 'z': 0.0}
    return json.loads(json.dumps({  # without parts that YAML would write as aliases
        'multi': {'header': header, 'joint_names': ['tool'], 'points': [{
            'transforms': [{'translation': place, 'rotation': upright}],
            'velocities': [{'linear': {'x': 0.1, 'y': 0.0, 'z': 0.0}, 'angular': still}],
            'accelerations': [], 'time_from_start': at,
        } for place, at in zip(places, times, strict=True)]},
        'path': {'header': header, 'poses': [{
            'header': {'stamp': at, 'frame_id': 'base'},
            'pose': {'position': place, 'orientation': upright},
        } for place, at in zip(places, times, strict=True)]},
        'joints': {'header': header, 'joint_names': ['turn', 'slide', 'spin'], 'points': [{
            'positions': [place['x'], 0.0, 0.0], 'velocities': [], 'accelerations': [],
            'effort': [], 'time_from_start': at,
        } for place, at in zip(places, times, strict=True)]}}))


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
