"""Links between files of the repository lead somewhere; test_site.py follows those of the built site."""

import re
import runpy
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
HOOKS = runpy.run_path(str(ROOT / "docs" / "hooks.py"))
PAGES = sorted([*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md"), *(ROOT / "benchmarks" / "results").glob("*.md")])
ADDED = HOOKS["added_pages"]()
SITE = {*ADDED, *(path.relative_to(ROOT / "docs").as_posix() for path in (ROOT / "docs").rglob("*.md"))}


def markdown_of(site):
    return ADDED[site]() if site in ADDED else (ROOT / "docs" / site).read_text(encoding="utf-8")


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
        found = page.parent / path if path else page
        assert found.exists(), target
        if anchor:
            assert anchor in anchors_of(found.read_text(encoding="utf-8")), target


def test_pictures_have_a_text_for_those_who_do_not_see_them():
    for site in sorted(SITE):
        texts = [text for image, text, _ in HOOKS["LINK"].findall(markdown_of(site)) if image]
        assert all(len(text) > 20 for text in texts), site


def test_every_picture_is_in_the_gallery():
    gallery = markdown_of("gallery.md")
    assert not [path.name for path in (ROOT / "docs" / "images").iterdir() if f"images/{path.name}" not in gallery]
