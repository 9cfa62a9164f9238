"""What the site has beside docs/: front page, notebooks, tables, examples, reference and gallery; nothing is copied.

MkDocs calls the functions ``on_*``, see mkdocs.yml. The others need the standard library only.
"""

from __future__ import annotations

import ast
import posixpath
import re
import runpy
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
SOURCE = ROOT / "src" / "conformodal"
TABLES = "benchmarks/results"
NOTEBOOKS = runpy.run_path(str(ROOT / "docs" / "notebook_pages.py"))
AT_ROOT = {
    "README.md": "index.md",
    "CONTRIBUTING.md": "contributing.md",
    "CHANGELOG.md": "changelog.md",
    "SECURITY.md": "security.md",
}
INTERNAL = {"cli", "core"}  # packages without a page in the reference
FIRST = ("conformal", "pipeline", "io", "geometry", "localizer")  # in the reference
MAIN = ("ConformalRegressor", "VisualOdometry")
GENERATED = {"tables/index.md", "reference/index.md", "examples.md", "gallery.md"}  # written with the site's own links
LINK = re.compile(r"(!?)\[((?:[^\[\]]|\[[^\[\]]*\])*)\]\(([^()\s]+)\)")
FENCE = re.compile(r"^(```|~~~).*?^\1[ \t]*$", re.DOTALL | re.MULTILINE)
NAMED = re.compile(r"<code>((?:examples|docs|notebooks)/[\w/-]+\.(?:py|md|ipynb))</code>")
ROLE = re.compile(r":(?:class|func|meth|attr|data|mod|exc):<code>(~?)([\w.]+)</code>")


def added_pages() -> dict[str, Callable[[], str]]:
    """Pages that are not files of docs/, by their place on the site; each function gives the Markdown."""
    pages: dict[str, Callable[[], str]] = {site: (ROOT / path).read_text for path, site in AT_ROOT.items()}
    pages |= {f"tables/{path.name}": path.read_text for path in sorted((ROOT / TABLES).glob("*.md"))}
    pages |= {f"notebooks/{n}.md": lambda n=n: NOTEBOOKS["notebook_page"](n) for n in NOTEBOOKS["notebooks"]()}  # type: ignore[misc]
    pages |= {f"reference/{name}.md": lambda name=name: package_page(name) for name in packages()}  # type: ignore[misc]
    pages["tables/index.md"] = tables_page
    pages["reference/index.md"] = reference_page
    pages["examples.md"] = examples_page
    pages["gallery.md"] = gallery_page
    return pages


def origin(site: str) -> str:
    """Path in the repository that a page's links are relative to."""
    named = {page: path for path, page in AT_ROOT.items()}
    if site in named:
        return named[site]
    if site.startswith("tables/") and site != "tables/index.md":
        return f"{TABLES}/{posixpath.basename(site)}"
    return site if site.startswith("notebooks/") else f"docs/{site}"


def place(path: str) -> str | None:
    """Page of the site, with its anchor, that shows a path of the repository; None if no page does."""
    if path in AT_ROOT or path == TABLES:
        return (AT_ROOT | {TABLES: "tables/index.md"})[path]
    folder, name = posixpath.split(path)
    if folder == TABLES and name.endswith(".md"):
        return f"tables/{name}"
    if folder == "examples" and name.endswith(".py"):
        return f"examples.md#{name.removesuffix('.py')}"
    if folder == "notebooks" and name.endswith(".ipynb"):
        return path.removesuffix(".ipynb") + ".md"
    parts = path.split("/")
    if parts[:2] == ["src", "conformodal"] and len(parts) > 2:
        return reference_of(ROOT / path, parts[2]) if parts[2] in packages() else None
    return path.removeprefix("docs/") if parts[0] == "docs" and not path.endswith(".py") else None


def rewritten(markdown: str, site: str) -> str:
    """The page's Markdown with links between files of the repository made links between pages of the site.

    A link to a file that no page shows becomes its text; a link to nothing stays, and the strict build refuses it.
    """
    if site in GENERATED:
        return markdown
    here = posixpath.dirname(origin(site))

    def link(match: re.Match[str]) -> str:
        image, text, target = match.groups()
        path, hash_, anchor = target.partition("#")
        if not path or re.match(r"[a-z]+:", target):
            return match[0]
        full = posixpath.normpath(posixpath.join(here, path))
        if not (ROOT / full).exists():
            return match[0]
        page = place(full)
        if page is None:
            return text
        page, own, section = page.partition("#")
        return f"{image}[{text}]({relative(page, site)}{own or hash_}{section or anchor})"

    kept = list(FENCE.finditer(markdown))
    starts, ends = [0, *(m.end() for m in kept)], [*(m.start() for m in kept), len(markdown)]
    prose = [LINK.sub(link, markdown[start:end]) for start, end in zip(starts, ends, strict=True)]
    return prose[0] + "".join(fence[0] + after for fence, after in zip(kept, prose[1:], strict=True))


