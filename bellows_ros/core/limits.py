"""What no arm exceeds, and what counts as a rotation: of live poses and of plans."""

LARGEST_SPEED = 20.0
"""No arm is faster (m/s) ..."""

LARGEST_RATE = 60.0
"""... nor turns faster (rad/s)."""

UNIT_WITHIN = 0.01
"""A quaternion whose length is off by more is refused, by less is scaled to unit length."""
