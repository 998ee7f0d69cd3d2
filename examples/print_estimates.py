"""Print the estimates of a run as they are published, without the testbed's code: zenoh and the standard library.

    python print_estimates.py tcp/127.0.0.1:7447 [RUN]

Start it before the run; it leaves when the run ends. `testbed schema asyncapi` has the keys and the format.
"""

import json
import math
import signal
import struct
import sys

import zenoh


def unbundle(payload):
    """A payload is one message, or several, each behind its length."""
    if payload[:4] != b"NCSB":
        return [payload]
    messages, end = [], 8
    while end < len(payload):
        begin, end = end + 8, end + 8 + int.from_bytes(payload[end : end + 8], "little")
        messages.append(payload[begin:end])
    return messages


def decode(message):
    """The header of a message, and its arrays as flat tuples in C order."""
    end = 8 + int.from_bytes(message[4:8], "little")
    header, arrays = json.loads(message[8:end]), {}
    for name, dtype, shape in header["arrays"]:
        code = f"<{math.prod(shape)}{'d' if dtype == '<f8' else 'B'}"
        arrays[name] = struct.unpack_from(code, message, end)
        end += struct.calcsize(code) + -struct.calcsize(code) % 8  # padded to a multiple of 8 bytes
    return header, arrays


def show(sample):
    for header, arrays in map(decode, unbundle(sample.payload.to_bytes())):
        if header["lane"] == 0:  # the packet that holds the first lane
            n = len(arrays["x_hat"]) // header["lanes"]
            x_hat = " ".join(f"{value:.6g}" for value in arrays["x_hat"][:n])
            trace = sum(arrays["P"][i * n + i] for i in range(n))
            print(f"{header['source']} k={header['step']} x_hat=[{x_hat}] tr_P={trace:.6g}", flush=True)


def main(endpoint, run="*"):
    signal.signal(signal.SIGINT, signal.SIG_DFL)  # Ctrl-C leaves, also while waiting for the run
    retry = {"period_init_ms": 100, "period_max_ms": 100, "period_increase_factor": 1}
    connect = {"endpoints": [endpoint], "timeout_ms": -1, "retry": retry}  # until the run is there
    with zenoh.open(zenoh.Config.from_json5(json.dumps({"mode": "client", "connect": connect}))) as session:
        session.declare_subscriber(f"testbed/{run}/estimate/*", show)
        presence = session.liveliness().declare_subscriber(f"testbed/{run}/presence/orchestrator")
        while presence.recv().kind != zenoh.SampleKind.DELETE:
            pass


if __name__ == "__main__":
    main(*sys.argv[1:])
