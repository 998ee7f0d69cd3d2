"""``python -m testbed.estimator --name NAME``: one estimator of the scenario as a process."""

import sys

from testbed.estimator.service import builder, role_of
from testbed.wire.process import parser, serve

if __name__ == "__main__":
    options = parser("One estimator of a run.")
    options.add_argument("--name", required=True, help="its name in the scenario")
    given = options.parse_args()
    sys.exit(serve(given, role_of(given.name), builder(given.name)))
