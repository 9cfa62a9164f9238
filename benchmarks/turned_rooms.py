"""What relative rotations are worth where limits on speed allow either of two rooms that look the same.

python benchmarks/turned_rooms.py [--seeds 10 11 12 13 14]

Results of a seed are cached in results/turned_rooms.
"""

from __future__ import annotations

import tempfile
from dataclasses import replace
from itertools import product
from pathlib import Path

import numpy as np
from common import (
    RESULTS,
    cached_json,
    filtered_path,
    mean_interval,
    parser_with_seeds,
    rmse,
    without_limits,
    without_rotations,
    write_table,
)
from turned_rooms_world import ROOM_X, TurnedRooms, visiting_path

from conformodal.cli.demo import ALPHA, TRAINING
from conformodal.corridor import write_flight
from conformodal.corridor.render import Renderer
from conformodal.features.extract import FeatureCache
from conformodal.geometry import Trajectory, angle_between_quats
from conformodal.io import Recording, read_recording
from conformodal.localizer.observations import MotionPrior, Observations, PosePath
from conformodal.localizer.smoother import image_hypotheses, smooth
from conformodal.pipeline.config import ModelConfig
from conformodal.pipeline.estimator import VisualOdometry
from conformodal.pipeline.model import PoseModel
from conformodal.pipeline.train import prepare_training_data, train_model

N_VISITS = 12
EVERY = {"0.2 s": 2, "1 s": 10, "3 s": 30}
SWITCH = ("yes", "")

# by interval, limits, rotation and reasoner: share in the wrong room, rmse_m, rmse_deg
Numbers = dict[str, list[float]]


def learn(folder: Path, seed: int) -> tuple[PoseModel, Recording]:
    """A model trained on one flight, and another flight to answer."""
    renderer = Renderer(TurnedRooms(seed))
    for k, part in enumerate(("train", "test")):
        poses = visiting_path(N_VISITS, 2 * seed + k).poses_se3
        write_flight(folder / part / "seq-01", renderer, poses, noise_seed=(2 * seed + k) * 1_000_003)
    cache = FeatureCache(folder / "cache")
    config = ModelConfig(alpha=ALPHA, seed=seed, sources=("head", "neighbours"), training=replace(TRAINING, seed=seed))
    model = train_model(prepare_training_data(read_recording(folder / "train"), config, cache), config)
    return model, read_recording(folder / "test")


def errors(path: PosePath, truth: Trajectory) -> list[float]:
    """Share of the frames in rooms whose answer is on the other side; root mean square errors of all frames."""
    off = np.linalg.norm(path.positions_xyz - truth.positions_xyz, axis=1)
    angle = angle_between_quats(path.orientations_quat_wxyz, truth.orientations_quat_wxyz)
    room = np.abs(truth.positions_xyz[:, 0]) > ROOM_X
    wrong = path.positions_xyz[room, 0] * truth.positions_xyz[room, 0] < 0
    return [float(wrong.mean()), rmse(off), float(np.degrees(rmse(angle)))]


def observe(seed: int) -> tuple[MotionPrior, dict[str, tuple[Observations, Trajectory]]]:
    """What reasoning is given, and the truth, for every interval between answered frames."""
    observed = {}
    with tempfile.TemporaryDirectory() as scratch:
        model, sequence = learn(Path(scratch), seed)
        for name, every in EVERY.items():
            run = VisualOdometry(model).process(sequence, np.arange(0, len(sequence), every))
            observed[name] = run.observations(np.arange(len(run.frames))), sequence.require_truth()[run.frames]
    return model.prior, observed


def measure(prior: MotionPrior, observed: dict[str, tuple[Observations, Trajectory]]) -> Numbers:
    """Errors of all reasoners with limits and rotations on and off."""
    numbers: Numbers = {}
    for (interval, (whole, truth)), limits, rotation in product(observed.items(), SWITCH, SWITCH):
        used = whole if rotation else without_rotations(whole)
        limited = prior if limits else without_limits(prior)
        hindsight = filtered_path(used, limited)
        paths = {
            "hindsight": hindsight,
            "smoothed": smooth(image_hypotheses(hindsight, used, limited), used, limited),
            "online": filtered_path(used, limited, hindsight=False),
        }
        for reasoner, path in paths.items():
            numbers[", ".join((interval, limits, rotation, reasoner))] = errors(path, truth)
    return numbers


def main() -> None:
    seeds = parser_with_seeds(__doc__).parse_args().seeds
    results: list[Numbers] = []
    for seed in seeds:
        file = RESULTS / "turned_rooms" / f"{seed}.json"
        results.append(cached_json(file, lambda seed=seed: measure(*observe(seed))))
    rows = []
    for setting in results[0]:
        columns = zip(*(numbers[setting] for numbers in results), strict=True)
        cells = [mean_interval(list(column), digits) for column, digits in zip(columns, (3, 2, 1), strict=True)]
        rows.append([*setting.split(", "), *cells])
    header = ["a frame every", "limits", "rotation", "reasoner", "wrong room", "rmse_m", "rmse_deg"]
    notes = (
        f"Rooms that are one another's half-turn (docs/corridor.md). Trained on a flight of {N_VISITS} visits, another "
        f"one answered, its frames followed at 10 per second; mean and 95 % interval over seeds {seeds}. Limits: on "
        "speed and turning. Without limits and rotations every frame is answered alone. No landmarks. Submaps where "
        "rotations are used. Wrong room: share of the frames in rooms."
    )
    title = "What relative motion is worth between rooms that are one another's half-turn"
    command = f"python benchmarks/turned_rooms.py --seeds {' '.join(map(str, seeds))}"
    write_table("turned_rooms", title, command, header, rows, notes)


if __name__ == "__main__":
    main()
