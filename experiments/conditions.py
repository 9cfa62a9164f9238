"""The rows of the paper's table 1, and which of them share a training."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from conformodal.core.ranges import as_member
from conformodal.features.settings import TrainingConfig
from conformodal.io import SplitKind
from conformodal.pipeline.config import Method, ModelConfig

from .tasks import ExperimentError

LARGE, SMALL = 0.8, 0.4
TEST = 0.2
CALIBRATION_SHARE = 0.2  # of the used frames
ALPHA = 0.1
NETWORKS = ("efficientnet_lite0", "efficientnet_lite1", "efficientnet_lite2")
NOISE = (0.0, 0.05, 0.1, 0.2)
_RESULTS = 11  # version of the results of tasks; older ones are computed again


@dataclass(frozen=True)
class Row:
    """One row of table 1."""

    label: str  # for people
    used: float  # share of all frames for training and calibration together
    network: str  # of the features
    sigma: float  # pixel noise at test time
    # the paper's position RMSE, on RGB-D Scenes with EfficientNet b0, b3 and b7; metres
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


def task_key(method: Method, split: SplitKind, seed: int, used: float, network: str) -> str:
    """Name of a task's files; those of the paper's method begin with its name."""
    key = f"{split}-seed{seed}-{used:g}-{re.sub(r'[^A-Za-z0-9_.-]+', '_', network)}"
    return f"{method}-{key}" if method is Method.PAPER else key


def run_name(key: str, sigma: float) -> str:
    """Folder of the run of a task at a noise."""
    return f"{key}-noise{sigma:g}"


@dataclass(frozen=True)
class TrainingTask:
    """One training of a system and all its baselines, tested at every noise that a row asks for.

    Attributes
    ----------
    method
        The paper's system, or this project's.
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
    baselines
        Names of the baselines beside this project's system, in the order of ``BASELINES``.
    """

    method: Method
    split: SplitKind
    seed: int
    used: float
    network: str
    sigmas: tuple[float, ...]
    epochs: int
    data: str
    baselines: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        object.__setattr__(self, "method", as_member(self.method, Method, "method", ExperimentError))
        object.__setattr__(self, "split", as_member(self.split, SplitKind, "split", ExperimentError))

    @property
    def key(self) -> str:
        """File name of the result."""
        return task_key(self.method, self.split, self.seed, self.used, self.network)

    @property
    def settings(self) -> dict[str, object]:
        """All that decides the result, as JSON."""
        names = {"method": str(self.method), "split": str(self.split)}
        lists = {"sigmas": list(self.sigmas), "baselines": list(self.baselines)}
        return {**vars(self), **names, **lists, "results": _RESULTS}


def tasks_of(
    rows: Sequence[Row],
    splits: Sequence[SplitKind],
    seeds: Sequence[int],
    epochs: int,
    data: str,
    methods: Sequence[Method] = (Method.PAPER, Method.CONFORMODAL),
    baselines: Sequence[str] = (),
) -> list[TrainingTask]:
    """The trainings behind all rows, those with the same motions next to each other; see :class:`TrainingTask`."""
    trainings = dict.fromkeys((row.used, row.network) for row in rows)
    return [
        TrainingTask(
            method,
            split,
            seed,
            used,
            network,
            tuple(dict.fromkeys(r.sigma for r in rows if (r.used, r.network) == (used, network))),
            epochs,
            data,
            () if method is Method.PAPER else tuple(baselines),
        )
        for method in methods
        for split in splits
        for seed in seeds
        for used, network in trainings
    ]


def config_of(task: TrainingTask) -> ModelConfig:
    """Settings of the model that a task trains."""
    settings: dict[str, Any] = {
        "split": task.split,
        "alpha": ALPHA,
        "test": TEST,
        "calibration": CALIBRATION_SHARE * task.used,
        "used": task.used,
        "network": task.network,
        "seed": task.seed,
        "training": TrainingConfig(epochs=task.epochs, seed=task.seed),
    }
    return ModelConfig.paper(**settings) if task.method is Method.PAPER else ModelConfig(**settings)
