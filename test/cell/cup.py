"""Cups and packages of the cell: of the thesis, of the derivations, and random ones."""

from bellows_ros.core.geometry import lie
from bellows_ros.core.geometry.lie import exp_so3, nearest_rotation, transform
from bellows_ros.core.model.cup_package import Cup, Package
from bellows_ros.core.model.simulation import state_row
from bellows_ros.core.parameters.values import Values
import numpy as np

from .motion import Move

GRAVITY = 9.81
GRAVITY_VECTOR = np.array([0.0, 0.0, -GRAVITY])
THESIS = Cup.thesis()

K_THESIS = np.array([  # (3.45)
    [200, 10, 30, 3.2, 2, 1.3],
    [10, 180, 20, 0.7, 4.3, 2.5],
    [30, 20, 1.55e3, 1, 0.9, 3.5],
    [3.2, 0.7, 1, 2, 0.8, 1],
    [2, 4.3, 0.9, 0.8, 3, 0.5],
    [1.3, 2.5, 3.5, 1, 0.5, 4],
])


PLATE = Package(2.17, np.diag([0.0087, 0.0087, 0.0173]), (0.0, 0.0, -0.03))


T_WORLD_PACKAGE = np.array([  # (3.48)
    [0.5956, -0.1185, 0.7945, -0.2004],
    [-0.1408, 0.9584, 0.2485, 0.2661],
    [-0.7909, -0.2598, 0.5541, 0.0301],
    [0, 0, 0, 1],
])


T_WORLD_TOOL = np.array([  # (3.49)
    [0.9865, -0.1459, 0.0743, -0.2000],
    [0.1307, 0.9751, 0.1789, 0.3000],
    [-0.0986, -0.1668, 0.9811, 0.1800],
    [0, 0, 0, 1],
])


def orthonormal(T):
    """Return a pose printed with four digits, with its rotation orthonormalised."""
    return transform(nearest_rotation(T[:3, :3]), T[:3, 3])


def state_of(o, R, twist=(0.0,) * 6):
    """Return a state as the kernels take it."""
    return state_row(o, lie.rotation_to_quaternion(R), twist)


def random_pose(rng, angle=1.0, distance=0.1):
    """Return a pose turned and moved by about the given sizes."""
    R = exp_so3(angle * rng.standard_normal(3))
    return transform(R, distance * rng.standard_normal(3))


def random_cup(rng, damping=True):
    """Return a cup with full K and P, both positive definite, in the range of real ones."""
    scale = np.array([80.0, 80.0, 110.0, 2.0, 2.0, 1.2])
    damper = np.array([8.0, 8.0, 5.0, 0.25, 0.25, 0.3])

    def matrix(diagonal):
        A = np.eye(6) + 0.2 * rng.standard_normal((6, 6))
        return diagonal[:, None] * (A @ A.T) * diagonal

    return Cup(matrix(scale), matrix(damper) if damping else np.zeros((6, 6)), 0.05)


def random_package(rng):
    """Return a package with products of inertia and its centre of mass off the cup's axis."""
    R = exp_so3(rng.standard_normal(3))
    return Package(1.7, R @ np.diag([0.008, 0.011, 0.013]) @ R.T, (0.01, -0.02, -0.05))


CUP = Cup(
    np.diag([5400, 5400, 9200, 4.2, 4.2, 1.35]), np.diag([55, 55, 24, 0.06, 0.06, 0.1]), 0.046)


PACKAGE = Package(1.8, np.diag([0.00438, 0.00654, 0.00984]), (0.0, 0.0, -0.03))


GRIP = (60e3 * np.pi * 0.02 ** 2, 0.02, 0.5)


VALUES = Values({
    'cup.stiffness': CUP.stiffness.ravel().tolist(), 'cup.damping': CUP.damping.ravel().tolist(),
    'cup.length': CUP.length, 'package.mass': 1.8, 'package.com': [0.0, 0.0, -0.03],
    'package.inertia': [0.00438, 0.00654, 0.00984, 0.0, 0.0, 0.0],
})
"""Cup and package as parameters."""


def random_case(rng):
    """Return a move, a package and a grip that may or may not hold it."""
    way = rng.normal(0.0, 0.35, 3) * [1, 1, 0.5]
    turn = rng.normal(0.0, 0.3, 3)
    move = Move(way, turn, rng.uniform(0.35, 0.9))
    mass, half = rng.uniform(0.6, 2.2), rng.uniform(0.03, 0.1, 3)
    squares = half ** 2
    inertia = np.diag(mass / 3 * (squares.sum() - squares))
    com = (rng.normal(0, 0.004), rng.normal(0, 0.004), -half[2])
    radius = rng.uniform(0.018, 0.03)
    return move, Package(mass, inertia, com), (rng.uniform(4e4, 7e4) * np.pi * radius**2, radius,
                                               rng.uniform(0.3, 0.7))
