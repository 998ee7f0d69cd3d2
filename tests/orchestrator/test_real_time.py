"""Runs in real time, by a clock that the test moves: when each packet leaves, what counts as late, what ends a run."""

from __future__ import annotations

import json
import random
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader

from orchestrator.runs import figures, recorded, run, scenario, tables
from orchestrator.wall_clock import MS, Simulated
from testbed.errors import UsageError
from testbed.orchestrator.recording import read_recording
from testbed.orchestrator.run import Run
from testbed.orchestrator.summary import Summary, read_summary

STEPS = 20
FEEDBACK = {"kind": "feedback", "gain": [[0.4, 0.1]], "estimator": "aoe"}


def real(**changes: Any) -> Any:
    clock = {"mode": "real", "period": "10 ms", **changes.pop("clock", {})}
    return scenario(clock=clock, **changes)


def virtual(**changes: Any) -> Any:
    return scenario(clock={"period": "10 ms"}, **changes)


def without_times(summary: Summary) -> dict[str, Any]:
    return {key: value for key, value in figures(summary).items() if key != "realtime"}


@pytest.mark.parametrize(
    "changes",
    [
        {},
        {"input": FEEDBACK},
        {"input": FEEDBACK, "transport": {"lanes_per_packet": 4}},
        {"input": {"kind": "pid", "kp": 0.3, "ki": 0.1, "kd": 0.2, "high": 1.5}},
        {"lanes": 1, "record": "none"},
        {"record": "first"},
        {"links": {**tables()["links"], "observation": {"delay": {"kind": "uniform", "low": "0 ms", "high": "30 ms"}}}},
    ],
    ids=["open", "closed", "blocks", "pid", "one lane", "first lane recorded", "delays"],
)
def test_with_nothing_late_all_figures_are_those_of_virtual_time(tmp_path: Path, changes: dict[str, Any]) -> None:
    there = run(real(**changes), tmp_path / "real", network=Simulated)
    then = run(virtual(**changes), tmp_path / "virtual")
    assert there.status == "complete"
    assert without_times(there) == without_times(then)
    assert then.realtime is None
    assert there.realtime is not None
    assert there.realtime.missed == there.realtime.held_controls == 0
    for stage in there.realtime.stages.values():
        assert set(stage.published_us) <= {0.0, None}
        assert (stage.published.max, stage.arrived.max, stage.hop.max) == (0.0, 0.0, 0.0)
    assert read_summary(tmp_path / "real" / "summary.json") == there
    if changes.get("record") != "none":
        packets = [list(read_recording(tmp_path / mode / "recording.mcap")) for mode in ("real", "virtual")]
        for one, other in zip(*map(in_order, packets), strict=True):
            assert one == other


def in_order(packets: list[Any]) -> list[Any]:
    """What a recording says, whoever wrote first; the order on the bus is another in real time."""
    found = [
        (topic, packet.step, packet.lane, {name: array.tolist() for name, array in arrays.items()})
        for topic, packet, arrays in packets
    ]
    return sorted(found, key=lambda one: one[:3])


def test_a_recording_in_real_time_has_the_dates_of_publication(tmp_path: Path) -> None:
    run(one_lane(), tmp_path, network=Simulated)
    with (tmp_path / "recording.mcap").open("rb") as file:
        controls = [m for _, channel, m in make_reader(file).iter_messages() if channel.topic == "control/sent"]
    assert np.diff([message.publish_time for message in controls]).tolist() == [10 * MS] * (STEPS - 1)
    assert [message.log_time for message in controls] == [10 * MS * k for k in range(STEPS)]


def test_a_link_changes_at_the_step_that_is_told(tmp_path: Path) -> None:
    """A command while the run goes holds from the first step that is not granted yet."""

    class Commanded(Simulated):
        told = 0

        def before(self, key: str, number: int) -> bool:
            if (key, number) == ("truth", 9):
                question = b'{"link": "observation", "set": {"loss": {"kind": "bernoulli", "arrival": 0.0}}}'
                ask = next(k for k in self._answers if k.endswith("/ask"))
                Commanded.told = json.loads(self._answers[ask][1](question))["step"]
            return True

    summary = run(one_lane(steps=120, links={}), tmp_path, network=Commanded)
    assert summary.status == "complete"
    assert 10 + 45 <= Commanded.told <= 10 + 51  # half a second ahead, as of the last look at the clock
    assert summary.links["observation"].delivered == Commanded.told - 1
    assert [event.step for event in summary.events] == [Commanded.told]


