"""Run the demonstration."""

import sys

from bellows_ros.demo.app import main

if __name__ == '__main__':
    sys.exit(main())
