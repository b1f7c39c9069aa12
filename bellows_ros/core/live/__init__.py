"""The live predictor without ROS: screening, pairing, propagation."""

from bellows_ros.core.live.predictor import Predictor, RESTARTS, warm_up
from bellows_ros.core.live.tool_screening import REFUSALS
from bellows_ros.core.live.uncertainty import Prediction

__all__ = ['Prediction', 'Predictor', 'REFUSALS', 'RESTARTS', 'warm_up']
