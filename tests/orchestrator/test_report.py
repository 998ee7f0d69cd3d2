import base64
import csv
import io
import math
import re
import xml.etree.ElementTree as ET
from html.parser import HTMLParser

import matplotlib
import numpy as np
import pytest

from orchestrator.fabricated_summary import SCENARIO_TOML, estimator, fabricate
from testbed.orchestrator.report import write_report
from testbed.orchestrator.report.figures.covariance import choose_scale
from testbed.orchestrator.report.figures.ratio import ratios
from testbed.orchestrator.summary import BoundFigures, LinkFigures

pytestmark = pytest.mark.filterwarnings("error")

RNG = np.random.default_rng(3)
FLAT = np.full(40, 30.0)
K = np.arange(1, 41)


class Page(HTMLParser):
    """Ids, links, elements and text of a page; balanced elements are checked."""

    VOID = frozenset({"meta", "br", "link", "img", "input", "hr"})

    def __init__(self, html: str) -> None:
        super().__init__()
        self.html = html
        self.ids: list[str] = []
        self.references: list[str] = []
        self.elements: list[str] = []
        self.words: list[str] = []
        self._open: list[str] = []
        self.feed(html)
        self.close()
        assert not self._open

    def handle_starttag(self, tag, attrs):
        self.elements.append(tag)
        if tag not in self.VOID:
            self._open.append(tag)
        for key, value in attrs:
            if key == "id":
                self.ids.append(value)
            elif key in ("href", "src", "xlink:href", "action", "srcset"):
                self.references.append(value)

    def handle_startendtag(self, tag, attrs):
        self.handle_starttag(tag, attrs)
        if tag not in self.VOID:
            self._open.pop()

    def handle_endtag(self, tag):
        assert self._open.pop() == tag

    def handle_data(self, data):
        if "style" not in self._open:
            self.words.append(data)

    @property
    def text(self) -> str:
        return " ".join(" ".join(self.words).split())

    def download(self, name: str) -> str:
        uri = re.search(rf'download="{re.escape(name)}" href="([^"]+)"', self.html)[1]
        return base64.b64decode(uri.split(",")[1]).decode()


@pytest.fixture
def page(tmp_path):
    def render(summary, scenario_toml=SCENARIO_TOML):
        write_report(tmp_path / "report.html", summary, scenario_toml)
        return Page((tmp_path / "report.html").read_text(encoding="utf-8"))

    return render


def diverging():
    wild = estimator(
        RNG, FLAT, kind="rseio", squared_error_mean=FLAT * 10.0**K, excess_mean=FLAT * 10.0**K, nees_mean=2 * 10.0**K
    )
    return fabricate(
        steps=40,
        estimators={"tame": estimator(RNG, FLAT), "wild": wild},
        bounds={"lower_mean": FLAT, "lower_stderr": 0 * FLAT, "upper_mean": FLAT * 1e3**K, "upper_stderr": [None] * 40},
    )


def without_data():
    nothing = [None] * 40
    return fabricate(
        steps=40,
        bounds=None,
        estimators={
            "x": estimator(RNG, FLAT * np.nan, nees_mean=nothing, excess_mean=nothing, squared_error_mean=nothing)
        },
    )


def costs(step, stderr, **overrides):
    """The cost of a run; two thirds are the state's."""
    total = math.inf if np.max(step, initial=0.0) > 1e300 else float(np.sum(step))
    series = {"step_mean": step, "state_mean": step * (2 / 3), "input_mean": step / 3}
    series |= {name.replace("mean", "stderr"): stderr for name in list(series)}
    own = {"total": total, "total_stderr": None, "a_step": total / len(step)} if len(step) else {}
    return {"cost": {**series, **own, **overrides}, "controller": CONTROLLER}


