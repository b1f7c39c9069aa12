"""What was given with a recording, tried against it: refined where asked, and doubted."""
