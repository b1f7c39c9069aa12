"""Plans as `ros2 topic echo` prints them."""

import json


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
    """Return a plan of each message type, with 0.1 s per point."""
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