CONTROLLER = {
    "kind": "lqg",
    "estimator": "aoe",
    "gain": [[1.25, -0.5]],
    "statement": "optimal: <b>so</b>",
    "counters": {"saturated": 1234},
}
CASES = {
    "cost": lambda: fabricate(
        steps=40, **costs(FLAT, FLAT / 9, total_stderr=9.0, a_step_stderr=0.225, total_interval_95=[1182.4, 1217.6])
    ),
    "cost of one lane": lambda: fabricate(steps=40, lanes=1, **costs(FLAT, np.full(40, np.nan))),
    "cost of one step": lambda: fabricate(steps=1, **costs(FLAT[:1], FLAT[:1])),
    "cost that grows": lambda: fabricate(steps=40, **costs(10.0**K, 9.0 * 10.0**K)),
    "cost beyond numbers": lambda: fabricate(steps=40, **costs(1e308 * np.where(K < 20, 0.01, 1), np.full(40, 1e308))),
    "cost of nothing": lambda: fabricate(steps=40, **costs(0 * FLAT, 0 * FLAT)),
    "cost without figures": lambda: fabricate(steps=40, **costs(np.nan * FLAT, np.nan * FLAT)),
    "cost of no step": lambda: fabricate(
        steps=5, completed_steps=0, status="failed", bounds=None, estimators={}, **costs(FLAT[:0], FLAT[:0])
    ),
    "ordinary": lambda: fabricate(steps=40),
    "one lane": lambda: fabricate(steps=40, lanes=1),
    "one step": lambda: fabricate(steps=1),
    "one step, one lane": lambda: fabricate(steps=1, lanes=1),
    "two steps": lambda: fabricate(steps=2),
    "huge": lambda: fabricate(steps=40, scale=1e298),
    "largest": lambda: fabricate(steps=40, scale=1e306),
    "tiny": lambda: fabricate(steps=40, scale=1e-300),
    "covariance zero": lambda: fabricate(steps=40, estimators={"z": estimator(RNG, 0 * FLAT)}, bounds=None),
    "diverging": diverging,
    "without data": without_data,
    "no estimators": lambda: fabricate(steps=40, estimators={}, bounds=None),
    "no links, no bounds": lambda: fabricate(steps=40, links={}, bounds=None, checks=(), versions={}),
    "link not used": lambda: fabricate(steps=40, links={"ack": LinkFigures(sent=0, delivered=0, dropped=0)}),
    "no step": lambda: fabricate(
        steps=5, completed_steps=0, status="failed", reason="no answer", estimators={}, bounds=None, links={}
    ),
    "no step of an estimator": lambda: fabricate(
        steps=5, completed_steps=0, status="failed", estimators={"a": estimator(RNG, FLAT[:0])}, bounds=None
    ),
    "many estimators": lambda: fabricate(steps=40, estimators={f"e{i}": estimator(RNG, FLAT) for i in range(13)}),
    "many steps": lambda: fabricate(
        steps=5000, lanes=2, estimators={"a": estimator(RNG, np.full(5000, 2.0), 2)}, bounds=None
    ),
}


@pytest.mark.parametrize("case", CASES)
def test_the_page_stands_alone_whatever_the_figures(page, case):
    made = page(CASES[case]())
    assert len(made.ids) == len(set(made.ids))
    for reference in made.references:
        assert reference.startswith("data:") or (reference[0] == "#" and reference[1:] in made.ids)
    assert "script" not in made.elements
    for target in re.findall(r"url\(#([^)]+)\)", made.html):
        assert target in made.ids
    assert not re.search(r"[\"'>\s](nan|inf|None)[\"'<\s]", made.html)
    assert "@import" not in made.html


def test_figures_and_tables_of_an_ordinary_run(page):
    made = page(fabricate(steps=40))
    for number in range(1, 5):
        assert f"Figure {number}." in made.text
    assert made.elements.count("svg") == 4
    for word in ("lmmse-naive", "late_acks", "finite variance", "sent = delivered", "zenoh 1.10.0", "mean_burst"):
        assert word in made.text or word in made.download("links.csv")
    assert 'kind = "markov", recovery = 0.5' in made.text


def test_a_check_that_is_not_ok_stands_before_the_figures(page):
    made = page(fabricate(steps=4))
    assert made.text.index("Not ok: finite variance.") < made.text.index("Estimators")


def test_a_run_that_did_not_complete_says_so_first(page):
    made = page(fabricate(steps=100, completed_steps=4, status="failed", reason="plant: gone", **short(4)))
    assert "This run failed after 4 of 100 steps. plant: gone" in made.text
    assert made.text.index("failed after") < made.text.index("Not ok")
    interrupted = page(fabricate(steps=4, status="interrupted"))
    assert "was interrupted after 4 of 4 steps. No reason was recorded." in interrupted.text


def short(steps):
    full = fabricate(steps=steps)
    return {"estimators": full.estimators, "bounds": full.bounds}


def test_names_are_text_and_never_markup(page):
    nasty = '<script>alert(1)</script> & "q" $\\frac{1}$ _ 日本 {{ 7*7 }} \x07'
    made = page(
        fabricate(
            steps=4,
            name=nasty,
            estimators={nasty: estimator(RNG, FLAT[:4]), "_hidden": estimator(RNG, FLAT[:4], kind="<i>")},
            links={nasty: LinkFigures(sent=4, delivered=4, dropped=0, loss_rate=0.0)},
            checks=({"name": "<b>", "ok": False, "text": nasty},),
            rejected={"<role>": {"<reason>": 3}},
            versions={"<p>": "<v>"},
            status="failed",
            reason=nasty,
        ),
        SCENARIO_TOML + "# </pre><script>\n",
    )
    assert "script" not in made.elements
    assert made.text.count("<script>alert(1)</script>") >= 5
    assert "{{ 7*7 }}" in made.text
    assert "<role> <reason> 3" in made.text


