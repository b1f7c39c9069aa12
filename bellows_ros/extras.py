"""Messages for missing optional dependencies: the extras of setup.py."""

import importlib.util

from bellows_ros.errors import BellowsError

PACKAGES = {
    'ros': "'ros-jazzy-rclpy[fastrtps]' ros-jazzy-common-interfaces",
    'plot': 'matplotlib',
    'video': 'imageio-ffmpeg',
    'view': 'rerun-sdk',
    'parallel': 'joblib',
    'dask': 'distributed',
}


def install(extra: str) -> str:
    """Return the command that installs an extra."""
    return f'pip install {PACKAGES[extra]}'


def require_pictures() -> None:
    """Raise BellowsError where matplotlib is missing: before long work, not after it."""
    if importlib.util.find_spec('matplotlib') is None:
        raise BellowsError(
            f'matplotlib is not installed, but pictures need it: {install("plot")}')
