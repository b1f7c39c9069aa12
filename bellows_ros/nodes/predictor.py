"""The command `predictor`: the node that publishes the pose of the held package."""

from functools import partial
import sys

from .command import run

main = partial(run, 'predictor', 'bellows_ros.nodes.predictor_node:PredictorNode')

if __name__ == '__main__':
    sys.exit(main())
