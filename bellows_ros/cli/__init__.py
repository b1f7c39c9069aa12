# PYTHON_ARGCOMPLETE_OK
"""
The command `bellows`: the package from a shell, without ROS.

One module per command, loaded only when it is asked for; see `app`.
"""

from .app import main

__all__ = ['main']
