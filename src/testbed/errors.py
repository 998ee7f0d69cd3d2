"""The errors of the testbed, each with the exit code of the command line, and the helpers of their texts."""

import difflib
from collections.abc import Iterable
from typing import ClassVar


class TestbedError(Exception):
    """Base of every error that is meant for the user. Its text is one line."""

    __test__ = False  # pytest would otherwise take the name for a class of tests
    exit_code: ClassVar[int] = 1


class UsageError(TestbedError):
    """Wrong input: the text says where, what was given and what is allowed."""

    exit_code: ClassVar[int] = 2


class RunFailed(TestbedError):
    """A run that started and did not end well."""

    exit_code: ClassVar[int] = 1


def nearest(word: str, allowed: Iterable[str]) -> str | None:
    """The allowed word most like `word`, or the only one that begins with it; None if there is no such word.

    Upper and lower case are the same.
    """
    lower = word.lower()
    by_lower = {candidate.lower(): candidate for candidate in allowed}
    close = difflib.get_close_matches(lower, by_lower, n=1, cutoff=0.6)
    if not close and len(lower) > 1:
        longer = [candidate for candidate in by_lower if candidate.startswith(lower)]
        close = longer if len(longer) == 1 else []
    return by_lower[close[0]] if close else None


def did_you_mean(word: str, allowed: Iterable[str]) -> str:
    """A tail for an error text: "; did you mean 'lanes'?", or nothing if no allowed word is like `word`."""
    match = nearest(word, allowed)
    return f"; did you mean {match!r}?" if match is not None else ""
