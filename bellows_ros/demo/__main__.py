"""Run the demonstration."""

import sys

from bellows_ros.core import keep_linear_algebra_single

if __name__ == '__main__':
    keep_linear_algebra_single()
    from bellows_ros.demo.app import main

    sys.exit(main())
