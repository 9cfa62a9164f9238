"""Pages of the site, where `make docs` has built it, are legible in a browser, from files alone."""

from pathlib import Path

import pytest

SITE = Path(__file__).parents[2] / "site"
PAGES = ["index.html", "start.html", "results.html", "data.html"]


@pytest.fixture
def site_page(browser, checks):
    """Opens a page of the site on a narrow screen."""
    pages, asked = [], []

    def open_page(name, scheme):
        page = browser.new_page(color_scheme=scheme, viewport={"width": 380, "height": 900})
        page.on("request", lambda request: asked.append(request.url))
        page.goto((SITE / name).as_uri())
        page.evaluate(checks)
        pages.append(page)
        return page

    yield open_page
    for page in pages:
        page.close()
    assert [url for url in asked if not url.startswith(("file:", "data:", "blob:"))] == []


@pytest.mark.slow
@pytest.mark.skipif(not (SITE / "index.html").is_file(), reason="the site is not built")
@pytest.mark.parametrize("name", PAGES)
@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_the_site_is_legible(site_page, name, scheme):
    page = site_page(name, scheme)
    assert page.evaluate("checks.contrast('main article')") == []
    wide = page.evaluate("checks.overflow()")
    assert [one for one in wide if not one.startswith("scrolls")] == []
    assert page.evaluate("[document.documentElement.lang, document.querySelectorAll('main h1').length]") == ["en", 1]
