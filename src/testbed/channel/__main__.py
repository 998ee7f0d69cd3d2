"""``python -m testbed.channel --link NAME``: one link as a process."""

import sys
from typing import get_args

from testbed.channel.service import builder, role_of
from testbed.wire.keys import LinkName
from testbed.wire.process import parser, serve

if __name__ == "__main__":
    options = parser("One link of a run.")
    options.add_argument("--link", required=True, choices=get_args(LinkName), help="which link")
    given = options.parse_args()
    sys.exit(serve(given, role_of(given.link), builder(given.link)))
