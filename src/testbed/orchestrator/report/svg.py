"""Matplotlib figures as text that can stand in a page: look, SVG with ids of its own, data URIs."""

from __future__ import annotations

import base64
import io
import re
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, cast

import matplotlib
import numpy as np
from matplotlib.figure import Figure

WIDTH_IN = 7.2
GREY = "#6b6b6b"
# Okabe and Ito's colours, without black and yellow, and three of Tol's.
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#882255", "#999933", "#332288")
MARKERS = ("o", "s", "^", "D", "v", "P", "X", "<", ">", "p", "h")
_LOOK: dict[str, Any] = {
    "svg.fonttype": "path",  # the same on every machine, whatever fonts it has
    "svg.hashsalt": "testbed",
    "font.family": ["STIXGeneral", "DejaVu Sans"],
    "mathtext.fontset": "stix",
    "font.size": 9.0,
    "axes.titlesize": 9.0,
    "axes.linewidth": 0.6,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "axes.formatter.limits": (-3, 5),
    "axes.unicode_minus": True,
    "grid.color": "#e6e6e6",
    "grid.linewidth": 0.5,
    "xtick.direction": "out",
    "xtick.major.width": 0.6,
    "xtick.minor.width": 0.4,
    "ytick.major.width": 0.6,
    "ytick.minor.width": 0.4,
    "legend.frameon": False,
    "legend.fontsize": 8.5,
    "legend.handlelength": 2.6,
    "legend.columnspacing": 1.6,
    "lines.linewidth": 1.3,
    "lines.markersize": 4.0,
    "figure.constrained_layout.use": True,
    "figure.constrained_layout.h_pad": 0.03,
    "figure.constrained_layout.w_pad": 0.03,
    "path.simplify": True,
}


@contextmanager
def look() -> Iterator[None]:
    """Matplotlib's settings for the report; whatever settings the caller has come back afterwards."""
    with matplotlib.rc_context(), np.errstate(over="ignore"):  # tick locators overflow near the largest float
        matplotlib.rcdefaults()
        matplotlib.rcParams.update(cast(Any, _LOOK))
        yield


def colour(index: int) -> str:
    return COLOURS[index % len(COLOURS)]


def marker(index: int) -> str:
    return MARKERS[index % len(MARKERS)]


def svg_text(figure: Figure) -> str:
    """`figure` as an SVG document, the same bytes each time; call it inside `look`."""
    buffer = io.StringIO()
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="Glyph .* missing from font")  # a box stands for it
        figure.savefig(buffer, format="svg", metadata={"Date": None, "Creator": None})
    return buffer.getvalue()


def inline_svg(document: str, prefix: str, label: str) -> str:
    """An SVG document as an element of a page: every id gets `prefix`, so that several fit in one page.

    Args:
        document: what `svg_text` returns.
        prefix: letters, digits and hyphens.
        label: what a screen reader says; no quotes, brackets or ampersands.
    """
    element = document[document.index("<svg") :]
    element = re.sub(r"<metadata>.*?</metadata>", "", element, flags=re.DOTALL)
    element = re.sub(r'(\sid=")', rf"\g<1>{prefix}-", element)
    element = re.sub(r'(href="#)', rf"\g<1>{prefix}-", element)
    element = re.sub(r"(url\(#)", rf"\g<1>{prefix}-", element)
    return element.replace("<svg", f'<svg role="img" aria-label="{label}"', 1).strip()


def data_uri(content: str, media_type: str) -> str:
    """`content` as a `data:` URI."""
    return f"data:{media_type};charset=utf-8;base64,{base64.b64encode(content.encode()).decode('ascii')}"
