"""Which values options may have: checked for all commands in one place, before anything is read."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import typer

from conformodal.conformal import ConformodalError
from conformodal.conformal.checks import as_alpha
from conformodal.core.ranges import RANGES, Range, check_shares


class OptionError(ConformodalError):
    """An option that cannot be used, or contradicts another."""


RERUN_SUFFIX, ROS_SUFFIX = ".rrd", ".mcap"
# Options that have another name than the setting whose range they share.
SETTINGS = {
    "bins": "n_bins",
    "sigma": "sigma_bins",
    "calibration": "",  # what is calibrated on
    "calibration_share": "calibration",
}


def range_of(option: str) -> Range | None:
    """The range of an option by the name of its parameter, if it has one."""
    return RANGES.get(SETTINGS.get(option, option))


def was_given(context: typer.Context, name: str) -> bool:
    """Whether a user has given an option, even with its default value."""
    source = context.get_parameter_source(name)
    return source is not None and not source.name.startswith("DEFAULT")


def share_of(test: str) -> float | None:
    """The number that ``--test`` is; None where it names a data set."""
    try:
        return float(test)
    except ValueError:
        return None


def check_options(given: Mapping[str, Any], defaults: Mapping[str, Any]) -> None:
    """Refuse a command's options that are out of range or contradict each other; an OptionError names the option."""
    if isinstance(given.get("test"), str):
        given = {**given, "test": share_of(given["test"])}
    for name, value in given.items():
        allowed = range_of(name)
        if allowed is not None and value is not None and not allowed.holds(value):
            raise OptionError(f"{_flag(name)} must be {allowed}, got {value}")
    if given.get("alpha") is not None:
        try:
            as_alpha(given["alpha"])
        except ConformodalError as exc:  # knows what may have been meant
            raise OptionError(f"--alpha: {exc}") from exc
    if "calibration_share" in given and given.get("test") is not None:
        names = "--test", "--calibration-share", "--used"
        check_shares(given["test"], given["calibration_share"], given.get("used"), OptionError, names)
    engine = str(given.get("engine", "ray"))
    if engine != "ray" and given.get("address") != defaults.get("address"):
        raise OptionError(f"--address needs --engine ray, got --engine {engine}")
    for name in ("cache", "save"):
        place = given.get(name)
        if isinstance(place, Path):
            _check_place(name, place)
    _check_recording(given.get("save"), given)


def _check_place(name: str, place: Path) -> None:
    try:
        wrong = place.is_dir() if name == "save" else place.exists() and not place.is_dir()
    except (OSError, ValueError) as exc:
        raise OptionError(f"{_flag(name)}: {str(place)!r} cannot be used: {exc}") from exc
    if wrong:
        raise OptionError(f"{_flag(name)} must be a {'file' if name == 'save' else 'folder'}, {place} is not one")
    suffixes = (RERUN_SUFFIX, ROS_SUFFIX)
    if name == "save" and place.suffix.lower() not in suffixes:  # it would be written over, whatever it is
        raise OptionError(f"{_flag(name)} must name a file {' or '.join(suffixes)}, got {str(place)!r}")


def _check_recording(save: Path | None, given: Mapping[str, Any]) -> None:
    """Refuse a recording over its own source, and images that no file is for."""
    sources = [Path(source).absolute() for source in given.get("sources", ())]
    if save is not None and save.absolute() in sources:
        raise OptionError(f"--save would write over the source, {save}; name another file")
    if given.get("save_images") and (save is None or save.suffix.lower() != ROS_SUFFIX):
        raise OptionError(f"--save-images needs --save FILE{ROS_SUFFIX}, got {save or 'no --save'}")


def _flag(name: str) -> str:
    return "--" + name.replace("_", "-")
