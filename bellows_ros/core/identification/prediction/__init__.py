"""The prediction-error method: fits on poses."""