class Slow(Simulated):
    """Estimator aoe takes 25 ms for step 8."""

    def before(self, key: str, number: int) -> bool:
        if (key, number) == ("estimate/aoe", 7):
            self.clock.now_ns += 25 * MS
        return True


def one_lane(**changes: Any) -> Any:
    return real(estimators=[{"name": "aoe"}, {"name": "kfio", "acks": "perfect"}], lanes=1, bounds=False, **changes)


def test_a_late_estimate_is_counted_where_it_is_late_and_the_next_control_leaves_at_once(tmp_path: Path) -> None:
    summary = run(one_lane(), tmp_path, network=Slow)
    assert summary.realtime is not None
    stages = summary.realtime.stages
    assert summary.status == "complete"
    aoe = stages["estimate/aoe"]
    assert aoe.published_us[6:10] == (0.0, 25_000.0, 15_000.0, 5_000.0)
    assert (aoe.missed, aoe.first_missed) == (2, 8)
    assert aoe.hop.max == 25_000.0
    assert stages["control/sent"].published_us[7:11] == (0.0, 15_000.0, 5_000.0, 0.0)
    assert (stages["control/sent"].missed, stages["control/sent"].first_missed) == (1, 9)
    assert stages["control/delivered"].hop.max == 0.0


def test_strict_ends_the_run_at_the_first_missed_deadline(tmp_path: Path) -> None:
    summary = run(one_lane(clock={"deadlines": "strict"}), tmp_path, network=Slow)
    assert summary.status == "failed"
    assert summary.reason == "estimator.aoe missed the deadline of step 8: estimate published 15 ms after it"
    assert summary.completed_steps in (7, 8)


def test_a_longer_deadline_is_kept(tmp_path: Path) -> None:
    summary = run(one_lane(clock={"deadlines": "strict", "deadline": "25 ms"}), tmp_path, network=Slow)
    assert summary.status == "complete"
    assert summary.realtime is not None
    assert summary.realtime.missed == 0


class Silent(Simulated):
    """Nothing comes of aoe from step 5 on, until step 15 has been sent."""

    until = 15

    def before(self, key: str, number: int) -> bool:
        if key == "control/sent" and number == self.until:
            self.release()
        return not (key == "estimate/aoe" and number >= 4 and self._numbers["control/sent"] < self.until)


def test_a_silent_estimator_does_not_hold_the_clock(tmp_path: Path) -> None:
    summary = run(one_lane(), tmp_path / "real", network=Silent)
    assert summary.status == "complete"
    assert summary.realtime is not None
    stages = summary.realtime.stages
    for topic, stage in stages.items():
        if topic != "estimate/aoe":
            assert stage.published.max == 0.0
    # step 5 was due at 40 ms, and came when the control of step 16 left, at 150 ms
    late = [(150.0 - 10.0 * (k - 1)) * 1e3 for k in range(5, 16)]
    assert stages["estimate/aoe"].published_us == (0.0,) * 4 + (*late,) + (0.0,) * 5
    assert stages["estimate/aoe"].missed == sum(us > 10_000 for us in late) == 10
    assert summary.realtime.outstanding_max >= 10
    then = run(one_lane_virtual(), tmp_path / "virtual")
    assert without_times(summary) == without_times(then)


def one_lane_virtual() -> Any:
    return virtual(estimators=[{"name": "aoe"}, {"name": "kfio", "acks": "perfect"}], lanes=1, bounds=False)


class Gone(Silent):
    until = 10**9


def test_too_many_outstanding_steps_end_the_run(tmp_path: Path) -> None:
    summary = run(one_lane(clock={"window": 6}, steps=60), tmp_path, network=Gone)
    assert summary.status == "failed"
    assert summary.reason is not None
    step = int(summary.reason.split()[1])
    assert summary.reason == (
        f"step {step} is due and {step - 4} steps are not complete, allowed: 6 (clock.window); "
        "waiting for step 5: estimate of aoe"
    )
    assert 11 <= step <= 16  # looked at every 50 ms
    assert summary.completed_steps == 4
    assert summary.realtime is not None
    assert summary.realtime.stages["estimate/aoe"].absent == step - 1 - 4  # the deadline of the last is just over
    assert summary.realtime.stages["estimate/kfio"].absent == 0


