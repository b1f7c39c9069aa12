"""Imports point one way: nodes and commands, workflows, files, core; ROS only in the nodes."""

import ast
from functools import cache
import re
import sys

FINDINGS = 'findings'
"""Module of `report` below `workflows`, which makes sentences of their findings."""

# What each room may import of this package beside itself and what all may use.
ALLOWED = {
    '': {'library'},
    'errors': set(),
    'exits': {'core', 'report'},
    FINDINGS: {'core'},
    'version': set(),
    'library': {'core', 'files', 'workflows', 'plots'},
    'core': set(),
    'files': {'core'},
    'workflows': {'core', 'files', FINDINGS},
    'nodes': {'core', 'files', 'workflows', 'report', FINDINGS},
    'plots': {'core', 'files', 'workflows', FINDINGS},
    'report': {'core', 'files', 'workflows', 'plots', FINDINGS},
    'cli': {'core', 'exits', 'files', 'workflows', 'plots', 'report', 'nodes', FINDINGS},
    'demo': {'core', 'exits', 'files', 'workflows', 'nodes', 'plots', 'report', FINDINGS},
}
FOR_ALL = {'errors', 'version'}
ROS = ('rclpy', 'rcl_interfaces', 'ament_index_python', 'builtin_interfaces', 'launch',
       'message_filters', 'rosbag2_py', 'std_srvs', 'tf2_')
ONCE = {
    ('correction.py', 'is_possible'), ('correction.py', 'one_of'), ('wrenches.py', 'is_possible')}
"""Short kernels that Python calls at most once per measured pose or block of wrenches."""
CORE_NEEDS = {'numpy', 'scipy', 'numba', 'bellows_ros'}


CORE = (
    'findings', 'geometry', 'signals', 'model', 'sensors', 'parameters', 'recording', 'observer',
    'planning', 'toss', 'synthetic', 'identification', 'live')
"""The rooms of core, each above those that it may import."""


def is_ros(module):
    """Tell whether a module comes with ROS."""
    top = module.partition('.')[0]
    return top.startswith(ROS) or top.endswith('_msgs')


def modules(root, room='*'):
    """Return the package's source files, all or those of one room."""
    inside = sorted((root / 'bellows_ros').rglob('*.py'))
    return [file for file in inside if room in ('*', room_of(file, root))]


def name_of(file, root):
    """Return the name by which a source file is imported."""
    return '.'.join(file.relative_to(root).with_suffix('').parts).removesuffix('.__init__')


def room_of(file, root):
    """Return the room a source file stands in: 'core', 'errors', or '' for the package itself."""
    return room_named(name_of(file, root))


def room_named(name):
    """Return the room in which an imported name of the package stands."""
    inside = name.removeprefix('bellows_ros.')
    return FINDINGS if inside.startswith('report.findings') else '.'.join(name.split('.')[1:2])


@cache
def imports(file, root):
    """Return the absolute names of all that a file imports, at its top or inside functions."""
    return imports_in(ast.parse(file.read_text(), str(file)), file.relative_to(root).parent.parts)


def imports_in(tree, package):
    """Return the absolute names of all that a part of a module of a package imports."""
    found = []
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            found += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            base = package[:len(package) + 1 - node.level] if node.level else ()
            module = '.'.join([*base, *filter(None, [node.module])])
            found += [f'{module}.{alias.name}' for alias in node.names]
    return found


def imported(root, room='*'):
    """Yield the files of a room, or of all, with each name that they import."""
    for file in modules(root, room):
        for name in imports(file, root):
            yield file, name


def test_rooms_import_only_what_lies_below_them(root):
    """Find no import that points upward or sideways."""
    wrong = []
    for file, name in imported(root):
        room, path = room_of(file, root), str(file.relative_to(root))
        target = room_named(name) if name.startswith('bellows_ros.') else room
        if target in ALLOWED and target not in ALLOWED[room] | {room} | FOR_ALL:
            wrong.append((path, name))
    assert wrong == []


def test_only_nodes_and_the_demo_import_ros(root):
    """Keep ROS behind one door."""
    assert {room_of(file, root) for file, name in imported(root) if is_ros(name)} == {
        'nodes', 'demo'}


def test_nothing_private_of_other_packages_is_imported(root):
    """Find no name with an underscore, in a package, a module, or behind an imported module."""
    wrong = []
    for file, name in imported(root):
        if not name.startswith('bellows_ros') and re.search(r'(^|\.)_(?!_future__)', name):
            wrong.append((str(file.relative_to(root)), name))
    assert wrong == []


def test_core_needs_only_numbers(root):
    """Use numpy, scipy, numba and the standard library, and of that no logging."""
    allowed = CORE_NEEDS | set(sys.stdlib_module_names) - {'logging'}
    assert {name.partition('.')[0] for _, name in imported(root, 'core')} <= allowed


def graph_of(root, room='*'):
    """Return the modules of a room, or all, that each of them imports, for types alone too."""
    files = {name_of(file, root): file for file in modules(root, room)}
    return {
        name: {target if target in files else target.rpartition('.')[0]
               for target in imports(file, root)} & set(files) - {name}
        for name, file in files.items()}


def floor(name):
    """Return the place of a module's room in the order of core, 0 for core itself."""
    return sum(CORE.index(room) + 1 for room in name.split('.')[2:3])


def test_modules_of_core_import_downwards(root):
    """Find no import of a room that stands above."""
    wrong = [
        f'{name} imports {target}' for name, targets in graph_of(root, 'core').items()
        for target in targets if floor(target) > floor(name)]
    assert wrong == []


def test_modules_import_in_no_circle(root):
    """Take away modules that import nothing that is left, until none is."""
    left = graph_of(root)
    while free := [name for name, targets in left.items() if not targets & set(left)]:
        for name in free:
            del left[name]
    assert left == {}


def decorated(function):
    """Return the names of the decorators of a function."""
    return {each.id for each in function.decorator_list if isinstance(each, ast.Name)}


def test_python_calls_no_kernel_with_a_loop(root):
    """Such a kernel is an entry, as Python would interpret it: twenty times slower."""
    functions = [function for file in modules(root) for function in
                 ast.parse(file.read_text()).body if isinstance(function, ast.FunctionDef)]
    loops = {function.name for function in functions if 'kernel' in decorated(function) and any(
        isinstance(node, ast.For | ast.While) for node in ast.walk(function))}
    called = set()
    for file in modules(root):
        tree = ast.parse(file.read_text())
        known = {alias.asname or alias.name for node in tree.body
                 if isinstance(node, ast.ImportFrom) for alias in node.names}
        for top in tree.body:
            if not (isinstance(top, ast.FunctionDef) and decorated(top) & {'kernel', 'entry'}):
                called |= {
                    (file.name, name) for node in ast.walk(top) if isinstance(node, ast.Call)
                    for path, _, name in [ast.unparse(node.func).rpartition('.')]
                    if not path or path in known}
    assert loops and {each for each in called if each[1] in loops} <= ONCE
