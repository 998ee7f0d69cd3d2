"""``python -m testbed.estimator --name NAME``: one estimator of the scenario as a process, or one that joins later."""

import sys

from pydantic import ValidationError

from testbed.estimator.service import builder, role_of
from testbed.scenario import EstimatorSpec
from testbed.wire.process import parser, serve

if __name__ == "__main__":
    options = parser("One estimator of a run.")
    options.add_argument("--name", required=True, help="its name in the scenario")
    options.add_argument("--role", help="its name among the roles; default estimator.NAME")
    options.add_argument("--spec", metavar="JSON", help="of one that joins while the run goes: its table")
    given = options.parse_args()
    try:
        spec = None if given.spec is None else EstimatorSpec.model_validate_json(given.spec)
    except ValidationError as error:
        sys.exit(f"--spec: {error}")
    sys.exit(serve(given, given.role or role_of(given.name), builder(given.name, spec)))
