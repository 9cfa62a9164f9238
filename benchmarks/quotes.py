"""Numbers that pages quote, each with a mark that names the cell of a table it is from.

python benchmarks/quotes.py [--write]     # check, or fill in the numbers of today's tables

A mark is ``<!-- = recordings.md : fr1_xyz from fr1_desk; ours; online; rmse_m -->`` after the number: the table,
cells of its row, and the column; ``column #2`` is the second number of the cell. Of rows with these cells the first
counts. ``one column + another`` are of the last two numbers before the mark.
"""

from __future__ import annotations

import argparse
import re
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
DOCS = ROOT / "docs"
PAGES = (
    ROOT / "README.md",
    DOCS / "results.md",
    DOCS / "paper.md",
    DOCS / "decisions" / "scores.md",
    DOCS / "decisions" / "table-learners.md",
    DOCS / "howto" / "groups-and-shift.md",
)
NUMBER = re.compile(r"(?<![\w.,-])\d+(?:\.\d+)?(?![\w.]*\w)")
DECIMAL = re.compile(r"-?\d+(?:\.\d+)?")
MARK = re.compile(r"<!-- = (?P<table>[\w/]+\.md) : (?P<cells>[^>]*?) -->")
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


def cells_of(mark: re.Match[str]) -> list[float]:
    """The numbers that a mark names; LookupError if there are none."""
    *cells, columns = (part.strip() for part in mark["cells"].split("; "))
    names = [column.partition(" #")[::2] for column in columns.split(" + ")]
    for row in rows_of(mark["table"]):
        if all(name in row for name, _ in names) and all(cell in row.values() for cell in cells):
            return [float(DECIMAL.findall(row[name])[int(place or 1) - 1]) for name, place in names]
    raise LookupError(f"{mark['table']} has no row with {cells} and columns {columns!r}")


def checked(page: Path) -> tuple[str, list[str]]:
    """The page with the numbers of the tables, and what was wrong with it."""
    text, wrong, quoted = page.read_text(encoding="utf-8"), [], []
    for mark in MARK.finditer(text):
        line = text.rfind("\n", 0, mark.start()) + 1
        before = list(NUMBER.finditer(text, line, mark.start()))
        try:
            cells = cells_of(mark)
        except (LookupError, OSError) as exc:
            wrong.append(f"{page.name}: {mark[0]}: {exc}")
            continue
        for number, cell in zip(before[-len(cells) :], cells, strict=True):
            value = f"{cell:.{len(number[0].partition('.')[2])}f}"
            quoted.append((number.span(), value))
            if value != number[0]:
                wrong.append(f"{page.name}: {number[0]} where {mark['table']} has {value} ({mark['cells']})")
    bare = text
    for (start, end), value in reversed(quoted):
        bare = bare[:start] + " " * (end - start) + bare[end:]
        text = text[:start] + value + text[end:]
    bare = bare.partition("## Results")[2] or bare
    bare = NOT_QUOTED.sub("", MARK.sub("", bare))
    measured = [number for number in NUMBER.findall(bare) if len(number.partition(".")[2]) >= 2]
    return text, wrong + [f"{page.name}: {number} has no mark" for number in measured]


def stale_tables() -> list[str]:
    """Tables that are not of one source revision, and what has changed since."""
    tables = sorted((ROOT / "benchmarks" / "results").glob("*.md"))
    sources = {path.name: re.findall(r"source ([\w-]{7,46})", path.read_text(encoding="utf-8")) for path in tables}
    revisions = {revision for named in sources.values() for revision in named}
    if len(revisions) != 1:
        return [f"{name}: of source {', '.join(named) or 'unknown'}" for name, named in sources.items()]
    parts = ("src", "benchmarks", ":(exclude)benchmarks/results")
    command = ["git", "diff", "--name-only", revisions.pop(), "--", *parts]
    changed = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True).stdout.split()
    return [f"{name}: changed since the tables were measured" for name in changed]


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--write", action="store_true", help="fill in the numbers")
    parser.add_argument("--release", action="store_true", help="check too that all tables are of today's source")
    options = parser.parse_args()
    wrong = stale_tables() if options.release else []
    for page in PAGES:
        if options.write:
            page.write_text(checked(page)[0], encoding="utf-8")
        wrong += checked(page)[1]
    sys.stdout.writelines(f"{line}\n" for line in wrong)
    return int(bool(wrong))


if __name__ == "__main__":
    sys.exit(main())
