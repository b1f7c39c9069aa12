"""Topics of the toss: predicted landing, time of release, and the valve."""

import time
from typing import Any

from geometry_msgs.msg import PoseWithCovarianceStamped
import numpy as np
from std_msgs.msg import Bool, Header
from visualization_msgs.msg import Marker, MarkerArray

from .conversions import write_header, write_place, write_stamp
from .guarding import Worker
from .outputs import marker, NAMESPACE, point, show, Topic
from ..core.geometry.arrays import Array
from ..core.live import Prediction
from ..core.live.flight import Flight, Landing, PATH_POINTS
from ..core.model.kernels import ModelTuple
from ..core.toss.landing import ellipse
from ..core.toss.release import flight_path

VALVE_TIME_PERIOD_NS = 200_000_000
"""Period (ns) of release/at."""
BLUE = (0.36, 0.29, 0.62, 0.9)


class Tossing:
    """
    Subscribers and publishers for a toss.

    Parameters
    ----------
    pipeline : Pipeline
        Switches the valve, and knows the tool's motion after a prediction.

    Attributes
    ----------
    flight : Flight
        Follows the package after the valve.

    """

    def __init__(self, pipeline: Any) -> None:
        """Advertise, and listen to the valve."""
        self._pipeline, node = pipeline, pipeline.node
        self._worker = Worker(node, 'release')  # no plan waits behind a search
        self._landing = Topic(node, PoseWithCovarianceStamped, 'package/landing')
        self._at = Topic(node, Header, 'release/at')
        self._markers = Topic(node, MarkerArray, 'package/landing_markers')
        node.create_subscription(
            Bool, 'vacuum/valve', lambda message: pipeline.switch_valve(message.data), 10)
        self._landing_ns = self._valve_time_ns = 0

    def use_values(self) -> None:
        """Use other values; compile what a landing needs."""
        pipeline = self._pipeline
        self.flight = Flight(
            pipeline.values, pipeline.planning.rest, lambda: pipeline.load.grip)
        # ticks are not exact
        self._period_ns = round(0.9e9 / pipeline.values['landing.rate'])
        self.flight.warm_up(pipeline.live.model)

    def publish(self, held: Prediction) -> None:
        """Publish the landing, and when to release, at their rates."""
        if not self.flight.has_size or self.flight.state:
            return
        model, frame_id = self._pipeline.live.model, self._pipeline.live.frame_id
        now_ns = time.monotonic_ns()
        wanted = self._landing.subscribed or self._markers.subscribed
        if wanted and now_ns - self._landing_ns >= self._period_ns:
            self._landing_ns = now_ns
            landing = self.flight.landing(
                model, held, self._pipeline.outputs.uncertainty.covariance)
            if landing is not None:
                self._landing.send(_write, landing, held.stamp_ns, frame_id)
                if self._markers.subscribed:
                    path = flight_path(model, landing.toss, PATH_POINTS)
                    self._markers.publish(_markers(landing, path, held.stamp_ns, frame_id))
        if (self._at.subscribed and now_ns - self._valve_time_ns >= VALVE_TIME_PERIOD_NS
                and not self._worker.is_busy):
            self._valve_time_ns = now_ns
            self._worker.submit('aim', self._publish_valve_time, model, held, frame_id)

    def _publish_valve_time(
        self, model: ModelTuple, prediction: Prediction, frame_id: str
    ) -> None:
        """Publish when to switch the valve for the target."""
        after = self.flight.time_to_target(model, prediction)
        if after is not None and not self._worker.stop[0]:
            message = Header(frame_id=frame_id)
            write_stamp(message.stamp, prediction.stamp_ns + round(after * 1e9))
            self._at.publish(message)


def _write(
    message: PoseWithCovarianceStamped, landing: Landing, stamp_ns: int, frame_id: str
) -> None:
    """Write the pose of B at landing, stamped as the prediction that it was made from."""
    write_header(message, stamp_ns, frame_id)
    write_place(message.pose.pose, *landing.toss.landing[:2])
    message.pose.covariance = landing.covariance.ravel()


def _markers(landing: Landing, path: Array, stamp_ns: int, frame_id: str) -> MarkerArray:
    """Return the path of the flight, and the 95 % ellipse about its end."""
    ring = np.zeros((33, 3)) + landing.toss.landing[0]
    ring[:, :2] += ellipse(landing.covariance, 33)
    markers = []
    for number, points in enumerate((path[:, :3], ring)):
        line = marker(number, Marker.LINE_STRIP, (0.005, 0.0, 0.0), f'{NAMESPACE}_landing')
        show(line, stamp_ns, frame_id, BLUE)
        line.points = [point(each) for each in points.tolist()]
        markers.append(line)
    return MarkerArray(markers=markers)
