"""The text of a condition in pieces."""

from __future__ import annotations

import re
from string import whitespace
from typing import NamedTuple, NoReturn

from testbed.errors import UsageError
from testbed.scenario.base import shown

TEXT_MAX = 1000
_PIECE = re.compile(
    r"""\s*(?:(?P<number>(?:[0-9]+(?:\.[0-9]*)?|\.[0-9]+)(?:[eE][+-]?[0-9]+)?)
        |(?P<word>[A-Za-z_][A-Za-z0-9_]*)
        |(?P<quoted>"[^"]*"|'[^']*')
        |(?P<sign><=|>=|==|!=|[-<>+*/(),])
        |(?P<end>\Z))""",
    re.ASCII | re.VERBOSE,
)
_NAME = re.compile(r"\s*([A-Za-z0-9_][A-Za-z0-9_-]*)", re.ASCII)
_HINTS = {"=": "==", "&": "and", "|": "or", "!": "not", "≥": ">=", "≤": "<=", "≠": "!=", "^": "*"}


class Piece(NamedTuple):
    """kind: number, word, quoted, sign, name or end; begin: its first character, from 0."""

    kind: str
    text: str
    begin: int


class Pieces:
    """One piece after the other, cut off only when asked for: a name may hold a hyphen, which elsewhere is minus."""

    def __init__(self, text: str) -> None:
        if len(text) > TEXT_MAX:
            raise UsageError(f"got {len(text)} characters; allowed: at most {TEXT_MAX}")
        self._text, self._position = text, 0
        self._next: tuple[Piece, int] | None = None

    @property
    def next(self) -> Piece:
        """The next piece, which stays."""
        if self._next is None:
            match = _PIECE.match(self._text, self._position)
            if match is None or match.lastgroup is None:
                self._unknown()
            kind = match.lastgroup
            self._next = Piece(kind, match[kind], match.start(kind)), match.end()
        return self._next[0]

    def take(self) -> Piece:
        """The next piece, which goes."""
        piece = self.next
        assert self._next is not None
        self._position, self._next = self._next[1], None
        return piece

    def take_name(self) -> Piece:
        """The name of an estimator or a link; a piece of another kind if there is none."""
        match = _NAME.match(self._text, self._position)
        if match is None:
            return self.next
        self._position, self._next = match.end(), None
        return Piece("name", match[1], match.start(1))

    def _unknown(self) -> NoReturn:
        position = self._position
        while self._text[position] in whitespace:  # of ASCII, as in the patterns
            position += 1
        found = self._text[position]
        hint = f"; did you mean {_HINTS[found]!r}?" if found in _HINTS else ""
        allowed = "a closing quote" if found in "\"'" else "a figure, a number, an operator or a parenthesis"
        raise UsageError(f"got {shown(found)} at character {position + 1}; allowed: {allowed}{hint}")