def test_downloads_hold_the_figures_and_their_numbers(page):
    summary = fabricate(steps=40)
    made = page(summary)
    for name in ("covariance", "nees", "excess", "links"):
        assert ET.fromstring(made.download(f"{name}.svg")).tag.endswith("svg")
    rows = list(csv.DictReader(io.StringIO(made.download("covariance.csv"))))
    assert [int(row["k"]) for row in rows] == list(range(1, 41))
    aoe, oe = summary.estimators["aoe"], summary.estimators["oe"]
    assert tuple(float(row["trace_P_mean:aoe"]) for row in rows) == aoe.trace_P_mean
    assert [row["trace_P_mean:oe"] for row in rows[20:]] == [""] * 20
    assert oe.until == 20
    assert float(rows[3]["upper_mean"]) == summary.bounds.upper_mean[3]
    first = next(csv.DictReader(io.StringIO(made.download("excess.csv"))))
    assert float(first["relative_excess_mean:aoe"]) == aoe.excess_mean[0] / aoe.trace_P_mean[0]
    links = list(csv.DictReader(io.StringIO(made.download("links.csv"))))
    assert [row["link"] for row in links] == ["link:control", "link:observation"]
    assert float(links[1]["model_loss_rate"]) == pytest.approx(0.375)


def test_the_same_summary_gives_the_same_bytes(page):
    assert page(fabricate(steps=10)).html == page(fabricate(steps=10)).html


def test_settings_of_matplotlib_neither_matter_nor_change(page):
    plain = page(fabricate(steps=10)).html
    with matplotlib.rc_context({"axes.grid": False, "font.size": 30, "lines.linewidth": 9}):
        assert page(fabricate(steps=10)).html == plain
        assert matplotlib.rcParams["font.size"] == 30


def test_the_cost_stands_in_the_page_with_its_interval(page):
    made = page(CASES["cost"]())
    assert "Controller: lqg , on the estimate of aoe." in made.text
    assert "[[1.250, -0.5000]]" in made.text
    assert "For its cost it is optimal: <b>so</b>." in made.text
    assert "Saturated: 1 234 of 10 240 lane-steps." in made.text
    assert "30.00 ± 0.23 a step, 1200.0 ± 9.0 in all (95 %: 1182 to 1218)" in made.text
    rows = list(csv.DictReader(io.StringIO(made.download("cost.csv"))))
    assert [float(row["step_mean"]) for row in rows] == [30.0] * 40
    assert [float(row["input_stderr"]) for row in rows] == list(FLAT / 9)
    assert "cost-figure" in made.ids
    assert "cost-figure" not in page(fabricate(steps=40)).ids


def test_captions_say_what_holds(page):
    one = page(fabricate(steps=40, lanes=1)).text
    assert "with one lane there are no standard errors" in one
    assert "± 1.96" not in one
    assert "pseudo-covariance" in page(diverging()).text
    undefined = {"a": estimator(RNG, FLAT, undefined=7)}
    assert "not defined for 7 lane-steps" in page(fabricate(steps=40, estimators=undefined)).text
    assert "x has no finite tr P at 40 of its steps." in page(without_data()).text
    no_upper = {"lower_mean": FLAT, "lower_stderr": FLAT, "upper_reason": "u has no bound"}
    assert "There is no upper bound: u has no bound." in page(fabricate(steps=40, bounds=no_upper)).text
    assert "One step in 3 is drawn" in page(CASES["many steps"]()).text


def scale_with(trace, upper=None, errors=None):
    steps = len(trace)
    bounds = {"lower_mean": trace, "lower_stderr": [None] * steps, "upper_mean": upper}
    figures = estimator(
        RNG, np.asarray(trace, dtype=float), 10**9, squared_error_mean=trace if errors is None else errors
    )
    return choose_scale(fabricate(steps=steps, estimators={"a": figures}, bounds=bounds))


def test_the_axis_is_logarithmic_beyond_two_decades():
    assert not scale_with([1.0, 50.0]).log
    assert scale_with([1.0, 150.0]).log
    assert scale_with([1.0, 1.0], errors=[1.0, 500.0]).log
    assert not scale_with([1.0, 1.0], errors=[1e-9, 1.0]).log


def test_an_upper_bound_that_dwarfs_the_rest_leaves_the_axes():
    near = scale_with([40.0, 50.0], upper=[60.0, 60.0])
    assert not near.upper_leaves
    assert near.high > 60
    far = scale_with([40.0, 50.0], upper=[60.0, 1e6])
    assert far.upper_leaves
    assert far.high < 100


def test_ratios_to_the_lower_bound():
    summary = fabricate(steps=2, estimators={"a": estimator(RNG, FLAT[:2], trace_P_mean=[3.0, 3.0])})
    bounds = {"lower_mean": [2.0, 0.0], "lower_stderr": [None, None]}
    (ratio,) = ratios(summary.model_copy(update={"bounds": BoundFigures.model_validate(bounds)}))
    assert ratio[0] == 1.5
    assert np.isnan(ratio[1])
    assert ratios(summary.model_copy(update={"bounds": None})) == []
    assert ratios(fabricate(steps=2, estimators={})) == []
