"""``testbed link report``: the tables, the JSON, the page, and errors in one line."""

from __future__ import annotations

import json
import re
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import pytest

from cli.commands import Command, testbed, write
from testbed.channel.capture.imported import rows_of
from testbed.channel.pipeline import Pipeline
from testbed.scenario import load_scenario
from testbed.scenario.trace_file import write_rows

__all__ = ["testbed"]

MS = 10**6
LINK: dict[str, Any] = {
    "loss": {"kind": "gilbert-elliott", "to_bad": 0.05, "to_good": 0.3, "loss_good": 0.02, "loss_bad": 0.8},
    "delay": {"kind": "log-normal", "median": "20 ms", "sigma": 0.5, "minimum": "5 ms"},
    "duplicate": {"chance": 0.02, "after": "1 ms"},
}

NO_LAW = "delays have no law to compare with: "


def sampled(folder: Path, link: dict[str, Any], packets: int = 4000) -> dict[str, int]:
    """s.toml, and t.csv of what its link makes of packets of 64 bytes every 10 ms; the link's books."""
    scenario = load_scenario(write(folder / "s.toml", links={"observation": link}))
    pipeline = Pipeline(scenario.links.observation, 3, "link.observation")
    arrivals = [[copy.at_ns for copy in pipeline.send(64, k * 10 * MS)] for k in range(packets)]
    write_rows(folder / "t.csv", rows_of([k * 10 * MS for k in range(packets)], arrivals))
    return pipeline.books.as_counters()


class Tags(HTMLParser):
    """What a page opens and does not close, and what it loads."""

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.sources: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        if tag not in ("meta", "br"):
            self.open.append(tag)
        self.sources += [value or "" for name, value in attrs if name in ("src", "href", "xlink:href")]

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.sources += [value or "" for name, value in attrs if name in ("src", "href", "xlink:href")]

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag


def test_beside_the_scenario(testbed: Command, tmp_path: Path) -> None:
    books = sampled(tmp_path, LINK)
    arguments = ("link", "report", "t.csv", "--scenario", "s.toml", "--link", "observation")
    given = testbed(*arguments, "--json", "--out", "r.html")
    assert (given.code, given.err) == (0, "")
    figures = json.loads(given.out)
    assert (figures["packets"], figures["lost"]) == (books["sent"], books["dropped"])
    assert figures["copies"] == books["duplicated"]
    model = figures["model"]
    assert model["name"] == "gilbert-elliott, of the scenario"
    assert model["expected"][0] < figures["loss_rate"] < model["expected"][1]
    assert model["goodness"]["p_value"] > 1e-4
    for quantile, width in zip(figures["delays"], (0.03, 0.03, 0.1, 0.4), strict=True):
        assert quantile["value"] == pytest.approx(quantile["theory"], rel=width)
    assert figures["notes"] == []

    shown = testbed(*arguments)
    assert (shown.code, shown.err) == (0, "")
    lines = shown.out.splitlines()
    assert lines[0] == f"t.csv: 4000 packets, {books['dropped']} lost, {books['duplicated']} copies"
    for text in (
        f"{figures['loss_rate']:.4g}",
        f"{model['loss_rate']:.4g}",
        f"{figures['delays'][0]['value'] / MS:.4g}",
    ):
        assert text in shown.out
    order = figures["reordering"]
    assert f"{order['reordered']} of {order['arrived']}, share {order['ratio']:.4g}" in shown.out
    assert all(len(line) <= 80 for line in lines)

    page = (tmp_path / "r.html").read_text()
    tags = Tags()
    tags.feed(page)
    assert tags.open == []
    assert all(source.startswith(("data:", "#")) for source in tags.sources)
    assert len(re.findall("<figure ", page)) == 4
    assert [int(n) for n in re.findall(r"<b>Figure (\d)\.</b>", page)] == [1, 2, 3, 4]
    assert f"{model['goodness']['chi2']:#.4g}" in page


def test_beside_the_model_that_fits_best(testbed: Command, tmp_path: Path) -> None:
    sampled(tmp_path, LINK)
    figures = json.loads(testbed("link", "report", "t.csv", "--json").out)
    fitted = json.loads(testbed("link", "fit", "t.csv", "--json").out)
    best = next(model for model in fitted["models"] if model["kind"] == fitted["chosen"])
    assert figures["model"]["name"] == f"{best['kind']}, fitted"
    assert figures["model"]["expected"] is None
    assert figures["model"]["loss_rate"] == pytest.approx(best["loss"]["value"], rel=1e-4)
    assert figures["model"]["goodness"]["degrees"] == best["goodness"]["degrees"]
    assert figures["model"]["goodness"]["chi2"] == pytest.approx(best["goodness"]["chi2"], rel=1e-3)
    assert figures["notes"] == [best["toml"]]
    assert figures["delays"][0]["theory"] is None


