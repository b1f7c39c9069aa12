"""The cup-package model: kernels, cup and package, equilibrium, simulation, grip."""