def reference_of(path: Path, package: str) -> str:
    """Place in the reference of what a file or folder of the source defines first, or of its package."""
    file = path / "__init__.py" if path.is_dir() else path
    known = exported(SOURCE / package) or list(defined(package))
    for node in ast.parse(file.read_text(encoding="utf-8")).body if file.suffix == ".py" else ():
        if isinstance(node, (ast.ClassDef, ast.FunctionDef)) and node.name in known:
            return f"reference/{package}.md#{identifier(f'conformodal.{package}.{node.name}')}"
    return f"reference/{package}.md"


def relative(page: str, site: str) -> str:
    """Link from one page of the site to another."""
    return posixpath.relpath(page, posixpath.dirname(site) or ".")


def title(markdown: str) -> str:
    """First heading of a page."""
    found = re.search(r"^# (.+)$", markdown, re.MULTILINE)
    return found[1] if found else ""


def packages() -> list[str]:
    """Packages that have a page in the reference, those that most programs use first."""
    found = {path.parent.name for path in SOURCE.glob("*/__init__.py")} - INTERNAL
    return sorted(found, key=lambda name: (FIRST.index(name) if name in FIRST else len(FIRST), name))


def exported(folder: Path) -> list[str]:
    """Names in a package's ``__all__``."""
    for node in ast.parse((folder / "__init__.py").read_text(encoding="utf-8")).body:
        if isinstance(node, ast.Assign) and getattr(node.targets[0], "id", "") == "__all__":
            return [str(name) for name in ast.literal_eval(node.value)]
    return []


def identifier(name: str) -> str:
    """What the reference calls a public name: by its package where that exports it, otherwise by its module."""
    package, _, last = name.rpartition(".")
    folder = ROOT / "src" / package.replace(".", "/")
    known = (folder / "__init__.py").is_file() and last in exported(folder)
    if known and not any(folder.rglob(f"{last}.py")):  # a function in a file of its own name stands there
        return name
    top = package.split(".")
    return defined(top[1]).get(last, name) if len(top) > 1 else name


@cache
def defined(package: str) -> dict[str, str]:
    """Public classes and functions of a package, each with its module; what a module exports first stays."""
    found: dict[str, str] = {}
    for path in sorted((SOURCE / package).rglob("*.py")):
        module = ".".join(path.relative_to(ROOT / "src").with_suffix("").parts).removesuffix(".__init__")
        for node in ast.parse(path.read_text(encoding="utf-8")).body:
            if isinstance(node, (ast.ClassDef, ast.FunctionDef)) and not node.name.startswith("_"):
                found.setdefault(node.name, f"{module}.{node.name}")
    return found


def package_page(name: str) -> str:
    """A package's reference: the names that it exports, or all public ones, module by module."""
    dotted = f"conformodal.{name}"
    known = exported(SOURCE / name)
    parts = [f"# {dotted}\n\n::: {dotted}\n"]
    shown = "    options: {show_root_heading: true, show_root_toc_entry: true, show_root_full_path: false}\n"
    modules: dict[str, list[str]] = {}
    if known:
        parts += [f"::: {n}\n{shown}" for n in (identifier(f"{dotted}.{n}") for n in known) if n.count(".") > 2]
        for inner in sorted((SOURCE / name).glob("*/__init__.py")):
            own = [defined(name)[n] for n in exported(inner.parent) if n not in known and n in defined(name)]
            modules |= {f"{dotted}.{inner.parent.name}": own} if own else {}
    else:
        for full in defined(name).values():
            modules.setdefault(full.rpartition(".")[0], []).append(full)
    deeper = shown.replace("{", "{heading_level: 3, ")
    for module, names in sorted(modules.items()):
        parts += [f"## {module.removeprefix(dotted + '.')}\n", *(f"::: {n}\n{deeper}" for n in names)]
    return "\n".join(parts)


def reference_page() -> str:
    """The names of the top package with their first sentences, then all packages."""
    where = {n: name for name in packages() for n in defined(name)}
    where |= {n: name for name in packages() for n in exported(SOURCE / name)}
    lines = ["# Reference", "", "`import conformodal as cm` has the names that most programs need.", ""]
    lines += ["| name | what |", "| --- | --- |"]
    top = sorted(exported(SOURCE), key=lambda n: (n.endswith("Error"), n not in MAIN, packages().index(where[n]), n))
    lines += [f"| [`cm.{n}`][{identifier(f'conformodal.{where[n]}.{n}')}] | {summary(where[n], n)} |" for n in top]
    lines += ["", "Options of the command line: `conformodal --help` and `conformodal VERB --help`.", ""]
    lines += ["| package | what |", "| --- | --- |"]
    for name in packages():
        docstring = ast.get_docstring(ast.parse((SOURCE / name / "__init__.py").read_text(encoding="utf-8"))) or ""
        lines.append(f"| [conformodal.{name}]({name}.md) | {first_sentence(docstring)} |")
    return "\n".join([*lines, ""])