def test_strict_also_ends_a_run_where_nothing_comes(tmp_path: Path) -> None:
    summary = run(one_lane(clock={"deadlines": "strict"}, steps=60), tmp_path, network=Gone)
    assert summary.status == "failed"
    assert summary.reason is not None
    start, _, late = summary.reason.partition("no estimate ")
    assert start == "estimator.aoe missed the deadline of step 5: "
    assert 100 <= float(late.removesuffix(" ms after it")) <= 150


class Restless(Simulated):
    """Every sleep takes up to 4 ms too long."""

    draw = random.Random(3)

    def overshoot(self) -> int:
        return self.draw.randrange(4 * MS)


def test_no_control_leaves_early_and_no_delay_adds_to_the_next(tmp_path: Path) -> None:
    summary = run(one_lane(), tmp_path, network=Restless)
    assert summary.realtime is not None
    sent = np.array(summary.realtime.stages["control/sent"].published_us, dtype=float)
    assert (sent >= 0.0).all()
    assert (sent < 4000.0).all()
    assert sent.max() > 1000.0


class Set(Simulated):
    """Somebody sets the date two seconds ahead when u_10 leaves."""

    def before(self, key: str, number: int) -> bool:
        if (key, number) == ("control/sent", 10):
            self.clock.set_ns += 2_000 * MS
        return True


def test_setting_the_date_shifts_what_is_reported_and_not_the_pace(tmp_path: Path) -> None:
    summary = run(one_lane(), tmp_path, network=Set)
    assert summary.realtime is not None
    assert summary.realtime.date_set_us == 2e6
    assert summary.realtime.stages["control/sent"].published_us == (0.0,) * 10 + (2e6,) * 10
    assert any(check.name == "date" and not check.ok for check in summary.checks)


class Slower(Simulated):
    """The estimates from step 5 on come after 15 ms, and the clock does not wait for them."""

    def before(self, key: str, number: int) -> bool:
        if key == "estimate/aoe" and number >= 4:
            self.timers.at(self.clock.now_ns + 15 * MS, self.release_one)
            return False
        return True

    def release_one(self) -> None:
        key, payload = self.held.pop(0)
        super(Simulated, self)._publish(key, payload)


def test_the_controller_uses_the_newest_estimate_that_has_come(tmp_path: Path) -> None:
    given = one_lane(input=FEEDBACK, record="all")
    summary = run(given, tmp_path, network=Slower)
    assert summary.status == "complete"
    packets = recorded(tmp_path, 1, STEPS)
    u, x_hat = packets["control/sent"]["u"][:, 0], packets["estimate/aoe"]["x_hat"][:, 0]
    gain = np.array(FEEDBACK["gain"])
    held = 0
    for k in range(1, STEPS):
        newest = k - 1 if k >= 5 else k  # u_k leaves 10 ms after step k began
        held += newest < k
        assert u[k] == pytest.approx(-gain @ x_hat[newest - 1], rel=1e-12), k
    assert summary.realtime is not None
    assert (summary.realtime.held_controls, summary.realtime.held_steps_max) == (held, 1) == (15, 1)


def test_the_estimator_learns_u_as_it_was_sent(tmp_path: Path) -> None:
    """The closed loop with late estimates is the open loop with the same inputs from a table."""
    run(one_lane(input=FEEDBACK, record="all"), tmp_path / "closed", network=Slower)
    first = recorded(tmp_path / "closed", 1, STEPS)
    u = first["control/sent"]["u"][:, 0].tolist()
    table = {"kind": "table", "values": u}
    run(one_lane(input=table, record="all"), tmp_path / "open", network=Simulated)
    then = recorded(tmp_path / "open", 1, STEPS)
    assert np.array_equal(first["estimate/aoe"]["x_hat"], then["estimate/aoe"]["x_hat"])


def test_real_links_must_leave_time_for_an_estimate(tmp_path: Path) -> None:
    for links, text in (
        ({"observation": {"backend": "relay"}}, "links.observation.deadline: got 10 ms"),
        (
            {"control": {"backend": "relay", "deadline": "4 ms"}, "observation": {"backend": "relay"}},
            "links.control.deadline + links.observation.deadline: got 14 ms",
        ),
    ):
        with pytest.raises(UsageError) as refusal:
            Run(one_lane(links=links), tmp_path).over_zenoh()
        assert str(refusal.value) == (
            f"{text} with clock mode 'real'; allowed: less than clock.deadline, 10 ms, for the loss of a packet is "
            "known at its deadline"
        )
