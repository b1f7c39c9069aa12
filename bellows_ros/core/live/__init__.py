"""The live predictor without ROS: screening, pairing, propagation."""

from bellows_ros.core.live.predictor import LivePredictor, RESTARTS, warm_up
from bellows_ros.core.live.tool_screening import REFUSALS
from bellows_ros.core.live.uncertainty import Prediction

__all__ = ['LivePredictor', 'Prediction', 'REFUSALS', 'RESTARTS', 'warm_up']
