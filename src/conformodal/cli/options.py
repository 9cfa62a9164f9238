"""Which values options may have: checked for all commands in one place, before anything is read."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import typer

from conformodal.conformal import ConformodalError
from conformodal.conformal.checks import as_alpha


class OptionError(ConformodalError):
    """An option that cannot be used, or contradicts another."""


@dataclass(frozen=True)
class _Range:
    """Numbers from `low` to `high`; the ends count unless they are open."""

    low: float
    high: float = math.inf
    low_open: bool = False
    high_open: bool = False

    def holds(self, value: float) -> bool:
        """Whether a finite number lies in it."""
        above = value > self.low if self.low_open else value >= self.low
        below = value < self.high if self.high_open else value <= self.high
        return math.isfinite(value) and above and below

    def __str__(self) -> str:
        low = f"{'more than' if self.low_open else 'at least'} {self.low:,g}"
        if math.isinf(self.high):
            return f"a finite number, {low}"
        return f"{low} and {'less than' if self.high_open else 'at most'} {_plain(self.high)}"


def _plain(value: float) -> str:
    return str(int(value)) if value == int(value) else f"{value:g}"


RERUN_SUFFIX, ROS_SUFFIX = ".rrd", ".mcap"
_SHARE = _Range(0, 1, low_open=True, high_open=True)
_MANY = 1_000_000
# Ranges by the name of the parameter, the same for every command.
RANGES = {
    "bins": _Range(1, 10_000),
    "sigma": _Range(0, 10_000),
    "epochs": _Range(1, _MANY),
    "dropout": _Range(0, 0.95),
    "test": _SHARE,
    "calibration_share": _SHARE,
    "used": _Range(0, 1, low_open=True),
    "novelty_level": _Range(0, 1, high_open=True),
    "seed": _Range(0, 2**31 - 1),
    "seeds": _Range(1, 10_000),
    "first_seed": _Range(0, 2**30),
    "workers": _Range(1, 1024),
    "limit": _Range(1),
    "match_every": _Range(1),
    "metres_per_radian": _Range(0, low_open=True),
}
# Options that have an effect only where another option has a certain value.
_NEED: dict[str, tuple[str, Any, str]] = {
    "address": ("engine", lambda value: str(value) == "ray", "--engine ray"),
    "workers": ("engine", lambda value: str(value) == "local", "--engine local"),
}


def was_given(context: typer.Context, name: str) -> bool:
    """Whether a user has given an option, even with its default value."""
    source = context.get_parameter_source(name)
    return source is not None and not source.name.startswith("DEFAULT")


def check_options(given: Mapping[str, Any], defaults: Mapping[str, Any]) -> None:
    """Refuse numbers out of range, and options that contradict each other.

    Parameters
    ----------
    given
        A command's parameters by name.
    defaults
        Their default values.

    Raises
    ------
    OptionError
        Naming the option, what was found and what was expected.
    """
    for name, allowed in RANGES.items():
        value = given.get(name)
        if value is not None and not allowed.holds(value):
            raise OptionError(f"{_flag(name)}: {name} must be {allowed}, got {value}")
    if given.get("alpha") is not None:
        try:
            as_alpha(given["alpha"])
        except ConformodalError as exc:  # knows what may have been meant
            raise OptionError(f"--alpha: {exc}") from exc
    _check_shares(given)
    for name, (other, fits, said) in _NEED.items():
        if name in given and other in given and given[name] != defaults.get(name) and not fits(given[other]):
            raise OptionError(f"{_flag(name)} needs {said}, got {_flag(other)} {given[other]}")
    for name in ("cache", "save"):
        place = given.get(name)
        if isinstance(place, Path):
            _check_place(name, place)
    _check_recording(given.get("save"), given)


def _check_shares(given: Mapping[str, Any]) -> None:
    if "calibration_share" not in given or "test" not in given:
        return
    test, calibration, used = given["test"], given["calibration_share"], given.get("used")
    if test + calibration >= 1:
        raise OptionError(
            f"--test and --calibration-share must leave something to train on, got {test} and {calibration}"
        )
    if used is not None and not calibration < used <= 1 - test + 1e-9:
        raise OptionError(
            f"--used must be more than --calibration-share ({calibration}) and at most what --test ({test}) leaves, "
            f"got {used}"
        )


def _check_place(name: str, place: Path) -> None:
    try:
        wrong = place.is_dir() if name == "save" else place.exists() and not place.is_dir()
    except (OSError, ValueError) as exc:
        raise OptionError(f"{_flag(name)}: {str(place)!r} cannot be used: {exc}") from exc
    if wrong:
        raise OptionError(f"{_flag(name)} must be a {'file' if name == 'save' else 'folder'}, {place} is none")
    suffixes = (RERUN_SUFFIX, ROS_SUFFIX)
    if name == "save" and place.suffix.lower() not in suffixes:  # it would be written over, whatever it is
        raise OptionError(f"{_flag(name)} must name a file {' or '.join(suffixes)}, got {str(place)!r}")


def _check_recording(save: Path | None, given: Mapping[str, Any]) -> None:
    """Refuse a recording over its own source, and images that no file is for."""
    if save is not None and "source" in given and save.absolute() == Path(given["source"]).absolute():
        raise OptionError(f"--save would write over the source, {save}; name another file")
    if given.get("save_images") and (save is None or save.suffix.lower() != ROS_SUFFIX):
        raise OptionError(f"--save-images needs --save FILE{ROS_SUFFIX}, got {save or 'no --save'}")


def _flag(name: str) -> str:
    return "--" + name.replace("_", "-")
