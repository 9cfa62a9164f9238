"""The rows of the paper's table 1, and which of them share a training."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace

from conformodal.datasets import SplitKind
from conformodal.vision import FineTuning

from ..errors import ExperimentError

LARGE, SMALL = 0.8, 0.4
TEST = 0.2
CALIBRATION_SHARE = 0.2  # of the used frames
NETWORKS = ("efficientnet_lite0", "efficientnet_lite1", "efficientnet_lite2")
NOISE = (0.0, 0.05, 0.1, 0.2)
_RESULTS = 9  # of results of tasks; older ones are worked out again


@dataclass(frozen=True)
class Row:
    """One row.

    Attributes
    ----------
    label
        For people.
    used
        Share of all frames for training and calibration together.
    network
        Of the features.
    sigma
        Pixel noise at test time.
    paper_conformal, paper_classical
        The paper's position RMSE, on RGB-D Scenes with EfficientNet b0, b3 and b7; metres.
    """

    label: str
    used: float
    network: str
    sigma: float
    paper_conformal: float
    paper_classical: float


def rows_of(networks: Sequence[str] = NETWORKS) -> tuple[Row, ...]:
    """All rows, with a small, a middle and a large network in the place of the paper's b0, b3 and b7.

    The paper's row "no noise" has the errors of its row of 40 %, so its noise rows are taken to be at 40 %.

    Raises
    ------
    ExperimentError
        If there are not three networks.
    """
    if len(networks) != 3:
        raise ExperimentError(f"table 1 needs a small, a middle and a large network, got {list(networks)}")
    small, middle, large = networks
    return (
        Row("40 % of the data", SMALL, small, 0.0, 0.0534, 0.136),
        Row("80 % of the data", LARGE, small, 0.0, 0.026, 0.078),
        Row("small network (the paper: b0)", LARGE, small, 0.0, 0.029, 0.083),
        Row("middle network (the paper: b3)", LARGE, middle, 0.0, 0.031, 0.077),
        Row("large network (the paper: b7)", LARGE, large, 0.0, 0.028, 0.088),
        Row("no noise", SMALL, small, NOISE[0], 0.050, 0.136),
        Row("pixel noise 0.05", SMALL, small, NOISE[1], 0.055, 0.126),
        Row("pixel noise 0.1", SMALL, small, NOISE[2], 0.073, 0.132),
        Row("pixel noise 0.2", SMALL, small, NOISE[3], 0.099, 0.201),
    )


def task_key(split: SplitKind, seed: int, used: float, network: str) -> str:
    """Name of a task's files."""
    return f"{split}-seed{seed}-{used:g}-{re.sub(r'[^A-Za-z0-9_.-]+', '_', network)}"


@dataclass(frozen=True)
class TrainingTask:
    """One training of everything, tested at every noise that a row asks for.

    Attributes
    ----------
    split, seed
        Of the split; the seed also of training.
    used, network
        See :class:`Row`.
    sigmas
        Pixel noise at test time.
    epochs
        Of every training.
    data
        Digest of the data set.
    fine_tuning
        Settings of fine-tuning, or None for frozen features.
    """

    split: SplitKind
    seed: int
    used: float
    network: str
    sigmas: tuple[float, ...]
    epochs: int
    data: str
    fine_tuning: FineTuning | None = None

    @property
    def key(self) -> str:
        """File name of the result."""
        return task_key(self.split, self.seed, self.used, self.network)

    @property
    def group(self) -> str:
        """Trainings of one split share motions, and many the scene."""
        return f"{self.split}-seed{self.seed}"

    @property
    def settings(self) -> dict[str, object]:
        """All that decides the result."""
        tuning = None if self.fine_tuning is None else asdict(self.fine_tuning)
        own = {"split": str(self.split), "sigmas": list(self.sigmas), "fine_tuning": tuning, "results": _RESULTS}
        return {**vars(self), **own}


def tasks_of(
    rows: Sequence[Row],
    splits: Sequence[SplitKind],
    seeds: Sequence[int],
    epochs: int,
    data: str,
    fine_tuning: FineTuning | None = None,
) -> list[TrainingTask]:
    """The trainings behind all rows, those with the same motions next to each other."""
    trainings = dict.fromkeys((row.used, row.network) for row in rows)
    return [
        TrainingTask(
            split,
            seed,
            used,
            network,
            tuple(dict.fromkeys(r.sigma for r in rows if (r.used, r.network) == (used, network))),
            epochs,
            data,
            None if fine_tuning is None else replace(fine_tuning, seed=seed),
        )
        for split in splits
        for seed in seeds
        for used, network in trainings
    ]
