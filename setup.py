"""Describe the package to colcon (ament_python) and to pip."""

from glob import glob
from pathlib import Path
from xml.etree import ElementTree

from setuptools import find_packages, setup

PACKAGE = 'bellows_ros'
HERE = Path(__file__).resolve().parent

EXTRAS = {
    # ROS 2 Jazzy as wheels, where no ROS is sourced (Linux x86-64, CPython 3.10 to 3.13).
    'ros': ['ros-jazzy-rclpy[fastrtps]', 'ros-jazzy-common-interfaces'],
    # Compiles the integration step; without it the same source is interpreted.
    'fast': ['numba>=0.59'],
    'plot': ['matplotlib>=3.8'],
    # The program ffmpeg, for animations as .mp4 where the system has none (170 MB).
    'docs': ['sphinx>=7.2', 'myst-parser>=3', 'furo>=2024.1'],
    # Many recordings on the machines of a cluster.
    'dask': ['distributed>=2024.1'],
    'test': [
        'pytest>=7.4,<9.2',  # with 9.2 pytest-xdist 3.8 keeps no group of tests together
        'pytest-timeout>=2.2',
        'pytest-xdist>=3.4',
        'hypothesis>=6.98',
        'build>=1.0',
        'colcon-core',
        'colcon-ros',
        'setuptools>=64,<80',  # colcon calls setup.py, which newer ones no longer support
        'wheel',
    ],
    # ruff for speed and repairs; flake8 with the plugins that ament_flake8 loads.
    'lint': [
        'ruff>=0.6',
        'check-jsonschema>=0.29',
        'mypy>=1.10',
        'scipy-stubs',
        'flake8>=7',
        'flake8-blind-except',
        'flake8-builtins',
        'flake8-class-newline',
        'flake8-comprehensions',
        'flake8-deprecated',
        'flake8-docstrings',
        'flake8-import-order',
        'flake8-quotes',
    ],
}
EXTRAS['dev'] = sorted({need for needs in EXTRAS.values() for need in needs})

setup(
    name=PACKAGE,
    version=ElementTree.parse(HERE / 'package.xml').getroot().findtext('version'),
    description='Predict and identify the motion of a package held by a bellows suction cup.',
    long_description=(HERE / 'README.md').read_text(encoding='utf-8'),
    long_description_content_type='text/markdown',
    license='Apache-2.0',
    license_files=['LICENSE'],
    maintainer='bellows_ros maintainers',
    maintainer_email='maintainers@bellows-ros.example',
    keywords=['ROS 2', 'suction cup', 'rigid body', 'system identification'],
    classifiers=[
        'Development Status :: 5 - Production/Stable',
        'Intended Audience :: Developers',
        'Intended Audience :: Science/Research',
        'Operating System :: POSIX :: Linux',
        'Programming Language :: Python :: 3',
        'Programming Language :: Python :: 3.11',
        'Programming Language :: Python :: 3.12',
        'Topic :: Scientific/Engineering',
        'Topic :: Scientific/Engineering :: Physics',
        'Typing :: Typed',
    ],
    packages=find_packages(include=[PACKAGE, f'{PACKAGE}.*']),
    package_data={PACKAGE: [
        'py.typed', '**/*.toml', '**/*.pyi']},
    python_requires='>=3.11',
    # rosbags 0.11.7 is the first that brings lz4 and zstd; clib has the parser in C.
    install_requires=[
        'numpy>=1.26', 'scipy>=1.11', 'rosbags>=0.11.7', 'ruamel.yaml>=0.17.21',
        'ruamel.yaml.clib>=0.2.8', 'click>=8.1', 'rich>=13.7'],
    extras_require=EXTRAS,
    data_files=[
        ('share/ament_index/resource_index/packages', [f'resource/{PACKAGE}']),
        (f'share/{PACKAGE}', ['package.xml']),
        (f'share/{PACKAGE}/launch', sorted(glob('launch/*.launch.py'))),
        (f'share/{PACKAGE}/security', ['security/policies.xml']),
        (f'share/{PACKAGE}/config', sorted(
            glob('config/*.yaml') + glob('config/*.rviz') + glob('config/*.json')
            + glob('config/*.xml'))),
    ],
    entry_points={
        'console_scripts': [
            f'predictor = {PACKAGE}.nodes.command:predictor',
            f'identifier = {PACKAGE}.nodes.command:identifier',
            f'bellows = {PACKAGE}.cli:main',
        ],
    },
    zip_safe=False,
)
