"""
The table of commands, which is all that `bellows --help` loads.

A command is a module of this package with its name, which has

- `DESCRIPTION`: what it does, in a sentence or two;
- `EXAMPLES`: pairs of a command line and what it is for;
- `add_arguments(parser)`: its arguments;
- `run(arguments, console)`: its work; returns the exit code.

Modules import what takes long to load (NumPy, recordings) inside `run` and below it.
"""

from collections.abc import Mapping
from types import MappingProxyType

COMMANDS: Mapping[str, str] = MappingProxyType(
    {
        'identify': "find a cup's stiffness and damping in recordings",
        'replay': 'predict a recording with a cup, and score the prediction',
        'simulate': 'make a recording of a known cup',
        'parameters': 'list all parameters, or write a parameter file to fill in',
    }
)

# What a command ends with.
OK = 0
NOT_USABLE = 1
USER_ERROR = 2
INTERRUPTED = 130
PIPE_CLOSED = 141

EXIT_CODES = """exit codes:
  0    done
  1    the fit has finished, but its result cannot be used
  2    something to put right: the message says what; nothing was written
  130  interrupted with Ctrl-C; nothing is half done
"""
