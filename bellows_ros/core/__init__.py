"""
Hold the numbers: model, integration, filtering, identification, prediction.

Needs numpy and scipy, and numba where present. Reads no files, logs nothing, knows no ROS.
"""
