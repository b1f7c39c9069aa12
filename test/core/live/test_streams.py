"""A wrong stamp is refused and counted in each input stream, and stops none of them."""

from bellows_ros.core.live import Predictor
import pytest

from ..observer.cases import values
from ...cell.motion import MS, START, UPRIGHT

pytestmark = pytest.mark.usefixtures('observer_kernels')

ORIGIN = (0.0, 0.0, 0.0)
PERIOD = 4 * MS
STEPS = 60
STREAMS = ('twist', 'pose', 'wrench', 'measured')
SHIFTS = {
    'a little ahead': 600 * MS, 'far ahead': 10**14, 'behind': -1000 * MS, 'far behind': 1 - START,
    'again': 0}
WEIGHT = (0.0, 0.0, 1.8 * 9.81)


class Streams:
    """A predictor with a tool at rest, and counts of the used and the refused messages."""

    def __init__(self):
        self.live = Predictor.from_parameters(values(wrench__sign='reaction'))
        self.stamp, self.arrival = START, 10**12
        self.used, self.refused_wrenches, self.height = dict.fromkeys(STREAMS, 0), 0, 0.0

    def send(self, stream, stamp):
        """Send a message."""
        live = self.live
        self.arrival += PERIOD // 4
        if stream == 'pose':
            before, found = live.motion.estimated, live.on_pose(
                stamp, 'world', ORIGIN, UPRIGHT, self.arrival)
            self.used['twist'] += len(found) - (live.motion.estimated - before)
            self.height = found[-1].position[2] if found else self.height
        elif stream == 'twist':
            live.on_twist(stamp, ORIGIN, ORIGIN, 'world')
        elif stream == 'wrench':
            why_not = live.on_wrench(stamp, 'ft', WEIGHT, ORIGIN)
            self.used['wrench'] += not why_not
            self.refused_wrenches += bool(why_not)
        else:
            x = 1e-5 * (stamp // MS % 8 - 4)  # no two are equal
            live.on_measured(stamp, 'world', (x, 0.0, self.height), UPRIGHT, None, self.arrival)

    def run(self):
        """Send each stream at 250 Hz; return how many of each are used."""
        observer = self.live.package.observer
        start = observer.counts['used'] if observer else 0
        self.used = dict.fromkeys(STREAMS, 0)
        predicted = self.live.predictions
        for _ in range(STEPS):
            self.stamp += PERIOD
            for stream in STREAMS:
                self.send(stream, self.stamp)
        self.used['pose'] = self.live.predictions - predicted
        self.used['measured'] = self.live.package.observer.counts['used'] - start
        return self.used

    def rejections(self):
        """Return the number of rejections of all streams."""
        counts = self.live.package.observer.counts
        return self.refused_wrenches + sum(self.live.refused.values()) + sum(
            count for reason, count in counts.items() if reason not in ('used', 'recovered'))


@pytest.fixture
def streams():
    """Give streams that have run for a while."""
    given = Streams()
    assert min(given.run().values()) >= STEPS - 2
    return given


@pytest.mark.parametrize('then', ['go on', 'reset', 'loop'])
@pytest.mark.parametrize('shift', SHIFTS.values(), ids=SHIFTS)
@pytest.mark.parametrize('stream', STREAMS)
def test_a_wrong_stamp_is_refused_and_stops_no_stream(streams, stream, shift, then):
    """Also before a reset, and before all begins again as in a recording played in a loop."""
    before = streams.rejections()
    streams.send(stream, streams.stamp + shift)
    if then == 'reset':
        streams.live.reset()
    elif then == 'loop':
        streams.stamp = START
    lost = 0 if then == 'go on' else 8  # until a run of old stamps is believed
    assert min(streams.run().values()) >= STEPS - 2 - lost
    if then == 'go on':
        assert streams.rejections() == before + 1
