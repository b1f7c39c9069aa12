"""From recorded streams to motions of tool and package that a cup can be identified from."""
