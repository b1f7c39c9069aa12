"""
The demonstration on the recordings in bags/: `python -m bellows_ros.demo`.

Identifies a cup, starts the node predictor with it, plays another recording to it over DDS at
recorded speed, and reports the errors of the predicted poses.

`isolate`, for the demonstration and the tests, restricts ROS to this machine and an unused domain.
"""

import os
import socket
from typing import Any

from bellows_ros.errors import BellowsError

# DDS on Linux: domains 1 to 101 avoid the ports that the system assigns itself.
DOMAINS = 101

# Sockets open until this process ends: two simultaneous searches do not choose one domain before
# ROS occupies it.
_reserved: list[socket.socket] = []


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
        # ports of multicast discovery, and of the first participant's unicast
        probes = [_bound(socket.AF_INET, ('', port + 250 * domain)) for port in (7400, 7410)]
        for probe in filter(None, probes):
            probe.close()
        # abstract: it vanishes with the process
        name = _bound(socket.AF_UNIX, f'\0bellows_ros domain {domain}') if all(probes) else None
        if name:
            _reserved.append(name)
            return domain
    raise BellowsError(
        f'All ROS domains from 1 to {DOMAINS} are in use on this machine. End other ROS programs.')


def _bound(family: socket.AddressFamily, address: Any) -> socket.socket | None:
    """Return a socket at an address of this machine, None if the address is in use."""
    bound = socket.socket(family, socket.SOCK_DGRAM)
    try:
        bound.bind(address)
    except OSError:
        bound.close()
        return None
    return bound
