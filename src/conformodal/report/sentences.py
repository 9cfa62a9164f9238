"""What to see in a frame, and in a whole run, in words."""

from __future__ import annotations

from dataclasses import dataclass
from math import floor, log10, sqrt

from conformodal.core.words import counted, listed, noun_for

from .page_frames import PageFrame, lengths

_UNUSABLE = ("lost", "too_few_corners", "inconsistent")  # motion


def describe_frame(frame: PageFrame) -> str:
    """A frame in words: the region first, then the chosen pose."""
    parts = [_describe_region(frame), _describe_pose(frame)]
    if frame.place_p is not None and not frame.reliable and not frame.unknown:
        parts.append(f"When the frame came, its most probable place had a probability of {frame.place_p:.3f}.")
    if frame.motion in _UNUSABLE and not frame.unknown:
        parts.append(f"The motion since the frame before is not reliable ({frame.motion.replace('_', ' ')}).")
    return " ".join(part for part in parts if part)


def _describe_region(frame: PageFrame) -> str:
    if frame.unknown:
        p = "" if frame.known_p is None else f" (p = {frame.known_p:.2g})"
        return f"Unknown place{p}: the image shows no known place, so the region is unbounded."
    if frame.whole:
        return "The region is unbounded: every position is possible."
    if not frame.n_places:
        return "The region is empty: no place is likely enough."
    places = "one place" if frame.n_places == 1 else f"{frame.n_places} places"
    if frame.unbounded:
        return f"The region names {places}, without bounds along {listed(frame.unbounded)}."
    largest = describe_size([max(lengths(parts)) for parts in frame.intervals])
    return f"The region names {places}, {'' if frame.n_places == 1 else 'the largest '}{largest}."


def _describe_pose(frame: PageFrame) -> str:
    """Where the chosen pose is: in the region or not, and how far from the truth."""
    bounded = not frame.whole and frame.n_places > 0
    inside = bounded and frame.holds(frame.position_xyz)
    if frame.truth_xyz is None or frame.error_m is None or frame.error_deg is None:
        if not bounded:
            return ""
        its = ("in it", "outside it") if frame.n_places == 1 else ("in one of them", "in none of them")
        return f"The chosen pose lies {its[0] if inside else its[1]}."
    subject = "The chosen pose is"
    if bounded and frame.n_places > 1:
        subject = "The path chooses one of them," if inside else "The chosen pose lies in none of them,"
    far = f"{describe_length(frame.error_m)} and {frame.error_deg:.2f} degrees from the truth"
    held = "lies in the region" if frame.holds(frame.truth_xyz) else "lies outside the region"
    return f"{subject} {far}{f'; the true position {held}' if bounded else ''}."


@dataclass
class RunStatistics:
    """Counts over all frames of a run, also those that the page does not show."""

    n: int = 0
    n_one: int = 0
    n_several: int = 0
    n_whole: int = 0
    n_unknown: int = 0
    n_true: int = 0
    n_bounded: int = 0
    n_held: int = 0
    most_places: int = 0
    squares: float = 0.0

    def add(self, frame: PageFrame) -> None:
        """Count a frame."""
        self.n += 1
        self.n_unknown += frame.unknown
        self.n_whole += frame.whole
        if not frame.whole:
            self.n_one += frame.n_places == 1
            self.n_several += frame.n_places > 1
            self.most_places = max(self.most_places, frame.n_places)
        if frame.truth_xyz is not None and frame.error_m is not None:
            self.n_true += 1
            self.n_bounded += not frame.unbounded
            self.n_held += not frame.unbounded and frame.holds(frame.truth_xyz)
            self.squares += frame.error_m**2


def describe_run(statistics: RunStatistics, online_rmse_m: float | None = None) -> str:
    """The whole run in words; `online_rmse_m` is given if the answer is not the online one."""
    if statistics.n < 2:
        return _describe_one(statistics) if statistics.n else "No frame was answered."
    regions = []
    if statistics.n_one:
        regions.append(f"names one place in {statistics.n_one}")
    if statistics.n_several:
        regions.append(f"names several in {statistics.n_several} (at most {statistics.most_places})")
    if statistics.n_whole:
        regions.append(f"is unbounded in {statistics.n_whole}{_why_whole(statistics)}")
    empty = statistics.n - statistics.n_one - statistics.n_several - statistics.n_whole
    if empty:
        regions.append(f"is empty in {empty}")
    text = f"Of {counted(statistics.n, 'frame')}, the region {listed(regions)}."
    if statistics.n_true:
        rmse = describe_length(sqrt(statistics.squares / statistics.n_true))
        if statistics.n_bounded:
            bounded = counted(statistics.n_bounded, "bounded region")
            text += (
                f" Of {bounded}, {statistics.n_held} {noun_for(statistics.n_held, 'holds', 'hold')} the true position."
            )
        if online_rmse_m is None:
            return f"{text} The chosen path is {rmse} from the truth (RMSE)."
        text += (
            f" Poses are {describe_length(online_rmse_m)} from the truth when their frames come (RMSE); with "
            f"hindsight, as shown here, {rmse}."
        )
    return text


def _describe_one(statistics: RunStatistics) -> str:
    """Of a run of one frame, where counts of frames say nothing."""
    region = f"names {counted(statistics.most_places, 'place')}" if statistics.most_places else "is empty"
    if statistics.n_whole:
        region = f"is unbounded{_why_whole(statistics)}"
    text = f"One frame was answered: its region {region}."
    if statistics.n_true:
        if statistics.n_bounded:
            text += f" It {'holds' if statistics.n_held else 'does not hold'} the true position."
        text += f" The chosen pose is {describe_length(sqrt(statistics.squares))} from the truth."
    return text


def _why_whole(statistics: RunStatistics) -> str:
    """How many of the frames whose region is unbounded show no known place."""
    n = statistics.n_unknown
    if not n:
        return ""
    who = f"{n} of them" if n < statistics.n_whole else noun_for(n, "it", "they")
    return f" ({who} {noun_for(n, 'shows', 'show')} no known place)"


def describe_length(metres: float) -> str:
    """A length in the unit that suits it."""
    unit, factor = _unit(metres)
    return f"{_number(metres * factor, 3 if unit == 'm' else 2)} {unit}"


def describe_size(metres: list[float]) -> str:
    """Lengths along several axes, in one unit."""
    unit, factor = _unit(max(metres))
    return f"{' by '.join(_number(m * factor, 2) for m in metres)} {unit}"


def _unit(metres: float) -> tuple[str, float]:
    if metres >= 1:
        return "m", 1.0
    return ("cm", 100.0) if metres >= 0.01 else ("mm", 1000.0)


def _number(value: float, digits: int) -> str:
    """A number with its significant digits and without a power of ten, which is hard to read and to listen to."""
    if value <= 0:
        return "0"
    return f"{value:.{max(0, digits - 1 - floor(log10(value)))}f}"
