"""
A process that has loaded all that `bellows` needs, and forks one for each command.

Each command still has a process of its own, which begins where its imports are done: starting an
interpreter and loading takes longer than most commands of the tests.
"""

import gc
import importlib
import json
import os
from pathlib import Path
import pkgutil
import signal
import subprocess
import sys
import tempfile
import traceback

from ..kernels import compile_most

PACKAGES = ('cli', 'files', 'workflows', 'plots', 'report')
USEFUL = ('matplotlib.backends.backend_agg', 'matplotlib.backends.backend_svg', 'rosbags')
ROOT = Path(__file__).resolve().parents[2]


class Server:
    """
    Starts the process when it is first needed, and again where it was ended.

    Parameters
    ----------
    environment : mapping
        Variables of the commands.

    """

    def __init__(self, environment):
        """Start nothing yet."""
        self._environment = environment
        self._process: subprocess.Popen[str] | None = None

    def run(self, arguments, folder):
        """Run `bellows` in a folder, and return what it printed and ended with."""
        if self._process is None:
            self._process = subprocess.Popen(
                [sys.executable, '-c', 'from test.cli.served import serve; serve()'], cwd=ROOT,
                env=self._environment, text=True, stdin=subprocess.PIPE, stdout=subprocess.PIPE,
                start_new_session=True)
        with tempfile.TemporaryDirectory() as name:
            printed = [Path(name, stream) for stream in ('out', 'err')]
            try:
                json.dump([arguments, str(folder), *map(str, printed)], self._process.stdin)
                self._process.stdin.write('\n')
                self._process.stdin.flush()
                code = int(self._process.stdout.readline())
            except BaseException:  # a command that takes too long, above all
                self.close()
                raise
            return subprocess.CompletedProcess(
                arguments, code, *(path.read_text() for path in printed))

    def close(self):
        """End the process, and a command that still runs."""
        if self._process is not None:
            os.killpg(self._process.pid, signal.SIGKILL)
            self._process.communicate()
            self._process = None


def serve():
    """Fork a process for each line of commands, and print what it ended with."""
    load()
    gc.freeze()  # what is there is not looked through again in every child
    for line in sys.stdin:
        child = os.fork()
        if child == 0:
            begin(*json.loads(line))
        print(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]), flush=True)


def load():
    """Import what commands import late."""
    for name in PACKAGES:
        package = importlib.import_module(f'bellows_ros.{name}')
        for module in pkgutil.iter_modules(package.__path__, f'{package.__name__}.'):
            if not module.name.endswith('__main__'):
                importlib.import_module(module.name)
    for name in USEFUL:
        try:
            importlib.import_module(name)
        except ImportError:
            pass
    compile_most()


def begin(arguments, folder, out, err):
    """Become the command."""
    from bellows_ros.cli import main

    os.chdir(folder)
    for number, path in enumerate((os.devnull, out, err)):
        os.dup2(os.open(path, os.O_RDWR | os.O_CREAT), number)
    sys.argv = ['bellows', *arguments]
    try:
        code = main()
    except SystemExit as end:
        code = end.code
    except BaseException:  # noqa: BLE001 (shown as an interpreter does)
        traceback.print_exc()
        code = 1
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(code or 0)  # taking the interpreter down takes longer than most commands
