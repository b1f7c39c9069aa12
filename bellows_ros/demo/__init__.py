"""
The demonstration on the recordings in bags/: `python -m bellows_ros.demo`.

Identifies a cup, starts the node predictor with it, plays another recording to it over DDS at
recorded speed, and shows how well the predicted poses meet the measured ones.
"""
