"""Run the demonstration."""

import sys

from bellows_ros.core import configure_process

if __name__ == '__main__':
    configure_process()
    from bellows_ros.demo.steps import main

    sys.exit(main())
