"""What a recording is not."""

from pathlib import Path

from bellows_ros.errors import BellowsError
from bellows_ros.files.bag_folder import listing
import pytest


@pytest.mark.parametrize('name', ['/dev/zero', 'a' * 5000])
def test_what_is_no_recording_is_refused_for_what_it_is(name):
    """Do not say of a device that it does not exist, nor repeat a name of thousands of letters."""
    with pytest.raises(BellowsError) as refused:
        listing(Path(name))
    assert 'does not exist' not in str(refused.value)
    assert len(str(refused.value)) < 300
