"""The node predictor as a process of its own, started and stopped cleanly."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
import signal
import subprocess
import sys

from bellows_ros.errors import BellowsError

END_TIMEOUT = 10.0
LAST_LINES = 15


@contextmanager
def predictor(parameter_files: Sequence[Path], log: Path) -> Iterator[Callable[[], None]]:
    """
    Run the node while the context lasts.

    Parameters
    ----------
    parameter_files : sequence of Path
        For --params-file.
    log : Path
        Gets all that the node says.

    Yields
    ------
    callable
        Raises BellowsError, with the end of the log, when the node has ended by itself.

    """
    files = [word for file in parameter_files for word in ('--params-file', str(file))]
    command = [sys.executable, '-m', 'bellows_ros.nodes.predictor', '--ros-args', *files]
    with log.open('wb') as output:
        process = subprocess.Popen(
            command, stdin=subprocess.DEVNULL, stdout=output, stderr=subprocess.STDOUT
        )

    def require_alive() -> None:
        if process.poll() is not None:
            raise BellowsError(
                f'The predictor exited with code {process.returncode}. The end of its log, '
                f'{log}:\n{_tail(log)}'
            )

    try:
        yield require_alive
        require_alive()
    finally:
        _end(process)


def _end(process: 'subprocess.Popen[bytes]') -> None:
    """Ask the node to end as Ctrl-C does; insist when it does not."""
    if process.poll() is None:
        process.send_signal(signal.SIGINT)
    try:
        process.wait(END_TIMEOUT)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()


def _tail(log: Path) -> str:
    """Return the last lines of a log."""
    lines = log.read_text(errors='replace').splitlines()
    return '\n'.join(f'  {line}' for line in lines[-LAST_LINES:]) or '  (it is empty)'
