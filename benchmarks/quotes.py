"""Write the pages that quote tables, from templates in benchmarks/pages.

python benchmarks/quotes.py [--write]     # check that README and docs are current, or write them

A template has the path of its page. ``{{ recordings.md; fr1_xyz from fr1_desk; ours; online; rmse_m; .4f }}`` in it
names a table of benchmarks/results, cells of its row (or other columns, where several tables have such a row), the
column, and the format; ``column #2`` is the second number of the cell. Of rows with these cells the first counts.
"""

from __future__ import annotations

import argparse
import re
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
TEMPLATES = ROOT / "benchmarks" / "pages"
NUMBER = re.compile(r"(?<![\w.,-])\d+(?:\.\d+)?(?![\w.]*\w)")
DECIMAL = re.compile(r"-?\d+(?:\.\d+)?")
QUOTE = re.compile(r"\{\{ (?P<table>[\w/]+\.md); (?P<cells>[^{}]*); (?P<format>\.\df) \}\}")
NOT_QUOTED = re.compile(r"```.*?```|`[^`\n]*`|\]\([^)]*\)|^#[^\n]*", re.DOTALL | re.MULTILINE)


def rows_of(table: str) -> list[dict[str, str]]:
    """Rows of all tables of a page of results, by column."""
    rows: list[dict[str, str]] = []
    header: list[str] = []
    for line in (ROOT / "benchmarks" / "results" / table).read_text(encoding="utf-8").splitlines():
        cells = [cell.strip() for cell in line.strip().strip("|").split(" | ")]
        if not line.startswith("| "):
            header = []
        elif not header:
            header = cells
        elif set(cells) != {"---"}:
            rows.append(dict(zip(header, cells, strict=False)))
    return rows


def quoted(quote: re.Match[str]) -> str:
    """The number that a quote names; LookupError if there is none."""
    *cells, column = quote["cells"].split("; ")
    name, _, place = column.partition(" #")
    for row in rows_of(quote["table"]):
        if name in row and all(cell in row.values() or cell in row for cell in cells):
            return f"{float(DECIMAL.findall(row[name])[int(place or 1) - 1]):{quote['format']}}"
    raise LookupError(f"{quote['table']} has no row with {cells} and the column {column!r}")


def templates() -> list[Path]:
    """Those of all pages."""
    return sorted(TEMPLATES.rglob("*.md"))


def page_of(template: Path) -> Path:
    """The page that is written from a template."""
    return ROOT / template.relative_to(TEMPLATES)


def written(template: Path) -> str:
    """What the page of a template says."""
    note = f"<!-- written from {template.relative_to(ROOT)}: edit that, then run benchmarks/quotes.py --write -->"
    return f"{QUOTE.sub(quoted, template.read_text(encoding='utf-8'))}\n{note}\n"


def faults(text: str) -> list[str]:
    """Quotes of a template without a number, and measured numbers that are not quoted."""
    wrong = []
    for quote in QUOTE.finditer(text):
        try:
            quoted(quote)
        except (LookupError, OSError) as exc:
            wrong.append(f"{quote[0]}: {exc}")
    bare = QUOTE.sub("", text)
    wrong += [f"{quote}: is not a quote" for quote in re.findall(r"\{\{.*?\}\}", bare)]
    bare = NOT_QUOTED.sub("", bare.partition("## Results")[2] or bare)
    measured = [number for number in NUMBER.findall(bare) if len(number.partition(".")[2]) >= 2]
    return wrong + [f"{number} is not quoted from a table" for number in measured]


def imported(script: Path) -> set[Path]:
    """A script of the benchmarks, and those that it imports."""
    found, left = {script}, [script]
    while left:
        text = left.pop().read_text(encoding="utf-8")
        for name in re.findall(r"^(?:from|import) (\w+)", text, re.MULTILINE):
            files = (script.parent / f"{name}.py", ROOT / "benchmarks" / f"{name}.py")
            new = [file for file in files if file.is_file() and file not in found][:1]
            found.update(new)
            left += new
    return found


def stale_tables() -> list[str]:
    """Tables that are older than a change of what decides them: the package, the experiments, or their script."""
    wrong = []
    for path in sorted((ROOT / "benchmarks" / "results").glob("*.md")):
        text = path.read_text(encoding="utf-8")
        revision = re.search(r"source ([0-9a-f]{7,40})[, ]", text)
        script = re.search(r"python (benchmarks/[\w/]+\.py)", text)
        if revision is None or script is None:
            wrong.append(f"{path.name}: names no clean source revision, or no script")
            continue
        parts = ["src", "experiments", ":(exclude)experiments/tests", *map(str, imported(ROOT / script[1]))]
        command = ["git", "diff", "--name-only", revision[1], "--", *parts]
        changed = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True).stdout.split()
        wrong += [f"{path.name}: {name} has changed since {revision[1]}" for name in changed[:1]]
    return wrong


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--write", action="store_true", help="write the pages")
    parser.add_argument("--release", action="store_true", help="check too that no table is older than its source")
    options = parser.parse_args()
    wrong = stale_tables() if options.release else []
    for template in templates():
        page, name = page_of(template), template.relative_to(ROOT)
        of_template = [f"{name}: {fault}" for fault in faults(template.read_text(encoding="utf-8"))]
        wrong += of_template
        if of_template:
            continue
        if options.write:
            page.write_text(written(template), encoding="utf-8")
        elif not page.is_file() or page.read_text(encoding="utf-8") != written(template):
            wrong.append(f"{page.relative_to(ROOT)}: is not what {name} gives: run benchmarks/quotes.py --write")
    sys.stdout.writelines(f"{line}\n" for line in wrong)
    return int(bool(wrong))


if __name__ == "__main__":
    sys.exit(main())
