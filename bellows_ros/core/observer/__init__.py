"""Correct the prediction with measured poses of the package."""

from bellows_ros.core.observer.alarms import Alarm
from bellows_ros.core.observer.measurement import Measurement
from bellows_ros.core.observer.observer import (
    Calibration,
    Observer,
    Payload,
    VERDICTS,
    warm_up_observer,
)

__all__ = [
    'Alarm', 'Calibration', 'Measurement', 'Observer', 'Payload', 'VERDICTS', 'warm_up_observer']
