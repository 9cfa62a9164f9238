"""Links between files of the repository lead somewhere; test_site.py follows those of the built site."""

import re
import runpy
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
HOOKS = runpy.run_path(str(ROOT / "docs" / "hooks.py"))
PAGES = sorted([*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md"), *(ROOT / "benchmarks" / "results").glob("*.md")])


def links_of(markdown):
    prose = HOOKS["FENCE"].sub("", markdown)
    targets = [target for _, _, target in HOOKS["LINK"].findall(prose)]
    return [target for target in targets if not re.match(r"[a-z]+:", target)]


def anchors_of(markdown):
    headings = re.findall(r"^#+ (.+)$", HOOKS["FENCE"].sub("", markdown), re.MULTILINE)
    named = set(re.findall(r"\{#([\w-]+)\}", markdown))
    return named | {re.sub(r"[^\w\- ]", "", heading).strip().lower().replace(" ", "-") for heading in headings}


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.relative_to(ROOT).as_posix())
def test_links_of_a_file_lead_to_files(page):
    for target in links_of(page.read_text(encoding="utf-8")):
        path, _, anchor = target.partition("#")
        linked = page.parent / path if path else page
        assert linked.exists(), target
        if anchor:
            assert anchor in anchors_of(linked.read_text(encoding="utf-8")), target
