"""The paper's table 1 on redkitchen; what is in OUT already is not run again.

python benchmarks/table1.py [--seeds 5] [--first-seed 40] [--method all] [--baselines default] [--out FOLDER]
    [--workers 2]

Options but for ``--out`` are those of ``python -m experiments.table1``; settings were chosen on seeds 10 to 29.
"""

from __future__ import annotations

import json
import shlex
import subprocess
import sys
from pathlib import Path

from common import REDKITCHEN, ROOT, RUNS, parser_of, write_page


def main() -> None:
    parser = parser_of(__doc__)
    parser.add_argument("--out", type=Path, default=RUNS / "table1")
    options, others = parser.parse_known_args()
    defaults = ["--seeds", "5", "--first-seed", "40", "--workers", "2"]  # a later option of the same name counts
    paths = [str(REDKITCHEN.resolve()), "--out", str(options.out.resolve())]
    command = [sys.executable, "-m", "experiments.table1", *paths]
    subprocess.run([*command, *defaults, *others], check=True, cwd=ROOT, stdout=subprocess.DEVNULL)
    seconds = json.loads((options.out / "metrics.json").read_text(encoding="utf-8"))["seconds"]
    lines = (options.out / "table1.md").read_text(encoding="utf-8").splitlines()
    write_page(
        "table1_paper" if "paper" in others else "table1",
        lines[0].lstrip("# "),
        shlex.join(["python", *sys.argv]),
        lines[2:],
        f"The last call took {seconds / 60:.1f} minutes.",
    )


if __name__ == "__main__":
    main()
