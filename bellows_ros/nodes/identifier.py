"""The command `identifier`: the node that identifies a cup from recordings."""

from functools import partial
import sys

from .command import run

main = partial(run, 'identifier', 'bellows_ros.nodes.identifier_node:IdentifierNode')

if __name__ == '__main__':
    sys.exit(main())
