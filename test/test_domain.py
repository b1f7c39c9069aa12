"""A ROS domain that nobody else on this machine has, even when several look for one at once."""

import os
import subprocess
import sys

from bellows_ros.nodes import domain

SEEKER = """
import sys
from bellows_ros.nodes.domain import unused_domain
print(unused_domain(), flush=True)
sys.stdin.read()
"""


def test_seekers_at_the_same_time_find_different_domains():
    """Give each process one of its own before ROS runs in any."""
    seekers = [
        subprocess.Popen([sys.executable, '-c', SEEKER], stdin=subprocess.PIPE,
                         stdout=subprocess.PIPE, text=True)
        for _ in range(8)]
    found = [int(seeker.stdout.readline()) for seeker in seekers if seeker.stdout]
    for seeker in seekers:
        seeker.communicate()
    assert len(set(found)) == 8
    assert all(1 <= number <= domain.DOMAINS for number in found)


def test_what_reaches_other_machines_is_dropped(monkeypatch):
    """Keep discovery here, whatever the shell says."""
    for name in ('ROS_DOMAIN_ID', 'ROS_LOG_DIR', 'ROS_AUTOMATIC_DISCOVERY_RANGE'):
        monkeypatch.setenv(name, os.environ[name])  # put back afterwards
    monkeypatch.setenv('ROS_STATIC_PEERS', '192.0.2.1')
    domain.isolate('logs')
    assert 'ROS_STATIC_PEERS' not in os.environ
    assert os.environ['ROS_AUTOMATIC_DISCOVERY_RANGE'] == 'LOCALHOST'
    assert os.environ['ROS_LOG_DIR'] == 'logs'
