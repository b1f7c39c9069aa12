"""What standstills tell: the nominal length, and K alone."""
