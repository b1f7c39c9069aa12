"""
The demonstration on the recordings in bags/: `python -m bellows_ros.demo`.

Identifies a cup, starts the node predictor with it, plays another recording to it over DDS at
recorded speed, and shows how well the predicted poses meet the measured ones.

`isolate`, for it and the tests, restricts ROS to this machine and an unused domain.
"""

from contextlib import suppress
import os
import socket

from bellows_ros.errors import BellowsError

# DDS on Linux: domains 1 to 101 keep clear of the ports that the system hands out by itself.
DOMAINS = 101
PORTS = (7400, 7410)  # of domain 0: multicast discovery, the first participant's unicast
PORTS_PER_DOMAIN = 250

# What else could let discovery reach other machines.
_DISCOVERY_VARIABLES = ('ROS_LOCALHOST_ONLY', 'ROS_STATIC_PEERS', 'ROS_DISCOVERY_SERVER')

# Held until this process ends, so that of two that look for a domain at once none takes the
# other's before ROS runs in it.
_reserved: list[socket.socket] = []


def isolate(log_folder: str) -> None:
    """Give this process and its children an unused ROS domain, on this machine only."""
    for name in _DISCOVERY_VARIABLES:
        os.environ.pop(name, None)
    os.environ['ROS_AUTOMATIC_DISCOVERY_RANGE'] = 'LOCALHOST'
    os.environ['ROS_DOMAIN_ID'] = str(unused_domain())
    os.environ['ROS_LOG_DIR'] = log_folder


def unused_domain() -> int:
    """
    Return a ROS domain that nothing on this machine uses, reserved for this process.

    The search starts at a domain of this process, so that runs started together differ.

    Raises
    ------
    BellowsError
        If there is none.

    """
    for offset in range(DOMAINS):
        domain = 1 + (os.getpid() + offset) % DOMAINS
        if all(_is_free(port + PORTS_PER_DOMAIN * domain) for port in PORTS) and _reserve(domain):
            return domain
    raise BellowsError(
        f'All ROS domains from 1 to {DOMAINS} are in use on this machine. End other ROS programs.')


def _is_free(port: int) -> bool:
    """Return whether a UDP port of this machine is free."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe, suppress(OSError):
        probe.bind(('', port))
        return True
    return False


def _reserve(domain: int) -> bool:
    """Reserve a domain among the processes of this machine; return whether it was free."""
    name = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
    try:
        name.bind(f'\0bellows_ros domain {domain}')  # abstract: it vanishes with the process
    except OSError:
        name.close()
        return False
    _reserved.append(name)
    return True
