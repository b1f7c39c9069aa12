"""Measurements of the package: residuals, derivatives and noise, one module a sensor."""
