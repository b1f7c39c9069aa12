"""Design of motions that identify the cup, within the limits of an arm."""
