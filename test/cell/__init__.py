"""One simulated cell for tests and benchmarks: motions, cups and packages, sensors."""
