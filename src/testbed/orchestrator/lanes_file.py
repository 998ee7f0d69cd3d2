"""``lanes.npz``: the figures of each lane, so that another run can be compared lane by lane.

A NumPy archive of ``version``, ``ends`` (W,) and an array ESTIMATOR/FIGURE of shape (V, lanes), V ≤ W, for each
estimator and figure; a figure of the run as a whole is an array FIGURE. Row w is the mean over the steps
ends[w − 1] + 1 … ends[w]; V of them are whole.
"""

from __future__ import annotations

import os
import zipfile
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from testbed.errors import UsageError
from testbed.numerics.lanes import Floats

NAME = "lanes.npz"
VERSION = 1


@dataclass(frozen=True)
class LaneFigures:
    """ends: (W,) last step of each window; figures: by estimator and figure, (V, lanes); whole: those of the run."""

    ends: NDArray[np.int64]
    figures: dict[str, dict[str, Floats]]
    whole: dict[str, Floats] = field(default_factory=dict)

    @property
    def all(self) -> list[Floats]:
        """Every array of figures."""
        return [*self.whole.values(), *(values for of in self.figures.values() for values in of.values())]


def write_lanes(path: Path, lanes: LaneFigures) -> None:
    """Write the file; it appears whole or not at all, with the same bytes for the same figures.

    Raises OSError where it cannot be written.
    """
    arrays: dict[str, Any] = {**lanes.whole} | {
        f"{name}/{figure}": values for name, figures in lanes.figures.items() for figure, values in figures.items()
    }
    partial = path.with_name(path.name + ".partial")
    with partial.open("wb") as file:
        np.savez(file, version=np.array(VERSION), ends=lanes.ends, **arrays)
    os.replace(partial, path)


def read_lanes(path: Path) -> LaneFigures:
    """Read what ``write_lanes`` wrote. Raises UsageError where the file is absent or something else."""
    figures: dict[str, dict[str, Floats]] = {}
    whole: dict[str, Floats] = {}
    try:
        with np.load(path, allow_pickle=False) as archive:
            if int(archive["version"]) != VERSION:
                raise UsageError(f"{path}: version {archive['version']}; allowed: {VERSION}, of this testbed")
            ends = np.asarray(archive["ends"], dtype=np.int64)
            for key in sorted({*archive.files} - {"version", "ends"}, key=archive.files.index):
                name, slash, figure = key.partition("/")
                if slash:
                    figures.setdefault(name, {})[figure] = _checked(archive[key], ends)
                else:
                    whole[key] = _checked(archive[key], ends)
    except FileNotFoundError:
        raise UsageError(f"{path}: no such file; runs of older versions have none: run the scenario again") from None
    except OSError as error:
        raise UsageError(f"cannot read {path}: {(error.strerror or str(error)).lower()}") from None
    except (ValueError, KeyError, TypeError, AttributeError, EOFError, zipfile.BadZipFile):
        raise UsageError(f"{path}: not the figures of the lanes of a run") from None
    found = LaneFigures(ends, figures, whole)
    if len({values.shape[1] for values in found.all}) > 1:
        raise UsageError(f"{path}: not the figures of the lanes of a run")
    return found


def _checked(values: NDArray[np.float64], ends: NDArray[np.int64]) -> Floats:
    if values.dtype != np.float64 or values.ndim != 2 or len(values) > len(ends):
        raise ValueError
    return values
