"""The streams: their laws, that they are independent of each other, and that no split or order changes a draw."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy import stats

from testbed.numerics.lanes import array_of
from testbed.numerics.streams import TILE, Stream

Array = NDArray[np.float64]
SEEDS = [1, 2, 20_260_101]


def draws(
    law: str, seed: int, purpose: str = "noise", *, width: int = 1, lane: int = 0, lanes: int, steps: int
) -> Array:
    """All draws, of shape (steps, lanes, width)."""
    stream = Stream(seed, "plant", purpose, width=width, lane=lane, lanes=lanes)
    take = stream.uniforms if law == "uniform" else stream.normals
    return np.array([array_of(take(k), lanes) for k in range(steps)])


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("width", [1, 2, 3])
def test_uniforms_are_uniform(seed: int, width: int) -> None:
    sample = draws("uniform", seed, width=width, lanes=500, steps=100)
    assert sample.min() >= 0.0
    assert sample.max() < 1.0
    for i in range(width):
        assert stats.kstest(sample[:, :, i].ravel(), "uniform").pvalue > 1e-3


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("width", [1, 2, 3])
def test_normals_are_normal(seed: int, width: int) -> None:
    sample = draws("normal", seed, width=width, lanes=500, steps=100)
    for i in range(width):
        assert stats.kstest(sample[:, :, i].ravel(), "norm").pvalue > 1e-3
    assert np.abs(sample).max() > 4.0  # the tails are there: P(none beyond 4 of 50,000) = 4 %, and the seeds are fixed


@pytest.mark.parametrize("law", ["uniform", "normal"])
def test_one_lane_along_time_has_the_law_too(law: str) -> None:
    sample = draws(law, 5, lanes=1, steps=20_000).ravel()
    assert stats.kstest(sample, "uniform" if law == "uniform" else "norm").pvalue > 1e-3
    for lag in (1, 2, TILE - 1, TILE, TILE + 1):
        assert abs(np.corrcoef(sample[:-lag], sample[lag:])[0, 1]) < 4.0 / np.sqrt(len(sample))


def uncorrelated(a: Array, b: Array) -> bool:
    return abs(float(np.corrcoef(a.ravel(), b.ravel())[0, 1])) < 4.0 / np.sqrt(a.size)


@pytest.mark.parametrize("law", ["uniform", "normal"])
def test_seeds_components_purposes_and_channels_are_independent(law: str) -> None:
    first = draws(law, 1, "process", width=2, lanes=200, steps=100)
    others = [
        draws(law, 1, "sensor", width=2, lanes=200, steps=100),
        draws(law, 2, "process", width=2, lanes=200, steps=100),
        draws(law, 1, "process", width=2, lane=200, lanes=200, steps=100),
        np.array(
            [array_of(Stream(1, "link", "process", width=2, lane=0, lanes=200).uniforms(k), 200) for k in range(100)]
        ),
    ]
    for other in others:
        assert uncorrelated(first, other)
        assert uncorrelated(first**2, other**2)
    assert uncorrelated(first[:, :, 0], first[:, :, 1])
    assert uncorrelated(first[:, :, 0] ** 2, first[:, :, 1] ** 2)


@pytest.mark.parametrize("law", ["uniform", "normal"])
def test_lanes_and_steps_are_independent(law: str) -> None:
    sample = draws(law, 3, lanes=300, steps=96)[:, :, 0]
    for apart in (1, 2, 7, TILE):
        assert uncorrelated(sample[:, apart:], sample[:, :-apart])
        assert uncorrelated(sample[apart:], sample[:-apart])
        assert uncorrelated(sample[apart:, apart:], sample[:-apart, :-apart])
    assert len(np.unique(sample)) == sample.size


@settings(deadline=None, max_examples=60)
@given(
    law=st.sampled_from(["uniform", "normal"]),
    seed=st.integers(0, 2**63 - 1),
    width=st.integers(1, 5),
    split=st.lists(st.integers(1, 9), min_size=1, max_size=5),
    first=st.sampled_from([0, 1, 255, 10**6]),
)
def test_no_split_of_the_lanes_changes_a_bit(law: str, seed: int, width: int, split: list[int], first: int) -> None:
    steps = TILE + 2
    whole = draws(law, seed, width=width, lane=first, lanes=sum(split), steps=steps)
    lane = 0
    for lanes in split:
        part = draws(law, seed, width=width, lane=first + lane, lanes=lanes, steps=steps)
        np.testing.assert_array_equal(part, whole[:, lane : lane + lanes])
        lane += lanes


@pytest.mark.parametrize("lanes", [16, 17, 64, 100, 257])
def test_wide_blocks_have_the_bits_of_single_lanes(lanes: int) -> None:
    whole = draws("normal", 9, width=3, lanes=lanes, steps=4)
    for lane in (0, 1, lanes // 2, lanes - 1):
        np.testing.assert_array_equal(draws("normal", 9, width=3, lane=lane, lanes=1, steps=4)[:, 0], whole[:, lane])


@settings(deadline=None, max_examples=40)
@given(
    steps=st.lists(st.integers(0, 5 * TILE), min_size=1, max_size=30),
    lanes=st.sampled_from([1, 3]),
    law=st.sampled_from(["uniform", "normal"]),
)
def test_the_order_of_asking_does_not_matter(steps: list[int], lanes: int, law: str) -> None:
    expected = draws(law, 11, width=2, lanes=lanes, steps=5 * TILE + 1)
    stream = Stream(11, "plant", "noise", width=2, lane=0, lanes=lanes)
    take = stream.uniforms if law == "uniform" else stream.normals
    for step in steps:
        np.testing.assert_array_equal(array_of(take(step), lanes), expected[step])


def test_both_laws_may_be_asked_of_one_stream() -> None:
    stream = Stream(11, "plant", "noise", width=2, lane=0, lanes=3)
    for step in (0, 1, 17, 0):
        np.testing.assert_array_equal(
            array_of(stream.uniforms(step), 3), draws("uniform", 11, width=2, lanes=3, steps=18)[step]
        )
        np.testing.assert_array_equal(
            array_of(stream.normals(step), 3), draws("normal", 11, width=2, lanes=3, steps=18)[step]
        )


def test_what_is_returned_may_be_changed() -> None:
    stream = Stream(11, "plant", "noise", width=2, lane=0, lanes=1)
    row = stream.normals(0)
    row[0] = 1e9
    assert stream.normals(0)[0] != 1e9


@given(steps=st.lists(st.integers(0, 2000), min_size=1, max_size=30), width=st.integers(1, 3), lane=st.integers(0, 5))
@settings(deadline=None, max_examples=40)
def test_the_first_number_of_a_lane_is_the_first_of_the_uniforms(steps: list[int], width: int, lane: int) -> None:
    one, other = (Stream(3, "link.test", "loss", width=width, lane=lane, lanes=1) for _ in range(2))
    assert [one.first(step) for step in steps] == [other.uniforms(step)[0] for step in steps]
