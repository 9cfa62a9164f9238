"""Whether errors are where a recording is called sparsely covered, which poses and known frames alone decide.

python benchmarks/recording_quality.py [--seeds 10 11 12] [--chosen-on 0 1 2] [--runs FOLDER]

redkitchen, ``blocks``, regions calibrated on frames (one fit instead of five). The frames of a seed are cached in the
folder of runs and not measured again.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from ablation import Models
from common import ROOT, cached_json, parser_with_seeds, table_lines, write_page

from conformodal.geometry import position_errors_m
from conformodal.quality.view_coverage import QUALITY, ViewScale, pose_coverage

LARGE_M = 0.1
PATH, ALONE = "the path", "one frame alone"
LIMITS = (0.05, 0.075, 0.1, 0.125, 0.15, 0.2)


def measured(seed: int, runs: Path) -> dict[str, Any]:
    """Of each frame of the test part: what poses say of it, and then the errors of its answers."""
    models = Models("redkitchen, blocks", seed, runs)
    model, sequence = models.trained(), models.sequence
    truth, test = sequence.require_truth(), model.split.test
    scale = ViewScale.of(sequence.camera, model.prior.depth_m)
    coverage = pose_coverage(truth, sequence.recording, truth[model.localizer.frames], scale)
    run = models.run(model)
    most_probable = [c.positions_xyz[int(np.argmax(c.log_mass))] for c in run.localization.candidates]
    off = np.array(most_probable) - truth.positions_xyz[test]
    return {
        "depth_m": scale.depth_m,
        "change": coverage.change[test].tolist(),
        "errors_m": {
            PATH: position_errors_m(run.trajectory, truth[test]).tolist(),
            ALONE: np.linalg.norm(off, axis=1).tolist(),
        },
    }


def joined(results: list[dict[str, Any]], kind: str) -> tuple[np.ndarray, np.ndarray]:
    """Frames of several seeds: how much the nearest known view differs, and errors in metres."""
    change = np.concatenate([result["change"] for result in results])
    return change, np.concatenate([result["errors_m"][kind] for result in results])


def rows(name: str, results: list[dict[str, Any]], limit: float, *, choose: bool = False) -> list[list[str]]:
    """Errors where the nearest known view differs by more than the limit, and elsewhere: one row per kind of error.

    With `choose`, a last column has the difference between the shares of large and of other errors above the limit.
    """
    lines = []
    for kind in (PATH, ALONE):
        change, off = joined(results, kind)
        cells, large = [name, kind], off > LARGE_M
        for part in (change > limit, change <= limit):
            cells.append(str(int(part.sum())))
            cells += [f"{np.median(off[part]):.3f}", f"{100 * large[part].mean():.0f}"] if part.any() else ["", ""]
        if choose:
            sparse = change > limit
            cells.append(f"{sparse[large].mean() - sparse[~large].mean():.2f}" if large.any() else "")
        lines.append(cells)
    return lines


def main() -> None:
    parser = parser_with_seeds(__doc__, (10, 11, 12))
    parser.add_argument("--chosen-on", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--runs", type=Path, default=ROOT / "ablation-out")
    options = parser.parse_args()

    def numbers(seeds: list[int]) -> list[dict[str, Any]]:
        files = {seed: options.runs / f"quality-{seed}.json" for seed in seeds}
        return [cached_json(file, partial(measured, seed, options.runs)) for seed, file in files.items()]

    chosen, reported = numbers(options.chosen_on), numbers(options.seeds)
    by_seed = zip(options.seeds, reported, strict=True)
    lines = [row for seed, result in by_seed for row in rows(str(seed), [result], QUALITY.sparse)]
    lines += rows("all", reported, QUALITY.sparse)
    by_limit = [row for limit in LIMITS for row in rows(f"{limit:g}", chosen, limit, choose=True)]
    depths = [one["depth_m"] for one in chosen + reported]
    columns = [f"{part}: {name}" for part in ("sparse", "others") for name in ("frames", "median, m", "% over 0.1 m")]
    write_page(
        "recording_quality",
        "Errors where a recording is called sparsely covered",
        "python benchmarks/recording_quality.py",
        "redkitchen sequence 01, `blocks`, regions calibrated on frames. Frames of the test part. One is called "
        f"sparsely covered if the nearest view that the model knows differs by more than {QUALITY.sparse:g} of the "
        f"field of view, in a scene {min(depths):.2f} to {max(depths):.2f} m deep, as the models found it: poses and "
        "known frames alone tell.",
        table_lines(["seed", "errors of", *columns], lines),
        f"Limits on the seeds on which one was chosen ({', '.join(map(str, options.chosen_on))}): that with the "
        f"largest difference between the shares of errors over {LARGE_M:g} m and of others that it calls "
        "sparsely covered.",
        table_lines(["limit", "errors of", *columns, "difference"], by_limit),
    )


if __name__ == "__main__":
    main()
