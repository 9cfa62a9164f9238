"""The paper's table 1 on redkitchen; what is in OUT already is not run again.

python benchmarks/table1.py [--seeds 5] [--first-seed 10] [--method all] [--baselines default] [--out FOLDER]
    [--workers 2]
"""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

from common import REDKITCHEN, ROOT, parser_of, write_page


def main() -> None:
    parser = parser_of(__doc__)
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--first-seed", type=int, default=10, help="no setting was chosen on seeds from 10 on")
    parser.add_argument("--out", type=Path, default=Path("table1-out"))
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--method", choices=("all", "paper"), default="all")
    parser.add_argument("--baselines", choices=("default", "all"), default="default")
    options = parser.parse_args()
    video = (REDKITCHEN).resolve()
    command = [sys.executable, "-m", "experiments.table1", video]
    command += ["--out", options.out.resolve(), "--seeds", options.seeds, "--first-seed", options.first_seed]
    command += ["--workers", options.workers]
    command += ["--method", options.method, "--baselines", options.baselines]
    subprocess.run([str(part) for part in command], check=True, cwd=ROOT, stdout=subprocess.DEVNULL)
    seconds = json.loads((options.out / "metrics.json").read_text(encoding="utf-8"))["seconds"]
    lines = (options.out / "table1.md").read_text(encoding="utf-8").splitlines()
    seeds = "" if options.seeds == 5 else f" --seeds {options.seeds}"
    seeds += "" if options.first_seed == 10 else f" --first-seed {options.first_seed}"
    method = "" if options.method == "all" else f" --method {options.method}"
    others = "" if options.baselines == "default" else f" --baselines {options.baselines}"
    write_page(
        "table1" if options.method == "all" else f"table1_{options.method}",
        lines[0].lstrip("# "),
        f"python benchmarks/table1.py{seeds}{method}{others}",
        lines[2:],
        f"The last call took {seconds / 60:.1f} minutes.",
    )


if __name__ == "__main__":
    main()
