"""Scalar tuples for kernels, arrays on SO(3) and SE(3), and the compilation of kernels."""
