"""What the optional parts of this package need, as pip takes it: the extras of setup.py."""

PACKAGES = {
    'ros': "'ros-jazzy-rclpy[fastrtps]' ros-jazzy-common-interfaces",
    'plot': 'matplotlib',
    'video': 'imageio-ffmpeg',
    'view': 'rerun-sdk',
    'parallel': 'joblib',
    'dask': 'distributed',
}


def install(extra: str) -> str:
    """Return the command that installs what an extra needs."""
    return f'pip install {PACKAGES[extra]}'
