"""Messages for missing optional dependencies: the extras of setup.py."""

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
