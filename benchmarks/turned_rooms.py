"""What relative rotations are worth where limits on speed allow either of two rooms that look the same.

python benchmarks/turned_rooms.py [--seeds 10 11 12 13 14]

Results of a seed are cached in results/turned_rooms.
"""

from __future__ import annotations

import argparse
import tempfile
from dataclasses import replace
from itertools import product
from pathlib import Path

import numpy as np
from common import RESULTS, SEEDS, cached_json, mean_interval, table_lines, without_limits, without_rotation, write_page
from turned_rooms_world import ROOM_X, TurnedRooms, visiting_path

from conformodal.cli.demo import ALPHA, TRAINING
from conformodal.corridor.render import Renderer
from conformodal.corridor.writer import write_flight
from conformodal.features.extract import FeatureCache
from conformodal.geometry import Trajectory, angle_between_quats
from conformodal.io import Recording, read_sevenscenes
from conformodal.localizer.candidates import Candidates
from conformodal.localizer.filter import filter_posteriors, hindsight_posteriors
from conformodal.localizer.observations import Observations, PosePath
from conformodal.localizer.places import choose_places, own_hypotheses
from conformodal.localizer.prior import MotionPrior
from conformodal.localizer.smoother import smooth
from conformodal.pipeline.config import ModelConfig
from conformodal.pipeline.estimator import VisualOdometry
from conformodal.pipeline.model import PoseModel
from conformodal.pipeline.train import prepare_training_data, train_model

N_VISITS = 12
EVERY = {"0.2 s": 2, "1 s": 10, "3 s": 30}
NEAR_M, NEAR_RAD = 0.5, np.radians(30)
LEAST_MASS = 1e-6  # of a pose without any candidate nearby: what the filter keeps hypotheses down to

# by setting and reasoner: share in the wrong room, rmse_m, rmse_deg; by interval: image evidence for the true side
Numbers = dict[str, list[float]]


def learn(folder: Path, seed: int) -> tuple[PoseModel, Recording, FeatureCache]:
    """A model trained on one flight, and another flight to answer."""
    renderer = Renderer(TurnedRooms(seed))
    for k, part in enumerate(("train", "test")):
        poses = visiting_path(N_VISITS, 2 * seed + k).poses_se3
        write_flight(folder / part / "seq-01", renderer, poses, noise_seed=(2 * seed + k) * 1_000_003)
    cache = FeatureCache(folder / "cache")
    sources, training = ("head",), replace(TRAINING, seed=seed)
    config = ModelConfig(alpha=ALPHA, seed=seed, sources=sources, training=training)
    model = train_model(prepare_training_data(read_sevenscenes(folder / "train"), config, cache), config)
    return model, read_sevenscenes(folder / "test"), cache


def errors(path: PosePath, truth: Trajectory) -> list[float]:
    """Share of the frames in rooms whose answer is on the other side; root mean square errors of all frames."""
    off = np.linalg.norm(path.positions_xyz - truth.positions_xyz, axis=1)
    angle = angle_between_quats(path.orientations_quat_wxyz, truth.orientations_quat_wxyz)
    room = np.abs(truth.positions_xyz[:, 0]) > ROOM_X
    wrong = path.positions_xyz[room, 0] * truth.positions_xyz[room, 0] < 0
    return [float(wrong.mean()), float(np.sqrt(np.mean(off**2))), float(np.degrees(np.sqrt(np.mean(angle**2))))]


def evidence(seen: Observations, truth: Trajectory) -> list[float]:
    """Nats by which images speak for the true pose and against its half-turn.

    Returns
    -------
    list of float
        Sum over frames in the lobby, sum over frames in rooms, the largest sum of either sign that frames in rooms
        would have if all their preferences agreed, and the correlation of neighbouring frames' preferences in rooms.
    """
    quats = truth.orientations_quat_wxyz
    turned_xyz = truth.positions_xyz * [-1, -1, 1]
    turned_quats = np.stack([-quats[:, 3], -quats[:, 2], quats[:, 1], quats[:, 0]], axis=1)  # (0, 0, 0, 1) times q
    prefers = np.empty(len(truth))
    for i, its in enumerate(seen.candidates):
        mass = np.exp(its.log_mass - its.log_mass.max())
        mass /= mass.sum()

        def near(xyz: np.ndarray, quat: np.ndarray, its: Candidates = its, mass: np.ndarray = mass) -> float:
            angle = angle_between_quats(its.orientations_quat_wxyz, np.broadcast_to(quat, (len(mass), 4)))
            there = (np.linalg.norm(its.positions_xyz - xyz, axis=1) < NEAR_M) & (angle < NEAR_RAD)
            return max(float(mass[there].sum()), LEAST_MASS)

        prefers[i] = np.log(near(truth.positions_xyz[i], quats[i]) / near(turned_xyz[i], turned_quats[i]))
    room = np.abs(truth.positions_xyz[:, 0]) > ROOM_X
    both = room[1:] & room[:-1]
    alike = np.corrcoef(prefers[1:][both], prefers[:-1][both])[0, 1] if both.sum() > 2 else float("nan")
    return [float(prefers[~room].sum()), float(prefers[room].sum()), float(np.abs(prefers[room]).sum()), float(alike)]


