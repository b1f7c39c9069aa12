"""Output of the commands: results on stdout; warnings, errors and progress on stderr; by rich."""

from collections.abc import Iterator
from contextlib import contextmanager
import sys
from typing import Any
import warnings

from bellows_ros.errors import shown, UnitWarning
from rich import progress
from rich.console import Console as Stream
from rich.text import Text

from .text import MAX_TEXT, Writer

COMPILING = 'Compiling (once a version): about 15 s.'
"""Announcement of the compiler; the processor time of `identify`, the longest of all commands."""


class ProgressBar:
    """One line with the stage, a bar and the remaining time, on a terminal alone."""

    _listens = False

    def __init__(self, stream: Stream) -> None:
        self._bar = progress.Progress(
            progress.BarColumn(24), progress.TaskProgressColumn(),
            progress.TextColumn('{task.description}', markup=False),
            progress.TimeRemainingColumn(compact=True),
            console=stream, transient=True, disable=not stream.is_terminal)
        self._task, self._is_shown = self._bar.add_task('', total=None), stream.is_terminal

    def __enter__(self) -> 'ProgressBar':
        """Begin the work; the line is shown with its first stage."""
        return self

    def __call__(self, stage: str, fraction: float | None = None) -> None:
        """Show a stage and, if known, the completed fraction of the whole work."""
        jit: Any = sys.modules.get('bellows_ros.core.geometry.jit')  # of commands that compute
        if jit and not self._listens:
            jit.announce(lambda: self._bar.console.print(COMPILING, highlight=False))
            self._listens = True
        self._bar.start()
        self._bar.update(self._task, description=shown(stage, MAX_TEXT), completed=fraction or 0.0,
                         total=None if fraction is None else 1.0)

    def __exit__(self, *_: object) -> None:
        """Remove the line."""
        if self._is_shown:  # rich 13.7 prints an empty line elsewhere
            self._bar.stop()


class Console(Writer):
    """
    Streams of a command.

    Attributes
    ----------
    asked : list of str
        Questions already printed about implausible values of package or cup.
    final_warnings : list of str
        Warnings printed after the work.
    progress : ProgressBar
        Progress of the work.

    """

    def __init__(self) -> None:
        super().__init__(Stream(highlight=False))
        self._stderr = Stream(stderr=True, highlight=False)
        self.progress = ProgressBar(self._stderr)
        self.asked: list[str] = []
        self.final_warnings: list[str] = []

    def keep_stdout_free(self) -> None:
        """Print results on stderr from now on, as stdout takes a file's content."""
        self.console = self._stderr

    def warn(self, *texts: str) -> None:
        """Print warnings."""
        for text in texts:
            self._print_error(f'Warning: {text}', 'yellow')

    @contextmanager
    def asking(self) -> Iterator[None]:
        """Print each question about implausible values once, as soon as the values are read."""
        show = warnings.showwarning

        def ask(message: Any, category: type[Warning], *more: Any, **options: Any) -> None:
            if category is not UnitWarning:
                show(message, category, *more, **options)
            elif str(message) not in self.asked:
                self.warn(str(message))
                self.asked.append(str(message))

        with warnings.catch_warnings():
            warnings.simplefilter('always', UnitWarning)
            warnings.showwarning = ask
            yield

    def error(self, text: str, style: str = 'red', head: str = 'bellows: ') -> None:
        """Print an error."""
        self._print_error(f'{head}{text}', style)

    def _print_error(self, text: str, style: str = '') -> None:
        """Print on stderr; wrapped on a terminal, except lines to be copied."""
        self.close_gap()
        for line in shown(text, MAX_TEXT, '\n').splitlines():
            is_whole = not self._stderr.is_terminal or line[:1] in (' ', '/')
            self._stderr.print(Text(line, style), soft_wrap=is_whole)
