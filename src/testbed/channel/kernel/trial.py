"""What works here, tried in namespaces that go with this process: ``python -m testbed.channel.kernel.trial KIND``.

KIND: "root", with the rights that there are, or "user", within a user namespace. Prints JSON: by step, null where it
works, else why not; a step after a failed one that it needs is left out.
"""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from collections.abc import Callable

from testbed.channel.kernel.namespaces import become_root_of_user_namespace, new_network
from testbed.channel.kernel.plan import ADDRESSES
from testbed.channel.kernel.tun import join, open_tun


def main(kind: str) -> None:
    found: dict[str, str | None] = {}

    def works(step: str, attempt: Callable[[], object]) -> bool:
        try:
            attempt()
        except OSError as error:
            found[step] = error.strerror or str(error)
        else:
            found[step] = None
        return found[step] is None

    if (kind != "user" or works("user", become_root_of_user_namespace)) and works("network", new_network):
        if works("tun", open_tun):
            works("address", lambda: join(*ADDRESSES, 1500, None))
        works("netem", _netem)
    print(json.dumps(found))


def _netem() -> None:
    for tool in ("ip", "tc"):
        if shutil.which(tool) is None:
            raise OSError(f"there is no command {tool!r}")
    command = ["tc", "qdisc", "add", "dev", "lo", "root", "netem", "delay", "1ms"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=10, check=False)
    if done.returncode:
        raise OSError(" ".join(done.stderr.split()))


if __name__ == "__main__":
    main(sys.argv[1])