def observe(seed: int) -> tuple[MotionPrior, dict[str, tuple[Observations, Trajectory]]]:
    """What reasoning is given, and the truth, for every interval between answered frames."""
    seen = {}
    with tempfile.TemporaryDirectory() as scratch:
        model, sequence, cache = learn(Path(scratch), seed)
        for name, every in EVERY.items():
            run = VisualOdometry(model).process(sequence, np.arange(0, len(sequence), every), cache=cache)
            seen[name] = run.observations(np.arange(len(run.frames))), sequence.require_truth()[run.frames]
    return model.prior, seen


def measure(prior: MotionPrior, observed: dict[str, tuple[Observations, Trajectory]]) -> Numbers:
    """Errors of all reasoners with all parts of the motion on and off."""
    found: Numbers = {}
    for (name, (whole, truth)), limits, rotation in product(observed.items(), (True, False), (True, False)):
        motions = whole.motions if rotation else [without_rotation(m) for m in whole.motions]
        seen = replace(whole, motions=motions, submaps=whole.submaps if rotation else ())
        usual = prior if limits else without_limits(prior)
        forward = filter_posteriors(seen, usual)
        best, _ = choose_places(hindsight_posteriors(seen, usual, forward), seen.timestamps_s, usual)
        setting = ", ".join((name, *(str(int(on)) for on in (limits, rotation))))
        for reasoner, path in (
            ("hindsight", best),
            ("smoothed", smooth(own_hypotheses(best, seen, usual), seen, usual)),
            ("online", choose_places(forward, seen.timestamps_s, usual)[0]),
        ):
            found[f"{setting}, {reasoner}"] = errors(path, truth)
    return found | {f"evidence, {name}": evidence(*observed[name]) for name in EVERY}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, nargs="+", default=list(SEEDS))
    seeds = parser.parse_args().seeds
    folder = RESULTS / "turned_rooms"
    results: list[Numbers] = []
    for seed in seeds:
        file = folder / f"{seed}.json"
        results.append(cached_json(file, lambda seed=seed: measure(*observe(seed))))
    rows = []
    for setting in results[0]:
        if setting.startswith("evidence"):
            continue
        name, limits, rotation, reasoner = setting.split(", ")
        columns = zip(*(numbers[setting] for numbers in results), strict=True)
        numbers = [mean_interval(list(column), d) for column, d in zip(columns, (3, 2, 1), strict=True)]
        switches = ["yes" if on == "1" else "" for on in (limits, rotation)]
        rows.append([name, *switches, reasoner, *numbers])
    header = ["a frame every", "limits", "rotation", "reasoner", "wrong room", "rmse_m", "rmse_deg"]
    notes = (
        f"Rooms that are one another's half-turn (docs/corridor.md). Trained on a flight of {N_VISITS} visits, another "
        f"one answered, its frames followed at 10 a second; mean and 95 % interval over seeds {seeds}. Limits: on "
        "speed and turning. Without limits and rotations every frame is answered alone. No landmarks. Submaps where "
        "rotations are used. Wrong room: share of the frames in rooms."
    )
    title = "What relative motion is worth between rooms that are one another's half-turn"
    command = f"python benchmarks/turned_rooms.py --seeds {' '.join(map(str, seeds))}"
    write_page("turned_rooms", title, command, table_lines(header, rows), notes, *evidence_blocks(seeds, results))


def evidence_blocks(seeds: list[int], results: list[Numbers]) -> list[str | list[str]]:
    """A table of what images say of the side, seed by seed, and how to read it."""
    header = [
        "a frame every",
        "seed",
        "lobby, nats",
        "rooms, nats",
        "rooms, if all agreed",
        "correlation",
        "wrong room",
    ]
    rows = []
    for name in EVERY:
        for seed, numbers in zip(seeds, results, strict=True):
            lobby, inside, agreed, alike = numbers[f"evidence, {name}"]
            wrong = numbers[f"{name}, 1, 1, hindsight"][0]
            nats = [f"{lobby:+.1f}", f"{inside:+.1f}", f"{agreed:.1f}"]
            rows.append([name, str(seed), *nats, f"{alike:.2f}", f"{wrong:.3f}"])
    return [
        "## What images say of the side",
        table_lines(header, rows),
        f"Nats: log of the mass of candidates within {NEAR_M} m and {np.degrees(NEAR_RAD):.0f} degrees of the true "
        "pose, less that of candidates near its half-turn, summed over frames. In rooms both views are equal to the "
        "pixel, so that honest evidence is zero there; in the lobby the poster tells the sides apart. Correlation: of "
        "neighbouring frames in rooms. Wrong room: hindsight with limits and rotations.",
    ]


if __name__ == "__main__":
    main()
