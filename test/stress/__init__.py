"""Damage, kills and full disks for as long as one likes: `python -m test.stress --minutes 5`."""
