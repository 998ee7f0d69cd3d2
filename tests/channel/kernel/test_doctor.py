"""What the doctor says of what it found."""

from __future__ import annotations

import pytest

from testbed.channel.kernel import doctor

ALL = {"user": None, "network": None, "tun": None, "address": None, "netem": None}


def test_the_names_of_the_findings_do_not_depend_on_the_machine() -> None:
    names = [finding.what for finding in doctor.examine()]
    assert names == [
        "relay",
        "hosts, backend tun",
        "hosts, backend netem",
        "root rights",
        "user namespaces",
        "TCP congestion control",
        "clock and timers",
        "UDP buffers",
        "left behind",
    ]


def test_where_all_works_nothing_is_to_be_done() -> None:
    findings = [
        doctor.relay(None),
        doctor.tun_backend(ALL),
        doctor.netem_backend(ALL),
        doctor.user_namespaces(ALL, False),
        doctor.congestion(["bbr", "cubic", "reno"]),
        doctor.clock(1e-9, 30_000),
        doctor.buffers(4_194_304, 4_194_304),
        doctor.left([]),
    ]
    assert [(finding.ok, finding.advice) for finding in findings] == [(True, "")] * len(findings)


@pytest.mark.parametrize(
    ("finding", "found", "advice"),
    [
        (doctor.relay("No route"), "No route", "127.0.0.1"),
        (doctor.tun_backend({}), "no right", "run as root, or allow user namespaces; the relay"),
        (doctor.tun_backend({"user": "Operation not permitted"}), "no right", "run as root"),
        (doctor.tun_backend({"network": "Operation not permitted"}), "Operation not permitted", "--cap-add"),
        (doctor.tun_backend(ALL | {"tun": "No such file or directory"}), "/dev/net/tun: No such file", "modprobe tun"),
        (doctor.tun_backend(ALL | {"address": "Operation not permitted"}), "setting the device up", "root"),
        (doctor.netem_backend({}), "not tried", "see above"),
        (doctor.netem_backend(ALL | {"netem": "there is no command 'tc'"}), "'tc'", "install iproute2"),
        (doctor.netem_backend(ALL | {"netem": "Error: Specified qdisc kind is unknown."}), "unknown", "modprobe"),
        (doctor.user_namespaces({"user": "No space left on device"}, False), "No space", "max_user_namespaces"),
        (doctor.user_namespaces({"user": "No space left on device"}, True), "No space", "not needed"),
        (doctor.congestion([]), "does not tell", ""),
        (doctor.clock(1e-9, 2_500_000), "2500 µs late", "less load"),
        (doctor.buffers(212_992, 4_194_304), "at most 212992 bytes to receive", "sysctl -w net.core.rmem_max="),
        (doctor.buffers(None, None), "does not tell", ""),
        (doctor.left(["17 sleep 1000"]), "17 sleep 1000", "testbed link clean"),
    ],
)
def test_what_is_missing_is_said_with_what_would_help(finding: doctor.Finding, found: str, advice: str) -> None:
    assert not finding.ok
    assert found in finding.found
    assert advice in finding.advice