@pytest.mark.parametrize(
    ("link", "notes", "theory"),
    [
        ({**LINK, "clock": "time", "slot": "20 ms"}, ["losses have no law to compare with: their chain"], False),
        ({**LINK, "rate": {"bits_per_second": 1e6}}, [NO_LAW + "the queue adds"], False),
        (
            {**LINK, "rate": {"bits_per_second": 1e6, "queue_packets": 9}},
            ["the queue of the link may", NO_LAW],
            False,
        ),
        (
            {**LINK, "reorder": {"chance": 0.1, "by": "5 ms"}},
            [NO_LAW + "some packets"],
            False,
        ),
        (
            {**LINK, "delay": {**LINK["delay"], "in_order": True}},
            [NO_LAW + "packets wait"],
            False,
        ),
        ({**LINK, "delay": {"kind": "constant", "by": "3 ms"}}, [], True),
        ({**LINK, "transport": {"kind": "udp"}}, ["no law to compare with: what carries the messages"], False),
        ({**LINK, "corrupt": {"chance": 0.1}}, ["packets with a bit flipped are lost besides"], True),
        ({**LINK, "loss": {"kind": "scripted", "lost": [3, 7]}}, ["losses have no law to compare with: they"], False),
    ],
)
def test_what_has_no_law_is_said(
    testbed: Command, tmp_path: Path, link: dict[str, Any], notes: list[str], theory: bool
) -> None:
    sampled(tmp_path, link, 500)
    given = testbed("link", "report", "t.csv", "--scenario", "s.toml", "--link", "observation", "--json")
    figures = json.loads(given.out)
    assert len(figures["notes"]) == len(notes)
    assert all(text.startswith(note) for text, note in zip(figures["notes"], notes, strict=True))
    assert (figures["model"] is None) == ("slot" in link or "transport" in link or link["loss"]["kind"] == "scripted")
    assert (figures["delays"][0]["theory"] is not None) == theory


@pytest.mark.parametrize("fates", [".", "x", "." * 50, "x" * 50, ".x" * 40])
def test_traces_at_the_edge(testbed: Command, tmp_path: Path, fates: str) -> None:
    made = [f"{k},{k},{'' if fate == 'x' else k}" for k, fate in enumerate(fates)]
    (tmp_path / "t.csv").write_text("\n".join(["seq,sent_ns,delivered_ns", *made]) + "\n")
    given = testbed("link", "report", "t.csv", "--out", "r.html")
    assert (given.code, given.err) == (0, "")
    assert given.out.startswith(f"t.csv: {len(fates)} packets, {fates.count('x')} lost\n")
    assert "no delays: " in given.out
    assert ("can be fitted" in given.out) == (fates != ".x" * 40)
    assert given.out.endswith("page: r.html\n")
    json.loads(testbed("link", "report", "t.csv", "--json").out)


@pytest.mark.parametrize(
    ("arguments", "error"),
    [
        (
            ("t.csv", "--scenario", "s.toml"),
            "testbed: --scenario, --link: got one of them; allowed: both, or nei",
        ),
        (("t.csv", "--scenario", "s.toml", "--link", "ak"), "testbed: --link ak: no such link; allowed: control,"),
        (("none.csv",), "testbed: cannot read none.csv: no such file or directory\n"),
        (("empty.csv",), "testbed: empty.csv: got no packet; allowed: one or more\n"),
        (("far.csv",), "testbed: far.csv: got times more than 2^63 ns apart; allowed: less\n"),
        (("t.csv", "--out", "no/r.html"), "testbed: cannot write no/r.html: no such file or directory\n"),
    ],
)
def test_wrong_input_is_one_line(testbed: Command, tmp_path: Path, arguments: tuple[str, ...], error: str) -> None:
    sampled(tmp_path, LINK, 100)
    (tmp_path / "empty.csv").write_text("seq,sent_ns,delivered_ns\n")
    (tmp_path / "far.csv").write_text(f"seq,sent_ns,delivered_ns\n0,0,1\n1,{10**19},{10**19}\n")
    refused = testbed("link", "report", *arguments)
    assert (refused.code, refused.out) == (2, "")
    assert refused.err.startswith(error)
    assert refused.err.count("\n") == 1