def summary(package: str, name: str) -> str:
    """First sentence of the docstring of a public class or function of a package; errors may come from the core."""
    for path in [*sorted((SOURCE / package).rglob("*.py")), *sorted((SOURCE / "core").rglob("*.py"))]:
        for node in ast.parse(path.read_text(encoding="utf-8")).body:
            if isinstance(node, (ast.ClassDef, ast.FunctionDef)) and node.name == name:
                return first_sentence(ast.get_docstring(node) or "")
    return ""


def first_sentence(docstring: str) -> str:
    """The first paragraph of a docstring in one line, without roles."""
    return re.sub(r":\w+:`~?\.?([\w.]+)`", r"`\1`", docstring.partition("\n\n")[0].replace("\n", " "))


def tables_page() -> str:
    """All committed tables by their titles."""
    tables = sorted((ROOT / TABLES).glob("*.md"))
    rows = [f"| [{path.stem}]({path.name}) | {title(path.read_text(encoding='utf-8'))} |" for path in tables]
    intro = "Each is written by a script in `benchmarks/` and names its command and source revision."
    return "\n".join(["# All tables", "", intro, "", "| table | about |", "| --- | --- |", *rows, ""])


def examples_page() -> str:
    """The files of examples/, whole: those that use the package, then those that add to it."""
    parts = ["# Examples\n\nFiles of `examples/`; each runs as it is.\n"]
    for path in sorted((ROOT / "examples").glob("*.py"), key=lambda path: (path.stem.startswith("custom_"), path.stem)):
        code = path.read_text(encoding="utf-8")
        said = (ast.get_docstring(ast.parse(code)) or "").split("\n")[0]
        parts.append(f"## {path.name} {{#{path.stem}}}\n\n{said}\n\n```python\n{code}```\n")
    return "\n".join(parts)


def gallery_page() -> str:
    """Every picture of docs/images/ with the text and the page that it stands in."""
    docs = ROOT / "docs"
    sites = [path.relative_to(docs).as_posix() for path in [*sorted(docs.glob("*.md")), *sorted(docs.glob("*/*.md"))]]
    pages = AT_ROOT | {f"docs/{site}": site for site in sites}
    shown: dict[str, tuple[str, str, str]] = {}
    for path, site in pages.items():
        text = (ROOT / path).read_text(encoding="utf-8")
        for image, alt, target in LINK.findall(text):
            name = posixpath.basename(target)
            if image and name not in shown:
                shown[name] = alt, site, title(text)
    parts = ["# Gallery\n"]
    for picture in sorted((ROOT / "docs" / "images").glob("*.*")):
        alt, site, named = shown[picture.name]
        parts.append(f"![{alt}](images/{picture.name})\n\n{alt} From [{named}]({site}).\n")
    return "\n".join(parts)


def linked_roles(html: str, package: str) -> str:
    """Cross-references of docstrings as links of the reference; those to nothing there as code. Files too, by page."""

    def link(match: re.Match[str]) -> str:
        short, name = match.groups()
        name = name.lstrip(".")
        full = name if name.startswith("conformodal.") else f"conformodal.{package}.{name}"
        shown = name.rpartition(".")[2] if short else name
        return f'<autoref identifier="{identifier(full)}" optional><code>{shown}</code></autoref>'

    def file(match: re.Match[str]) -> str:
        page, hash_, anchor = (place(match[1]) or "").partition("#")
        if not page or not (ROOT / match[1]).is_file():
            return match[0]
        return f'<a href="../{page.removesuffix(".md")}.html{hash_}{anchor}">{match[0]}</a>'

    return NAMED.sub(file, ROLE.sub(link, html))


def on_config(config: Any) -> Any:
    """Put the pages of the reference in the place of their pattern in the navigation."""
    (pages,) = (entry["Reference"] for entry in config["nav"] if "Reference" in entry)
    place_of = pages.index("reference/*.md")
    pages[place_of : place_of + 1] = [f"reference/{name}.md" for name in packages()]
    return config


def on_files(files: Any, config: Any) -> Any:
    """Add the pages that are not files of docs/."""
    from mkdocs.structure.files import File  # noqa: PLC0415 - the site's own needs

    for site, read in added_pages().items():
        files.append(File.generated(config, site, content=read()))
    for site, content in NOTEBOOKS["pictures"]().items():
        files.append(File.generated(config, site, content=content))
    return files


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    """Links of the repository become links of the site; a page without neighbours needs no list of them."""
    if page.parent is None:
        page.meta["hide"] = ["navigation"]
    return rewritten(markdown, page.file.src_uri)


def on_page_content(html: str, page: Any, **_: Any) -> str:
    """Cross-references in docstrings become links."""
    folder, name = posixpath.split(page.file.src_uri)
    return linked_roles(html, name.removesuffix(".md")) if folder == "reference" else html
