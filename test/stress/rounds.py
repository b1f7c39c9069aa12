"""All rounds, by name; a new one is a generator (`frame`) and a line here."""

from importlib.util import find_spec

from .frame import Round
from .readers import bags, metadata, motions, parameters, plans, recordings, tables
from .results import fits
from .writers import disks, kills

ROUNDS = {
    'bags': Round(bags),
    'metadata': Round(metadata, short=60),
    'recordings': Round(recordings, short=20),
    'tables': Round(tables),
    'parameters': Round(parameters, short=20),
    'motions': Round(motions, patience=60.0, short=3),
    'plans': Round(plans, patience=60.0, short=20),
    'kills': Round(kills, patience=120.0, short=0),  # test/files/test_killed.py does it
    'disks': Round(disks, short=20),
    'fits': Round(fits, patience=120.0, short=10),
}
if find_spec('rclpy'):
    from .messages import messages
    from .requests import requests

    ROUNDS['messages'] = Round(messages, patience=60.0, short=5)
    ROUNDS['requests'] = Round(requests, patience=300.0, short=2)
