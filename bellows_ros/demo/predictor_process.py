"""The node predictor as a process of its own, started and stopped cleanly."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
import signal
import subprocess
import sys

from bellows_ros.errors import BellowsError

END_TIMEOUT = 10.0
LAST_LINES = 15


@contextmanager
def predictor(parameters: Path, log: Path) -> Iterator[Callable[[], None]]:
    """
    Run the node while the context lasts.

    Parameters
    ----------
    parameters : Path
        For --params-file.
    log : Path
        Gets all that the node says.

    Yields
    ------
    callable
        Raises BellowsError, with the end of the log, when the node has ended by itself.

    """
    command = [sys.executable, '-m', 'bellows_ros.nodes.predictor', '--ros-args',
               '--params-file', str(parameters)]
    with log.open('wb') as output:
        process = subprocess.Popen(
            command, stdin=subprocess.DEVNULL, stdout=output, stderr=subprocess.STDOUT
        )

    def require_alive() -> None:
        if process.poll() is not None:
            lines = log.read_text(errors='replace').splitlines()[-LAST_LINES:]
            end = '\n'.join(f'  {line}' for line in lines) or '  (it is empty)'
            raise BellowsError(
                f'The predictor exited with code {process.returncode}. The end of its log, '
                f'{log}:\n{end}')

    try:
        yield require_alive
        require_alive()
    finally:
        if process.poll() is None:
            process.send_signal(signal.SIGINT)  # as Ctrl-C does
        try:
            process.wait(END_TIMEOUT)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
