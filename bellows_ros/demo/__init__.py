"""
The main job on the recordings in bags/, from end to end: `python -m bellows_ros.demo`.

Identifies a cup, starts the node predictor with it, plays another recording to it over DDS at
recorded speed, and shows how well the predicted poses meet the measured ones.
"""
