"""Arms of the tests as URDF: a UR5e by its maker's figures, and one of seven joints."""

import math

UR5E_DH = (
    # a (m), d (m), alpha (rad): the kinematic parameters that Universal Robots publishes.
    (0.0, 0.1625, 1.5707963267948966), (-0.425, 0.0, 0.0), (-0.3922, 0.0, 0.0),
    (0.0, 0.1333, 1.5707963267948966), (0.0, 0.0997, -1.5707963267948966), (0.0, 0.0996, 0.0),
)
UR5E_NAMES = ('shoulder_pan', 'shoulder_lift', 'elbow', 'wrist_1', 'wrist_2', 'wrist_3')
PANDA_DH = (
    # a, d, alpha in the modified convention, as published for the Franka Emika arm.
    (0.0, 0.333, 0.0), (0.0, 0.0, -1.5707963267948966), (0.0, 0.316, 1.5707963267948966),
    (0.0825, 0.0, 1.5707963267948966), (-0.0825, 0.384, -1.5707963267948966),
    (0.0, 0.0, 1.5707963267948966), (0.088, 0.0, 1.5707963267948966),
)


def urdf_of(rows, names, modified, speed=3.14, reach=6.28):
    """Return the URDF of an arm from its Denavit-Hartenberg rows, with z of the tool inwards."""
    links = ''.join(f'<link name="l{i}"/>' for i in range(len(rows) + 1))
    joints, before = '', (0.0, 0.0, 0.0)
    for i, (row, name) in enumerate(zip(rows, names, strict=True)):
        if modified:
            a, d, alpha = row
            origin = (f'xyz="{a} {-d * math.sin(alpha)} '
                      f'{d * math.cos(alpha)}" rpy="{alpha} 0 0"')
        else:
            a, d, alpha = before
            origin = f'xyz="{a} 0 {d}" rpy="{alpha} 0 0"'
        before = row
        joints += (
            f'<joint name="{name}" type="revolute"><parent link="l{i}"/><child link="l{i + 1}"/>'
            f'<origin {origin}/><axis xyz="0 0 1"/>'
            f'<limit lower="{-reach}" upper="{reach}" velocity="{speed}" effort="100"/></joint>')
    a, d, alpha = (0.0, 0.107, 0.0) if modified else before
    joints += (
        f'<joint name="flange" type="fixed"><parent link="l{len(rows)}"/><child link="tool"/>'
        f'<origin xyz="{a} 0 {d}" rpy="3.141592653589793 0 0"/></joint>')
    return f'<robot name="arm">{links}<link name="tool"/>{joints}</robot>'


UR5E = urdf_of(UR5E_DH, UR5E_NAMES, modified=False)
SEVEN = urdf_of(PANDA_DH, [f'joint{i}' for i in range(1, 8)], modified=True, speed=2.175)
UR5E_START = (0.3, -1.4, 1.7, -1.9, -1.5, 0.2)
SEVEN_START = (0.2, -0.5, 0.1, -2.1, 0.1, 1.7, 0.6)
