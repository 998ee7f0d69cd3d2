"""Controllers of somebody's own: found, made with checked options, and examined before and while a run goes."""

from __future__ import annotations

from importlib.metadata import EntryPoint
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from control.making import STATES_SHAPE, closed, made
from testbed.control import registry
from testbed.control.registry import check, checked_step
from testbed.errors import UsageError

MODULE = '''
import numpy as np


class Half:
    """u = −scale x̂."""

    def __init__(self, model, lanes, scale: float = 0.5):
        self.scale, self.first = scale, 0

    def begin_at(self, lane):
        self.first = lane

    def step(self, k, x_hat, P):
        return -self.scale * x_hat


class Broken(Half):
    def step(self, k, x_hat, P):
        return {0: x_hat[0], 1: x_hat * np.nan, 2: "none"}[self.scale]


class Raises(Half):
    def step(self, k, x_hat, P):
        raise ValueError("no\\nidea")


class Unmade(Half):
    def __init__(self, model, lanes):
        raise RuntimeError("not today")


class NoStep:
    def __init__(self, model, lanes):
        pass


number = 3
'''


@pytest.fixture
def own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    """The name of a module in the working folder."""
    name = f"own_{tmp_path.name.replace('-', '_')}"
    (tmp_path / f"{name}.py").write_text(MODULE)
    monkeypatch.chdir(tmp_path)
    return name


def test_a_class_of_a_module_in_the_working_folder(own: str) -> None:
    controller: Any = made({"kind": "python", "controller": f"{own}:Half", "options": {"scale": 0.25}}, lanes=3)
    x_hat = np.random.default_rng(0).normal(size=STATES_SHAPE)
    np.testing.assert_array_equal(controller.step(0, x_hat, np.zeros((3, 2, 2))), -0.25 * x_hat)
    assert controller.first == 0


def test_one_that_is_registered(own: str, monkeypatch: pytest.MonkeyPatch) -> None:
    point = EntryPoint("halving", f"{own}:Half", registry.GROUP)
    monkeypatch.syspath_prepend(str(Path.cwd()))

    def found(group: str, name: str | None = None) -> list[EntryPoint]:
        assert group == registry.GROUP
        return [point] if name in (None, "halving") else []

    monkeypatch.setattr(registry, "entry_points", found)
    check(closed({"kind": "python", "controller": "halving"}))
    with pytest.raises(UsageError) as refusal:
        check(closed({"kind": "python", "controller": "halfing"}))
    expected = "input: unknown controller 'halfing'; allowed: MODULE:CLASS, halving; did you mean 'halving'?"
    assert str(refusal.value) == expected


@pytest.mark.parametrize(
    ("name", "options", "expected"),
    [
        ("Half", {"scal": 1.0}, "unknown option 'scal'; allowed: scale; did you mean 'scale'?"),
        ("Half", {"scale": "big"}, "scale: got 'big'; input should be a valid number"),
        ("Haf", {}, "has no 'Haf'; did you mean 'Half'?"),
        ("number", {}, "is a int; allowed: what is called with (model, lanes)"),
        ("NoStep", {}, "has no method 'step'; needed: step(k, x_hat, P)"),
        ("Unmade", {}, "cannot be made: RuntimeError: not today"),
        ("Raises", {}, "input: the controller failed at step 0: ValueError: no idea"),
        ("Broken", {"scale": 0.0}, "input: the controller returned the shape (2,) at step 0; allowed: (1, 2)"),
        ("Broken", {"scale": 1.0}, "input: the controller returned a value that is not finite at step 0"),
        ("Broken", {"scale": 2.0}, "input: the controller failed at step 0: ValueError: could not convert"),
    ],
)
def test_what_is_wrong_with_it_is_said_before_the_run(own: str, name: str, options: Any, expected: str) -> None:
    with pytest.raises(UsageError) as refusal:
        check(closed({"kind": "python", "controller": f"{own}:{name}", "options": options}))
    assert expected in str(refusal.value)
    assert str(refusal.value).startswith("input: ")
    assert len(str(refusal.value).splitlines()) == 1


def test_a_module_that_is_not_there(own: str) -> None:
    with pytest.raises(UsageError, match=f"input: {own}x:Half: no module '{own}x'"):
        check(closed({"kind": "python", "controller": f"{own}x:Half"}))


def test_integers_are_numbers(own: str) -> None:
    class Whole:
        def step(self, k: int, x_hat: Any, P: Any) -> Any:
            return [[1, 2]]

    u = checked_step(Whole(), 0, np.zeros((1, 2)), np.zeros((1, 2, 2)), 2)
    assert u.dtype == np.float64
