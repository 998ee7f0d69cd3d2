"""Print the estimates of a run as they are published, without the testbed's code: zenoh and the standard library.

    python print_estimates.py tcp/127.0.0.1:7447 [RUN]

Start it before the run: it waits for the endpoint, and leaves when the run ends. The format of a message is what
`testbed schema messages` describes; the keys are those of `testbed schema asyncapi`.
"""

import json
import math
import signal
import struct
import sys
import threading

import zenoh


def decode(payload):
    """The header of a message, and its arrays as flat tuples in C order."""
    magic, length = struct.unpack_from("<4sI", payload)
    if magic != b"NCS1":
        raise ValueError("not a message of a run")
    header = json.loads(payload[8 : 8 + length])
    arrays, offset = {}, 8 + length
    for name, dtype, shape in header["arrays"]:
        code = f"<{math.prod(shape)}{'d' if dtype == '<f8' else 'B'}"
        arrays[name] = struct.unpack_from(code, payload, offset)
        offset += struct.calcsize(code) + -struct.calcsize(code) % 8  # padded to a multiple of 8 bytes
    return header, arrays


def show(sample):
    header, arrays = decode(sample.payload.to_bytes())
    if header["lane"] == 0:  # the packet that holds the first lane
        n = len(arrays["x_hat"]) // header["lanes"]
        x_hat = " ".join(f"{value:.6g}" for value in arrays["x_hat"][:n])
        trace = sum(arrays["P"][i * n + i] for i in range(n))
        print(f"{header['source']} k={header['step']} x_hat=[{x_hat}] tr_P={trace:.6g}", flush=True)


def main(endpoint, run="*"):
    signal.signal(signal.SIGINT, signal.SIG_DFL)  # Ctrl-C leaves, also while waiting for the run
    config = zenoh.Config()
    config.insert_json5("mode", '"client"')
    config.insert_json5("connect/endpoints", json.dumps([endpoint]))
    config.insert_json5("connect/timeout_ms", "-1")
    config.insert_json5("connect/retry", '{"period_init_ms": 100, "period_max_ms": 100, "period_increase_factor": 1}')
    over = threading.Event()
    with zenoh.open(config) as session:
        session.declare_subscriber(f"testbed/{run}/estimate/*", show)
        session.liveliness().declare_subscriber(
            f"testbed/{run}/presence/orchestrator",
            lambda sample: over.set() if sample.kind == zenoh.SampleKind.DELETE else None,
        )
        over.wait()


if __name__ == "__main__":
    main(*sys.argv[1:])
