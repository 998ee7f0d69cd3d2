import json
import math

import jsonschema
import numpy as np
import pytest
from pydantic import ValidationError

from orchestrator.fabricated_summary import estimator, fabricate
from testbed.errors import UsageError
from testbed.orchestrator.summary import Summary, Timing, Transitions, read_summary, summary_json_schema, write_summary


def test_reads_back_what_it_wrote(tmp_path):
    for summary in (fabricate(), fabricate(lanes=1), fabricate(steps=1, bounds=None, estimators={}, links={})):
        write_summary(tmp_path / "summary.json", summary)
        assert read_summary(tmp_path / "summary.json") == summary
    assert [path.name for path in tmp_path.iterdir()] == ["summary.json"]


def test_json_has_the_keys_of_the_contract(tmp_path):
    write_summary(tmp_path / "summary.json", fabricate(steps=3))
    document = json.loads((tmp_path / "summary.json").read_text())
    assert document["version"] == 1
    assert set(document["links"]["control"]["transitions"]) == {"00", "01", "10", "11"}
    assert len(document["estimators"]["aoe"]["trace_P_mean"]) == 3
    assert document["estimators"]["aoe"]["until"] is None
    jsonschema.Draft202012Validator.check_schema(summary_json_schema())
    jsonschema.validate(document, summary_json_schema())


def test_floats_keep_their_digits(tmp_path):
    timing = Timing(wall_s=0.1 + 0.2, startup_s=1e300, steps_per_s=5e-324, lane_steps_per_s=math.pi)
    write_summary(tmp_path / "summary.json", fabricate(steps=1, timing=timing))
    assert read_summary(tmp_path / "summary.json").timing == timing


def test_what_is_not_finite_becomes_null(tmp_path):
    trace = np.array([1.0, np.nan, np.inf])
    summary = fabricate(
        steps=3, estimators={"a": estimator(np.random.default_rng(1), trace)}, timing=Timing(wall_s=np.nan)
    )
    assert summary.estimators["a"].trace_P_mean[1:] == (None, None)
    assert summary.timing.wall_s is None
    write_summary(tmp_path / "summary.json", summary)
    text = (tmp_path / "summary.json").read_text()
    assert "NaN" not in text
    assert "Infinity" not in text


def test_lists_must_be_as_long_as_the_completed_steps():
    with pytest.raises(ValidationError, match=r"estimators\.oe\.trace_P_mean has 100 entries for 99 completed steps"):
        fabricate(completed_steps=99)
    bounds = {"lower_mean": [1.0], "lower_stderr": [None, None]}
    with pytest.raises(ValidationError, match=r"bounds\.lower_mean has 1 entries for 2"):
        fabricate(steps=2, bounds=bounds)


def test_unknown_keys_and_changes_are_refused():
    with pytest.raises(ValidationError, match="surprise"):
        fabricate(surprise=1)
    with pytest.raises(ValidationError, match="frozen"):
        fabricate(steps=1).name = "other"
    with pytest.raises(ValidationError, match="02"):
        Transitions.model_validate({"02": 1})


@pytest.mark.parametrize(
    ("content", "told"), [('{"version": 2}', "version: Input should be 1"), ("{", "EOF"), ("[]", "an object")]
)
def test_a_file_that_is_no_summary_is_refused(tmp_path, content, told):
    (tmp_path / "summary.json").write_text(content)
    with pytest.raises(UsageError, match=rf"summary\.json: not a summary: .*{told}") as error:
        read_summary(tmp_path / "summary.json")
    assert "\n" not in str(error.value)


def test_a_series_must_hold_numbers():
    with pytest.raises(ValidationError):
        Summary.model_validate(
            {**fabricate(steps=1).model_dump(), "bounds": {"lower_mean": ["x"], "lower_stderr": "y"}}
        )
