"""Markers for RViz: the package as a box of its mass and inertia, the cup, and its force."""

from collections.abc import Mapping
from typing import Any

from geometry_msgs.msg import Point
from visualization_msgs.msg import Marker, MarkerArray

from .conversions import write_header, write_quaternion, write_vector
from ..core.geometry.tuples import add, add_scaled, apply, rotation_matrix, Vector
from ..core.live import Prediction
from ..core.live.load import equivalent_box, lip_position
from ..core.model.kernels import ModelTuple
from ..core.model.layout import places_of

NAMESPACE = 'bellows_ros'
PERIOD_NS = 40_000_000
"""Time (ns) between two sets of markers."""

METRES_PER_NEWTON = 0.005
CUP_WIDTH = 0.04
ARROW_WIDTH = (0.006, 0.012, 0.015)
CARDBOARD = (0.76, 0.6, 0.42, 0.8)
RUBBER = (0.2, 0.3, 0.8, 0.9)
FORCE = (0.9, 0.2, 0.1, 1.0)
COASTING = (0.6, 0.6, 0.6, 0.5)


class Picture:
    """Markers that are filled in again for each picture."""

    def __init__(self, values: Mapping[str, Any]) -> None:
        """Size the box."""
        self._box = marker(0, Marker.CUBE, equivalent_box(values))
        self._cup = marker(1, Marker.LINE_LIST, (CUP_WIDTH, 0.0, 0.0))
        self._places: list[Vector] = [
            (x, y, z) for x, y, z in places_of(values)[:, :3].tolist()]
        self._force = marker(2, Marker.ARROW, ARROW_WIDTH)
        self._array = MarkerArray(markers=[self._box, self._cup, self._force])
        self._last_ns = 0

    def is_due(self, stamp_ns: int) -> bool:
        """Return whether the next markers are due."""
        return not 0 <= stamp_ns - self._last_ns < PERIOD_NS

    def of(self, frame_id: str, model: ModelTuple, prediction: Prediction) -> MarkerArray:
        """Return the markers of a prediction; grey while the tool is extrapolated."""
        self._last_ns = prediction.stamp_ns
        lip = lip_position(model, prediction)
        R_world_package = rotation_matrix(prediction.quaternion_xyzw)
        tip = add_scaled(lip, METRES_PER_NEWTON, apply(R_world_package, prediction.force))
        write_vector(self._box.pose.position, prediction.position)
        write_quaternion(self._box.pose.orientation, prediction.quaternion_xyzw)
        tool, R_world_tool = prediction.tool[0], rotation_matrix(prediction.tool[1])
        self._cup.points = []
        for place in self._places:
            root = add(tool, apply(R_world_tool, place))
            end = root if prediction.flies else add(lip, apply(R_world_package, place))
            self._cup.points += [_point(root), _point(end)]
        self._force.points = [_point(lip), _point(tip)]
        for marker, colour in ((self._box, CARDBOARD), (self._cup, RUBBER), (self._force, FORCE)):
            write_header(marker, prediction.stamp_ns, frame_id)
            rgba = COASTING if prediction.coasting else colour
            marker.color.r, marker.color.g, marker.color.b, marker.color.a = rgba
        return self._array


def gone() -> MarkerArray:
    """Return the message that deletes all markers."""
    return MarkerArray(markers=[Marker(ns=NAMESPACE, action=Marker.DELETEALL)])


def marker(number: int, kind: int, scale: Vector, namespace: str = NAMESPACE) -> Marker:
    """Return a marker of a kind and size (m)."""
    made = Marker(ns=namespace, id=number, type=kind, action=Marker.ADD)
    write_vector(made.scale, scale)
    made.lifetime.nanosec = 500_000_000
    return made


def _point(position: Vector) -> Point:
    """Return a position as a message."""
    x, y, z = position
    return Point(x=x, y=y, z=z)
