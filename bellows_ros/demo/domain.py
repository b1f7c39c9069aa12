"""Keep a demonstration's ROS on this machine and to itself."""

from collections.abc import Mapping
import os
import socket

from bellows_ros.errors import BellowsError

# DDS on Linux: domains 1 to 101 keep clear of the ports that the system hands out by itself.
DOMAINS = 101
PORTS = (7400, 7410)  # of domain 0: multicast discovery, the first participant's unicast
PORTS_PER_DOMAIN = 250

# What else could let discovery reach other machines.
_REACHING_OUT = ('ROS_LOCALHOST_ONLY', 'ROS_STATIC_PEERS', 'ROS_DISCOVERY_SERVER')


def isolated(environment: Mapping[str, str], log_folder: str) -> dict[str, str]:
    """Return the environment with a ROS domain nobody here uses, and kept to this machine."""
    kept = {name: value for name, value in environment.items() if name not in _REACHING_OUT}
    return {
        **kept,
        'ROS_AUTOMATIC_DISCOVERY_RANGE': 'LOCALHOST',
        'ROS_DOMAIN_ID': str(unused_domain()),
        'ROS_LOG_DIR': log_folder,
    }


def unused_domain() -> int:
    """
    Return a ROS domain in which nothing on this machine takes part.

    The search starts at a domain of this process, so that runs started together differ.

    Raises
    ------
    BellowsError
        If there is none.

    """
    for offset in range(DOMAINS):
        domain = 1 + (os.getpid() + offset) % DOMAINS
        if all(_is_free(port + PORTS_PER_DOMAIN * domain) for port in PORTS):
            return domain
    raise BellowsError(
        f'All ROS domains from 1 to {DOMAINS} are in use on this machine. End other ROS programs.'
    )


def _is_free(port: int) -> bool:
    """Tell whether no socket of this machine has the UDP port."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.bind(('', port))
        except OSError:
            return False
    return True
