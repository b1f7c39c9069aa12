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
        'info': 'list the topics of a recording, and tell tool from package',
        'identify': "find a cup's stiffness and damping in recordings",
        'ladder': 'say what recordings can tell of a cup, and which structure to take',
        'static': "find the cup's nominal length at rest, and check its spring alone",
        'validate': 'judge a cup by a recording that it was not identified from',
        'compare': 'say what differs between two fits, and whether it matters',
        'report': 'write a page with plots on a fit',
        'replay': 'predict a recording with a cup, and score the prediction',
        'simulate': 'make a recording of a known cup',
        'plot': 'draw recordings, fits and predictions',
        'view': 'show a replay in the viewer Rerun, or write it for that',
        'convert': 'make recordings of Motive, TUM or EuRoC files, and TUM files of recordings',
        'export': 'write a cup for MuJoCo, Drake or SDF',
        'parameters': 'list all parameters, or write a parameter file to fill in',
        'summarize': 'reduce a recording to what a fit needs of it',
        'merge': 'identify a cup from summaries of recordings',
        'bench': 'measure the speed of this package on this machine',
        'completion': 'complete commands and options in the shell',
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
  1    finished, but: the fit cannot be used (identify), an axis is above the
       limit (validate --limit), two fits differ where it matters (compare)
  2    something to put right: the message says what; nothing was written
  130  interrupted with Ctrl-C; nothing is half done
"""
