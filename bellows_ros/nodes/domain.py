"""A ROS domain of this machine alone, for the demonstration and the tests; imports no ROS."""

from contextlib import suppress
import os
import socket

from bellows_ros.errors import BellowsError

DOMAINS = 101
"""Number of domains, from 1 on, whose ports Linux does not assign itself."""

FIRST_PORT, PORTS = 7400, 250
"""DDS ports of a domain: `FIRST_PORT` + `PORTS` times its number, and the next ones."""

_reserved: list[socket.socket] = []
"""Sockets open until this process ends: two simultaneous searches do not choose one domain."""


def isolate(log_folder: str) -> None:
    """Give this process and its children an unused ROS domain, on this machine only."""
    for name in ('ROS_LOCALHOST_ONLY', 'ROS_STATIC_PEERS', 'ROS_DISCOVERY_SERVER'):
        os.environ.pop(name, None)
    os.environ['ROS_AUTOMATIC_DISCOVERY_RANGE'] = 'LOCALHOST'
    os.environ['ROS_DOMAIN_ID'] = str(unused_domain())
    os.environ['ROS_LOG_DIR'] = log_folder


def unused_domain() -> int:
    """
    Return a ROS domain that nothing on this machine uses, reserved for this process.

    The search starts at a domain that depends on the process, so that runs started together
    differ.

    Raises
    ------
    BellowsError
        If there is none.

    """
    for offset in range(DOMAINS):
        domain = 1 + (os.getpid() + offset) % DOMAINS
        port, lock = FIRST_PORT + PORTS * domain, socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        with suppress(OSError), socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
            probe.bind(('', port + 10))  # of the first participant
            lock.bind(('', port + PORTS - 1))  # the last one, without DDS
            _reserved.append(lock)
            return domain
        lock.close()
    raise BellowsError(
        f'All ROS domains from 1 to {DOMAINS} are in use on this machine. End other ROS programs.')
