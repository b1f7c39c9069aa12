"""Topics of the toss: predicted landing, time of release, and the valve."""

from collections.abc import Callable, Mapping
import time
from typing import Any

from geometry_msgs.msg import PoseWithCovarianceStamped
import numpy as np
from std_msgs.msg import Bool, Header
from visualization_msgs.msg import Marker, MarkerArray

from .conversions import write_header, write_place, write_stamp
from .guarding import Worker
from .outputs import marker, NAMESPACE, point, show, Topic
from .planning import Planning
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
    node : PredictorNode
        Publishes and subscribes.
    on_valve : callable
        Takes whether the valve is on.
    planning : Planning
        Knows the tool's motion after a prediction.

    Attributes
    ----------
    flight : Flight
        Follows the package after the valve.

    """

    def __init__(self, node: Any, on_valve: Callable[[bool], None], planning: Planning) -> None:
        """Advertise, and listen to the valve."""
        self._planning = planning
        self._worker = Worker(node, 'release')  # no plan waits behind a search
        self._landing = Topic(node, PoseWithCovarianceStamped, 'package/landing')
        self._at = Topic(node, Header, 'release/at')
        self._markers = Topic(node, MarkerArray, 'package/landing_markers')
        node.create_subscription(Bool, 'vacuum/valve', lambda m: on_valve(m.data), 10)
        self._landing_ns = self._valve_time_ns = 0

    def cancel(self) -> None:
        """Drop a running search."""
        self._worker.cancel()

    def close(self) -> None:
        """End the searches for good."""
        self._worker.close()

    def set_model(self, model: ModelTuple, values: Mapping[str, Any]) -> None:
        """Use other values; compile what a landing needs."""
        self.flight = Flight(values, self._planning.rest, self._planning.grip)
        self._period_ns = round(0.9e9 / values['landing.rate'])  # ticks are not exact
        self.flight.warm_up(model)

    def publish(
        self, model: ModelTuple, prediction: Prediction, frame_id: str,
        covariance: Callable[[Prediction], Array],
    ) -> None:
        """Publish the landing, and when to release, at their rates."""
        now_ns = time.monotonic_ns()
        wanted = self._landing.subscribed or self._markers.subscribed
        if wanted and now_ns - self._landing_ns >= self._period_ns:
            self._landing_ns = now_ns
            landing = self.flight.landing(model, prediction, covariance)
            if landing is not None:
                self._landing.send(_write, landing, prediction.stamp_ns, frame_id)
                if self._markers.subscribed:
                    path = flight_path(model, landing.toss, PATH_POINTS)
                    self._markers.publish(_markers(landing, path, prediction.stamp_ns, frame_id))
        if (self._at.subscribed and now_ns - self._valve_time_ns >= VALVE_TIME_PERIOD_NS
                and not self._worker.is_busy):
            self._valve_time_ns = now_ns
            self._worker.submit('aim', self._publish_valve_time, model, prediction, frame_id)

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
