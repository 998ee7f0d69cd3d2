"""Links through real sockets where the controller keeps real time: every step is accounted for."""

from __future__ import annotations

from pathlib import Path

import pytest

from processes.running import finish, start, summary_of, write_scenario
from processes.test_swaps import TWO, event, once_each

pytestmark = pytest.mark.processes


def test_real_links_in_real_time_and_a_swap(tmp_path: Path) -> None:
    head = 'record = "all"\nclock = { mode = "real", period = "20 ms" }'
    swapped = event(40, "swap", estimator='"aoe"', to='{ kind = "aoe" }', handover='"full"')
    scenario = write_scenario(tmp_path, steps=100, head=head, tail=TWO + swapped)
    text = scenario.read_text()
    for name in ("control", "observation"):
        text = text.replace(f"[links.{name}]", f'[links.{name}]\nbackend = "relay"\ndeadline = "8 ms"')
    scenario.write_text(text)
    code, _, err = finish(start(scenario, tmp_path / "out"))
    assert code == 0, err
    summary = summary_of(tmp_path / "out")
    assert [e["ok"] for e in summary["events"]] == [True]
    assert once_each(tmp_path / "out", "aoe", 100, 1)
    own, twin = (summary["estimators"][name]["squared_error_mean"] for name in ("aoe", "twin"))
    assert own == twin
    for link in ("control", "observation"):
        books = summary["links"][link]
        assert books["sent"] == books["delivered"] + books["dropped"] == 100
        assert 0 < books["real"]["forward_delivered"] < 100
    # what is lost is known 8 ms after it was sent, and no sooner
    stages = summary["realtime"]["stages"]
    assert stages["observation/delivered"]["published"]["max"] > 8000
    assert None not in stages["estimate/aoe"]["published_us"]
