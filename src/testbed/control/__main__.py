"""``python -m testbed.control``: the controller as a process."""

import sys

from testbed.control.service import ROLE, build
from testbed.wire.process import main

if __name__ == "__main__":
    sys.exit(main(None, ROLE, build, "The controller of a run."))
