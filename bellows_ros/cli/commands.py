"""
The table of commands, which is all that `bellows --help` loads.

A command is a module of this package with its name, which has

- `DESCRIPTION`: what it does, in a sentence or two;
- `EXAMPLES`: pairs of a command line and what it is for;
- `FOUND`, where it can end with 1: what it has found then;
- `add_arguments(parser)`: its arguments;
- `run(arguments, console)`: its work; returns the exit code.

Modules import what takes long to load (NumPy, recordings) inside `run` and below it.
"""

from collections.abc import Mapping
from types import MappingProxyType

COMMANDS: Mapping[str, str] = MappingProxyType(
    {
        'info': 'list the topics of a recording, and find which is the tool',
        'identify': "find a cup's stiffness and damping in recordings",
        'structures': 'say what is identifiable from recordings, and which structure to take',
        'static': "find the cup's nominal length in standstills, and check its spring alone",
        'replay': 'predict a recording with a cup, and say what the cup is worth',
        'compare': 'say what differs between two fits, and whether it matters',
        'report': 'write a page with plots on a fit',
        'plan': 'say what a planned motion does to the package, and if it holds',
        'steer': 'change a planned motion so that the package does not swing',
        'toss': 'predict where a tossed package lands, and what to fix first',
        'excite': 'design a motion from which a cup is found best',
        'simulate': 'make a recording of a known cup',
        'plot': 'draw recordings, fits and predictions',
        'view': 'show a replay in the viewer Rerun, or write it for that',
        'play': 'play the poses and twists of a recording to ROS',
        'convert': 'make recordings of files of Motive, TUM, EuRoC or KITTI, of joints or of tf',
        'export': 'write a cup for MuJoCo, Drake, SDF or OpenPLX, or as C',
        'parameters': 'list all parameters, or write a parameter file to fill in',
        'completion': 'complete commands and options in the shell',
    }
)

# What a command ends with.
OK = 0
NOT_USABLE = 1
USER_ERROR = 2
INTERRUPTED = 130
PIPE_CLOSED = 141

EXIT_CODE = 'Ends with 0 when done, {}2 if something must be put right.'
EXIT_CODES = """exit codes:
  0    done
  1    done, with a finding that scripts want to know; see the command
  2    something to put right: the message says what; nothing was written
  130  interrupted with Ctrl-C, 143 ended by SIGTERM; nothing is half done
"""
