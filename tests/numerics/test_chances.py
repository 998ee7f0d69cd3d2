"""A chance picked by what was before: by its definition, and to the same bits with and without compiled loops."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from testbed.channel.loss import Chain, LossProcess
from testbed.numerics.chances import happens
from testbed.numerics.kernels import SWITCH, available
from testbed.numerics.streams import Stream

EDGE = [0, 1, 2**52, 2**53 - 1]


@settings(deadline=None, max_examples=60)
@given(st.integers(0, 2**32 - 1), st.sampled_from([1, 5, 3000]), st.floats(0, 1), st.floats(0, 1))
def test_is_the_comparison_lane_by_lane(seed: int, lanes: int, no: float, yes: float) -> None:
    rng = np.random.default_rng(seed)
    words = rng.integers(0, 2**53, lanes, dtype=np.uint64)
    words[: len(EDGE)] = EDGE[:lanes]
    before = rng.random(lanes) < 0.5
    expected = [int(w) / 2**53 < (yes if b else no) for w, b in zip(words, before, strict=True)]
    np.testing.assert_array_equal(happens(words, before, no, yes), expected)


def test_words_are_what_uniforms_are_made_of() -> None:
    for lanes in (1, 3, 100):
        stream = Stream(3, "link.control", "loss", width=2, lane=5, lanes=lanes)
        for step in (0, 7, 16, 300, 2):
            words = stream.words(step)
            for row, uniform in zip(words, stream.uniforms(step), strict=True):
                np.testing.assert_array_equal(row * 2.0**-53, np.atleast_1d(uniform))


@pytest.mark.skipif(not available(), reason="needs numba, the extra `fast`")
def test_losses_have_the_same_bits_compiled_and_not(monkeypatch: pytest.MonkeyPatch) -> None:
    def drawn() -> np.ndarray:
        stream = Stream(9, "link.observation", "loss", width=1, lane=0, lanes=2048)
        process = LossProcess(Chain.markov(0.3, 0.2), stream, 2048)
        return np.array([process.next(k) for k in range(40)])

    compiled = drawn()
    monkeypatch.setenv(SWITCH, "off")
    np.testing.assert_array_equal(drawn(), compiled)
