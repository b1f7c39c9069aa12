"""
Build the messages of a package from their definitions, with the generators of ROS.

The wheels of ROS bring rosidl, headers and libraries, but no tf2_msgs and no apriltag_msgs.
"""

import os
from pathlib import Path
import shutil
import subprocess
import sys
import sysconfig
from unittest import mock

import numpy as np

TF = {'tf2_msgs/msg/TFMessage.msg': 'geometry_msgs/TransformStamped[] transforms'}
PREFIX = Path(sys.prefix)
PYTHON_HEADERS = Path(sysconfig.get_paths()['include'])

# What a package of messages has a library of, in the order in which they need each other.
KINDS = ('generator_c', 'typesupport_fastrtps_c', 'typesupport_introspection_c', 'typesupport_c')
USED = ('geometry_msgs', 'std_msgs', 'service_msgs', 'builtin_interfaces')
RUNTIME = ('rosidl_runtime_c', 'rcutils', 'fastcdr', 'rosidl_typesupport_c',
           'rosidl_typesupport_fastrtps_c', 'rosidl_typesupport_fastrtps_cpp',
           'rosidl_typesupport_introspection_c')

# ROS opens the libraries by their bare names: those that are loaded already are found so.
LOAD = """
import ctypes
import pathlib

for library in {libraries}:
    ctypes.CDLL(str(pathlib.Path(__file__).with_name(library)))
"""


def missing():
    """Return the first missing prerequisite of the build, or ''."""
    if not (shutil.which('gcc') and shutil.which('g++')):
        return 'no compiler'
    headers = (PREFIX / 'include' / 'geometry_msgs', PYTHON_HEADERS / 'Python.h')
    return ', '.join(f'no {path}' for path in headers if not path.exists())


def build(folder, types=TF):
    """Return a folder below the given one, from which Python imports a package of some types."""
    package, files = next(iter(types)).partition('/')[0], []
    for name, text in types.items():
        file = folder / name
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(f'{text}\n')
        files.append(f'{folder / package}:{file.relative_to(folder / package)}')
    sources = folder / 'sources'
    with mock.patch.dict(os.environ, AMENT_PREFIX_PATH=str(PREFIX)):
        _generate(package, files, sources)
    module, objects = sources / 'py' / package, _compile(sources)
    libraries = [f'lib{package}__rosidl_{kind}.so' for kind in KINDS]
    for k, kind in enumerate(KINDS):
        _link(module / libraries[k], objects[kind], libraries[:k])
    _link(module / f'{package}_s__rosidl_typesupport_c.so', objects['py'], libraries)
    (module / '__init__.py').write_text(LOAD.format(libraries=libraries))
    return module.parent


def _generate(package, definitions, into):
    """Write C and Python as for any other package of messages, each kind into its folder."""
    from rosidl_generator_c.cli import GenerateC
    from rosidl_generator_py.cli import GeneratePython
    from rosidl_typesupport_c.cli import GenerateCTypesupport
    from rosidl_typesupport_fastrtps_c.cli import GenerateFastRTPSCTypesupport
    from rosidl_typesupport_introspection_c.cli import GenerateIntrospectionCTypesupport

    both = [f'rosidl_{kind}' for kind in KINDS[1:3]]
    for kind, generator in (
        ('generator_c', GenerateC('c')),
        ('typesupport_fastrtps_c', GenerateFastRTPSCTypesupport('fast')),
        ('typesupport_introspection_c', GenerateIntrospectionCTypesupport('introspection')),
        ('typesupport_c', GenerateCTypesupport('c', typesupport_implementations=both)),
        ('py', GeneratePython('py', typesupport_implementations=['rosidl_typesupport_c'])),
    ):
        generator.generate(
            package, definitions, [str(PREFIX / 'share')], into / kind / package)


def _compile(sources):
    """Return the object files of each kind."""
    include = PREFIX / 'include'
    headers = [*sources.iterdir(), include, *include.iterdir(), PYTHON_HEADERS, np.get_include()]
    options = ['-c', '-w', '-O0', '-fPIC', *(f'-I{folder}' for folder in headers)]
    objects: dict[str, list[str]] = {}
    running = []
    for file in sorted({*sources.rglob('*.c'), *sources.rglob('*.cpp')}):
        made = objects.setdefault(file.relative_to(sources).parts[0], [])
        made.append(f'{file}.o')
        compiler = 'g++' if file.suffix == '.cpp' else 'gcc'
        running.append(subprocess.Popen([compiler, *options, str(file), '-o', made[-1]]))
    assert [process.wait(600) for process in running] == [0] * len(running)
    return objects


def _link(target, objects, needed):
    """Link object files to a library that finds other libraries in its own folder."""
    kinds = (*KINDS, 'generator_py')
    used = [f'{package}__rosidl_{kind}' for package in USED for kind in kinds]
    folders = (PREFIX / 'lib', target.parent)
    subprocess.run(
        ['g++', '-shared', f'-Wl,-soname,{target.name}', '-o', str(target), *objects,
         *(f'-L{folder}' for folder in folders), *(f'-Wl,-rpath,{f}' for f in folders),
         *(f'-l:{name}' for name in needed), *(f'-l{name}' for name in (*RUNTIME, *used)),
         '-Wl,--allow-shlib-undefined'],
        check=True, timeout=120)
