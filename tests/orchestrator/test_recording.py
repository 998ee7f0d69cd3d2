"""The recording against the summary, by numpy; against the links' traces; and replayed, against itself."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from orchestrator.runs import MARKOV, Recorded, recorded, run, scenario, tables, written
from testbed.channel.trace import sample_trace
from testbed.errors import UsageError
from testbed.estimator.packets import read_packets, replay
from testbed.estimator.registry import create, model_of
from testbed.orchestrator.recording import packets_of_recording, read_recording
from testbed.scenario import Scenario, parse_scenario, to_dict

Floats = NDArray[np.float64]
RunOf = tuple[Scenario, Path, Recorded]

VARIANTS: dict[str, dict[str, Any]] = {
    "all estimators": {},
    "split lanes": {"transport": {"lanes_per_packet": 4}, "lanes": 7},
    "one lane": {"lanes": 1},
    "many lanes": {"lanes": 300, "steps": 10},
    "closed loop": {"input": {"kind": "feedback", "gain": [[0.6, 0.3]]}},
}


@pytest.fixture(scope="module", params=VARIANTS)
def made(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> RunOf:
    given = scenario(**VARIANTS[request.param])
    out = tmp_path_factory.mktemp("run")
    run(given, out)
    return given, out, recorded(out, given.lanes, given.steps)


def assert_means(name: str, figures: dict[str, Any], values: Floats, until: int, scale: Floats | None = None) -> None:
    """Means and standard errors over lanes of `values` (steps, lanes), to 1e-12 of the largest term."""
    values = values[:until]
    lanes = values.shape[1]
    terms = np.abs(values if scale is None else scale[:until]).max(axis=1)
    mean, stderr = figures[f"{name}_mean"], figures[f"{name}_stderr"]
    assert np.all(np.abs(np.array(mean[:until]) - values.mean(axis=1)) <= 1e-12 * terms)
    assert mean[until:] == [None] * (len(mean) - until)
    assert stderr[until:] == [None] * (len(stderr) - until)
    if lanes == 1:
        assert stderr == [None] * len(stderr)
    else:
        expected = values.std(axis=1, ddof=1) / math.sqrt(lanes)
        assert np.all(np.abs(np.array(stderr[:until]) - expected) <= 1e-12 * terms)


def test_figures_of_the_summary_are_those_of_the_recorded_arrays(made: RunOf) -> None:
    given, out, record = made
    summary = written(out)
    x = record["truth"]["x"]
    assert x.shape == (given.steps, given.lanes, 2)
    for spec in given.estimators:
        own, until = summary["estimators"][spec.name], spec.until or given.steps
        x_hat, P = (record[f"estimate/{spec.name}"][name] for name in ("x_hat", "P"))
        e = x - x_hat
        trace, squared = np.trace(P, axis1=2, axis2=3), (e**2).sum(axis=2)
        nees = np.full(squared.shape, np.nan)
        nees[:until] = (e[:until] * np.linalg.solve(P[:until], e[:until, ..., None])[..., 0]).sum(axis=2)
        assert_means("trace_P", own, trace, until)
        assert_means("squared_error", own, squared, until)
        assert_means("nees", own, nees, until, scale=nees * np.linalg.cond(np.nan_to_num(P + np.eye(2))))
        assert_means("excess", own, squared - trace, until, scale=squared + trace)
        assert own["undefined"] == 0


def test_the_recorded_path_is_one_of_the_system(made: RunOf) -> None:
    """x_{k+1} − A x_k − ν B u_k is the process noise and y − C x the sensor noise: of their sizes, and not zero."""
    given, _, record = made
    s = given.system
    x, y, u, nu = (
        record[t][n] for t, n in (("truth", "x"), ("observation/sent", "y"), ("control/sent", "u"), ("truth", "nu"))
    )
    w = x[1:] - x[:-1] @ np.array(s.A).T - nu[1:, :, None] * (u[1:] @ np.array(s.B).T)
    v = y - x @ np.array(s.C).T
    for noise, covariance in ((w, s.Q), (v, s.R)):
        squared = np.einsum("kmi,ij,kmj->km", noise, np.linalg.inv(np.array(covariance)), noise)
        size = noise.shape[2]
        assert abs(squared.mean() - size) < 5.0 * math.sqrt(2.0 * size / squared.size)
        assert squared.max() < 40.0


def test_recorded_fates_are_those_that_the_trace_of_the_link_says(made: RunOf) -> None:
    given, _, record = made
    for link in ("control", "observation", "ack"):
        mask = record[f"{link}/delivered"]["mask"]
        for lane in {0, given.lanes // 2, given.lanes - 1}:
            rows = sample_trace(given, link, given.steps, seed=given.seed, lane=lane).rows  # type: ignore[arg-type]
            assert [delivered is not None for _, _, delivered in rows] == [bool(bit) for bit in mask[:, lane]]


def replayed(given: Scenario, out: Path, name: str, lane: int) -> list[dict[str, Any]]:
    spec = next(spec for spec in given.estimators if spec.name == name)
    model = model_of(given)
    lines = packets_of_recording(out / "recording.mcap", lane, perfect_acks=spec.acks == "perfect")
    estimator = create(spec.kind, model, lanes=1, options=spec.options)
    packets = list(read_packets(lines, model))[: spec.until or given.steps]
    return [json.loads(line) for line in replay(estimator, model, packets, use_acks=spec.acks != "none")]


@pytest.mark.parametrize("name", ["aoe", "aoe-acks", "ff", "kfio", "oe", "oe-acks"])
def test_a_replay_gives_the_estimates_of_the_run(name: str, made: RunOf) -> None:
    given, out, record = made
    own = record[f"estimate/{name}"]
    for lane in {0, given.lanes - 1}:
        lines = replayed(given, out, name, lane)
        until = next(spec.until for spec in given.estimators if spec.name == name) or given.steps
        assert [line["k"] for line in lines] == list(range(1, until + 1))
        for key in ("x_hat", "P"):
            found, expected = np.array([line[key] for line in lines]), own[key][:until, lane]
            if name.startswith("oe"):
                np.testing.assert_allclose(found, expected, rtol=1e-12, atol=1e-12)
            else:
                np.testing.assert_array_equal(found, expected)


def test_lines_hold_what_the_estimators_received(made: RunOf) -> None:
    given, out, record = made
    lane = given.lanes - 1
    for perfect in (False, True):
        lines = [json.loads(s) for s in packets_of_recording(out / "recording.mcap", lane, perfect_acks=perfect)]
        assert [line["k"] for line in lines] == list(range(1, given.steps + 1))
        for i, line in enumerate(lines):
            assert line["u"] == record["control/sent"]["u"][i, lane].tolist()
            arrived = record["observation/delivered"]["mask"][i, lane] == 1
            assert line["y"] == (record["observation/sent"]["y"][i, lane].tolist() if arrived else None)
            known = perfect or record["ack/delivered"]["mask"][i, lane] == 1
            assert line["acks"] == ([[i, int(record["truth"]["nu"][i, lane])]] if known else [])


@pytest.mark.parametrize("variant", ["all estimators", "closed loop"])
@pytest.mark.parametrize("lanes_per_packet", [6, 1, 2])
def test_the_first_lane_alone_is_the_first_of_all(lanes_per_packet: int, variant: str, tmp_path: Path) -> None:
    own = {"transport": {"lanes_per_packet": lanes_per_packet}, **VARIANTS[variant]}
    run(scenario(**own), tmp_path / "all")
    run(scenario(record="first", **own), tmp_path / "first")
    whole, first = recorded(tmp_path / "all", 6, 20), recorded(tmp_path / "first", 1, 20)
    assert whole.keys() == first.keys()
    for topic, arrays in first.items():
        assert arrays.keys() == whole[topic].keys()
        for name, values in arrays.items():
            np.testing.assert_array_equal(values, whole[topic][name][:, :1], err_msg=f"{topic} {name}")
    with pytest.raises(UsageError, match="lane 1 was not recorded"):
        packets_of_recording(tmp_path / "first" / "recording.mcap", 1, perfect_acks=False)
    assert {p.lanes for _, p, _ in read_recording(tmp_path / "first" / "recording.mcap")} == {1}


def test_log_time_is_virtual_time(tmp_path: Path) -> None:
    from mcap.reader import make_reader

    run(scenario(clock={"period": "3 ms"}), tmp_path)
    with (tmp_path / "recording.mcap").open("rb") as file:
        reader = make_reader(file)
        metadata = next(m.metadata for m in reader.iter_metadata() if m.name == "run")
        times = {channel.topic: set() for _, channel, _ in reader.iter_messages()}
        for schema, channel, message in reader.iter_messages():
            assert schema is not None
            assert schema.encoding == "jsonschema"
            assert channel.message_encoding == "ncs1"
            times[channel.topic].add(message.log_time)
    assert parse_scenario(metadata["scenario"]) == scenario(clock={"period": "3 ms"})
    assert times["truth"] == {3_000_000 * k for k in range(1, 21)}
    assert times["control/sent"] == {3_000_000 * k for k in range(20)}


def test_results_say_what_was_run(made: RunOf) -> None:
    given, out, _ = made
    assert parse_scenario((out / "scenario.toml").read_text()) == given
    summary = written(out)
    assert (summary["name"], summary["seed"], summary["steps"], summary["lanes"]) == (
        "test",
        7,
        given.steps,
        given.lanes,
    )


def test_a_recording_of_lost_links_replays(tmp_path: Path) -> None:
    links = {"control": {"loss": {"kind": "bernoulli", "arrival": 0.0}}, "observation": {"loss": MARKOV}}
    given = scenario(links=links, estimators=[{"name": "aoe"}, {"name": "ff"}, {"name": "kfio", "acks": "perfect"}])
    run(given, tmp_path)
    for name in ("aoe", "ff", "kfio"):
        expected = recorded(tmp_path, 6, 20)[f"estimate/{name}"]["x_hat"][:, 3]
        np.testing.assert_array_equal([line["x_hat"] for line in replayed(given, tmp_path, name, 3)], expected)


def damaged(whole: bytes, packets_end: int) -> list[tuple[bytes, bool]]:
    """Damaged copies, and whether the damage is where the packets are."""
    rng = np.random.default_rng(1)
    others = [b"", b"not a recording", whole[::-1], *(whole[: int(n)] for n in rng.integers(0, len(whole), size=60))]
    flips = []
    for place in rng.integers(len(whole), size=300):
        copy = bytearray(whole)
        copy[place] ^= 1 << int(rng.integers(8))
        flips.append((bytes(copy), bool(place < packets_end)))
    return [*((other, True) for other in others), *flips]


def end_of_packets(file: Path) -> int:
    from mcap.reader import SeekingReader

    with file.open("rb") as stream:
        summary = SeekingReader(stream).get_summary()
    assert summary is not None
    return max(chunk.chunk_start_offset + chunk.chunk_length for chunk in summary.chunk_indexes)


def test_damage_is_refused_in_one_line_or_harmless(tmp_path: Path) -> None:
    small = tables(steps=3, lanes=2, estimators=[{"name": "aoe"}])
    run(parse_scenario(small), tmp_path / "out")
    file, whole = tmp_path / "damaged.mcap", tmp_path / "out" / "recording.mcap"
    expected = packets_of_recording(whole, 0, perfect_acks=False)
    refused = 0
    for data, in_packets in damaged(whole.read_bytes(), end_of_packets(whole)):
        file.write_bytes(data)
        try:
            assert packets_of_recording(file, 0, perfect_acks=False) == expected or not in_packets
        except UsageError as error:
            refused += 1
            text = str(error)
            if len(text.splitlines()) != 1 or not text.startswith(str(file)):
                pytest.fail(f"not one line that names the file: {text!r}")
    assert refused > 60


def test_other_files_in_mcap_are_not_recordings(tmp_path: Path) -> None:
    from mcap.writer import Writer

    with (tmp_path / "other.mcap").open("wb") as file:
        writer = Writer(file)
        writer.start()
        schema = writer.register_schema("observation", "jsonschema", b"{}")
        channel = writer.register_channel("topic", "json", schema)
        writer.add_message(channel, 0, b"[]", 0)
        writer.finish()
    with pytest.raises(UsageError, match="not the recording of a run"):
        packets_of_recording(tmp_path / "other.mcap", 0, perfect_acks=False)


@pytest.mark.parametrize("kind", ["observation", "surprise", "clock"])
@pytest.mark.parametrize(
    "message", [b"", b"[]", b"NCS1\x08\0\0\0[]      ", b"NCS1\x08\0\0\0{}      ", b"NCS1" + b"\xff" * 20]
)
def test_a_recording_of_something_else_is_refused(kind: str, message: bytes, tmp_path: Path) -> None:
    from mcap.writer import Writer

    from testbed.scenario import to_toml

    with (tmp_path / "odd.mcap").open("wb") as file:
        writer = Writer(file)
        writer.start()
        writer.add_metadata("run", {"scenario": to_toml(scenario())})
        channel = writer.register_channel("topic", "ncs1", writer.register_schema(kind, "jsonschema", b"{}"))
        writer.add_message(channel, 0, message, 0)
        writer.finish()
    with pytest.raises(UsageError, match="not a whole recording"):
        packets_of_recording(tmp_path / "odd.mcap", 0, perfect_acks=False)


def test_the_resolved_scenario_is_that_of_the_recording(made: RunOf) -> None:
    given, out, _ = made
    assert to_dict(parse_scenario((out / "scenario.toml").read_text())) == to_dict(given)
