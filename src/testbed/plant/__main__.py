"""``python -m testbed.plant``: the plant as a process."""

import sys

from testbed.plant.service import ROLE, PlantService
from testbed.wire.process import main

if __name__ == "__main__":
    sys.exit(main(None, ROLE, PlantService, "The plant of a run: dynamics, sensor, actuator."))
