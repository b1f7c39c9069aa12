"""
Compilation of kernels by numba; no other module imports numba.

A kernel is scalar code on tuples of floats. With numba a kernel is compiled, and its machine code
is kept on disk; without numba Python interprets the kernel's source.
"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
import ctypes
from functools import cache, partial
import gc
import hashlib
import importlib
import mmap
import os
from pathlib import Path
import pickle
import re
import subprocess
import sys
from types import CodeType, ModuleType
from typing import Any, TypeVar, TypeVarTuple
import warnings

numba: Any
try:
    import numba
except ImportError:
    numba = None

COMPILED: bool = numba is not None and not numba.config.DISABLE_JIT
"""Whether kernels are compiled."""


def announce() -> None:
    """Do nothing; a command replaces this function by a message that a kernel is compiled."""


OPTIONS = {'error_model': 'numpy', 'nogil': True, 'forceinline': True}
"""
Options of the compilation: kernels are inlined into their callers.

By default the compiler calls the larger kernels, with all 80 numbers of a model on the stack: 0.67
us for a step of the integrator instead of 0.41 us (C: 0.41 us). Compiling takes equally long.
"""

Arrays = TypeVarTuple('Arrays')
Function = TypeVar('Function', bound=Callable[..., Any])


def kernel(function: Function) -> Function:
    """
    Compile a scalar function on tuples, or return it unchanged without numba.

    Division by zero gives inf or nan in compiled code and raises in interpreted code, so a
    kernel guards its divisors itself.
    """
    return _wrapped(function, OPTIONS) if COMPILED else function


def array_kernel(function: Function) -> Function:
    """
    Compile a function on arrays, or return it unchanged without numba.

    The function is compiled once and called by name. By default numba copies a function into its
    callers, their callers and so on, and compiles every copy.
    """
    return _wrapped(function, {**OPTIONS, 'forceinline': False}) if COMPILED else function


def _wrapped(function: Function, options: dict[str, Any]) -> Function:
    """Return a decorator that compiles a kernel for Python and for other kernels."""
    compiled = _compiler(function, options)
    called = cache(lambda: _compiler(function, options, called=True))
    # Other kernels call this one without converting Python's numbers: a third less to compile.
    # One version serves all constants.
    compiled.get_call_template = lambda types, named: called().get_call_template(
        tuple(map(numba.types.unliteral, types)), named)
    compiled.get_overload = lambda arguments: (
        called().get_overload(arguments) if options['forceinline'] else
        _by_name(called(), arguments))
    compiled.called = called
    return compiled  # type: ignore[no-any-return]


NAMED: dict[str, tuple[str, str, Any]] = {}
"""By names in machine code: modules, names and types of arguments of kernels called by name."""


def _by_name(kernel: Any, arguments: Any) -> Any:
    """Return the code for types of arguments, of which callers get the name and not a copy."""
    code, context = kernel.overloads[tuple(arguments)], kernel.targetctx
    context.remove_user_function(code.entry_point)
    context.insert_user_function(code.entry_point, code.fndesc)
    NAMED[code.fndesc.mangled_name] = kernel.__module__, kernel.__qualname__, code.signature.args
    return code.entry_point


def load(symbol: str, module: str, name: str, arguments: Any) -> None:
    """Load or compile a kernel that loaded code calls by a symbol."""
    kernel = getattr(importlib.import_module(module), name).called()
    kernel.compile(arguments)
    _by_name(kernel, arguments)
    if symbol not in NAMED:  # the machine code would end the process
        raise ValueError(f'{name} has another symbol')


@contextmanager
def seldom_collected() -> Iterator[None]:
    """Run the garbage collector rarely: it takes a third of the time of compiling."""
    thresholds = gc.get_threshold()
    gc.set_threshold(10_000, 20, 20)
    try:
        yield
    finally:
        gc.set_threshold(*thresholds)


def _compiler(function: Callable[..., Any], options: dict[str, Any], called: bool = False) -> Any:
    """Return a decorator that compiles a kernel for Python, or for other kernels alone."""
    class Named(numba.core.compiler.Compiler):  # type: ignore[misc]

        def _compile_bytecode(self) -> Any:
            """Compile under a name that every process gives to the same code."""
            self.state.func_id.unique_id = _source_digest(function).hex()
            if called and options['forceinline']:
                self.state.library = _for_callers(
                    self.state.targetctx.codegen(), function.__qualname__)
            with seldom_collected():
                return super()._compile_bytecode()

    options = {**options, 'no_cfunc_wrapper': True, 'no_cpython_wrapper': called}
    try:
        compiled = numba.njit(cache=True, pipeline_class=Named, **options)(function)
        compiled._cache = _TolerantCache(compiled._cache, function, '.called' if called else '')
    except RuntimeError:  # neither the package's folder nor the user's cache can be written
        compiled = numba.njit(pipeline_class=Named, **options)(function)
    return compiled


def _for_callers(codegen: Any, name: str) -> Any:
    """Return a library for an inlined kernel, whose machine code is made in its callers alone."""
    library = codegen.create_library(name)

    def finalize() -> None:
        shared, empty = library._final_module, codegen._create_empty_module(name)
        for each in shared.functions:
            if not each.is_declaration and each.linkage.name == 'external':
                each.linkage = 'linkonce_odr'
        own = [str(each) for each in shared.global_variables if 'NumbaEnv' in each.name]
        library._shared_module = shared
        library._final_module = numba.core.codegen.ll.parse_assembly('\n'.join([str(empty), *own]))
        type(library)._finalize_final_module(library)

    library.enable_object_caching()
    library._finalize_final_module = finalize
    return library


ASIDE = """
import ctypes, os, pickle, sys
ctypes.CDLL(None).prctl(1, 15)
os.nice(5)
function, arguments = pickle.load(sys.stdin.buffer)
function(*arguments)
"""
"""Program that runs a function at low priority; on Linux it ends with the thread that started
it."""


def compile_aside(function: Callable[..., object], *arguments: object) -> subprocess.Popen[bytes]:
    """
    Start a process that calls a function of a module, so that its machine code is stored on disk.

    A compiler in a thread would hold the interpreter for seconds. If the process fails, the
    kernels are compiled at their first call.
    """
    process = subprocess.Popen(
        [sys.executable, '-P', '-c', ASIDE], stdin=subprocess.PIPE, stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL, env={**os.environ, 'PYTHONPATH': os.pathsep.join(sys.path)})
    assert process.stdin
    with suppress(BrokenPipeError), process.stdin as stdin:
        stdin.write(pickle.dumps((function, arguments)))
    return process


def release_compiler() -> None:
    """
    Return the memory of the compiler's own code, some 35 MiB, to the system.

    After the last compilation the process does not use these memory pages. The system reads them
    again from the library's file if the compiler is called once more. On other systems than Linux
    the function does nothing.
    """
    maps = Path('/proc/self/maps')
    for line in maps.read_text().splitlines() if maps.exists() else ():
        if 'libllvmlite' in line and 'r-xp' in line:
            start, end = (int(address, 16) for address in line.split()[0].split('-'))
            ctypes.CDLL(None).madvise(
                ctypes.c_void_p(start), ctypes.c_size_t(end - start), mmap.MADV_DONTNEED)


def usable_cores() -> int:
    """Return the number of cores that CPU affinity and the limit of a container allow."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, 'sched_getaffinity') else (
        os.cpu_count() or 1)
    limit = Path('/sys/fs/cgroup/cpu.max')
    with suppress(OSError, ValueError):  # no container, or no limit
        quota, period = map(int, limit.read_text().split())
        cores = min(cores, -(-quota // period))
    return max(cores, 1)


def as_inputs(*arrays: *Arrays) -> tuple[*Arrays]:
    """Return arrays for kernels: plain Python reads lists several times faster than arrays."""
    lists: Any = (array.tolist() for array in arrays)  # type: ignore[attr-defined]
    return arrays if COMPILED else tuple(lists)


@cache
def _source_digest(function: Callable[..., Any]) -> bytes:
    """
    Return a digest of a kernel's code, constants, and the kernels it calls.

    numba watches only the file of the kernel itself, but the machine code also contains kernels of
    other files: without the digest stale machine code would be loaded. Docstrings do not matter.
    """
    digest = hashlib.sha256(repr(OPTIONS).encode() + load.__code__.co_code)
    codes = [function.__code__]
    for code in codes:
        codes += [inner for inner in code.co_consts if isinstance(inner, CodeType)]
        plain = [value for value in code.co_consts
                 if not isinstance(value, CodeType) and value != function.__doc__]
        digest.update(code.co_code + repr((plain, code.co_names, code.co_varnames)).encode())
        scopes = [function.__globals__]
        scopes += [vars(module) for name in code.co_names
                   if isinstance(module := function.__globals__.get(name), ModuleType)]
        for name in code.co_names:
            for value in (scope[name] for scope in scopes if name in scope):
                if hasattr(value, 'py_func'):
                    digest.update(_source_digest(value.py_func))
                elif isinstance(value, int | float | str | tuple):
                    digest.update(repr(value).encode())
    return digest.digest()


@cache
def _bind_runtime() -> None:
    """
    Link loaded machine code to the functions of numba's runtime.

    By default numba prepares its compiler first: 0.8 s and 40 MiB at the start of a process
    without anything to compile.
    """
    from llvmlite.binding import add_symbol
    from numba.core.runtime._nrt_python import c_helpers

    for name, address in c_helpers.items():
        add_symbol(name if name.startswith('_') else f'NRT_{name}', address)


class _TolerantCache:
    """
    A kernel cache that is bypassed if it fails.

    numba's own cache fails on an index or a file that is damaged or cannot be read or written, for
    example on a full disk. If two processes store code for different arguments simultaneously,
    one's file can get the other's name.

    Parameters
    ----------
    cache : numba.core.caching.FunctionCache
    function : callable
        The source of the kernel.
    kind : str
        Ending of the file names: a kernel is compiled for Python and for other kernels.

    """

    def __init__(self, cache: Any, function: Callable[..., Any], kind: str) -> None:
        self._cache, self._function = cache, function
        files = cache._cache_file
        name = re.sub(r'-\d+\.', '.', cache._impl.filename_base)  # the digest knows changed lines
        cache._cache_file = type(files)(cache.cache_path, name + kind, files._source_stamp)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._cache, name)

    def load_overload(self, signature: Any, context: Any) -> Any:
        """Return the compiled code for these arguments, or None to compile it now."""
        try:  # only now, as kernels that this one calls may stand below it
            self._cache._cache_file._source_stamp = _source_digest(self._function)
            _bind_runtime()
            code = self._cache._load_overload(signature, context)
            if code is None:
                announce()
            if code is None or tuple(code.signature.args) == tuple(signature):
                return code
            raise ValueError('the code is for other arguments')
        except Exception as error:  # noqa: BLE001 (a damaged pickle can raise anything)
            self._warn(error)
            with suppress(OSError):
                self._cache.flush()  # so that new code can be saved
                return None
            self._cache.disable()
            return None

    def save_overload(self, signature: Any, code: Any) -> None:
        """Save compiled code, with the names that it calls, if possible."""
        functions = code.library._get_module_for_linking().functions
        called = [partial(load, each.name, *NAMED[each.name]) for each in functions
                  if each.is_declaration and each.name in NAMED]
        try:
            self._cache.save_overload(signature, code._replace(reload_init=called))
        except Exception as error:  # noqa: BLE001 (what is compiled works all the same)
            self._warn(error)
            self._cache.disable()

    def _warn(self, error: Exception) -> None:
        warnings.warn(
            f'Compiled code in {self._cache.cache_path} cannot be used ({type(error).__name__}): '
            'compiling again. If this message appears at every start, remove that folder.',
            RuntimeWarning, stacklevel=2)
