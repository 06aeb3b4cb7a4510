"""Every relative link of the documentation leads to a file of the checkout, every anchor to a heading or an id."""

from __future__ import annotations

import itertools
import json
import re
from collections import Counter
from functools import cache
from pathlib import Path
from urllib.parse import unquote, urlsplit

import pytest
from markdown_it import MarkdownIt

from mirrorwave.reference import pages
from tests.docs.pages import ROOT

#: Pages that `make reference` writes; they are no part of the checkout.
REFERENCE = ROOT / "docs" / "reference"
PAGES = sorted(
    {
        *(REFERENCE / name for name in ("commands.md", "messages.md", "parameters.md")),
        *ROOT.glob("*.md"),
        *(ROOT / "examples").rglob("*.md"),
        *(path for ending in ("md", "ipynb") for path in (ROOT / "docs").rglob(f"*.{ending}")),
    }
)
#: Where sources name a page: in docstrings, comments, help texts and error messages.
SOURCES = sorted(
    path
    for room in ROOT.iterdir()
    for path in (room.rglob("*") if room.is_dir() and not room.name.startswith(".") else [room])
    if path.suffix in (".py", ".yaml", ".toml") or path.name == "Makefile"
)
_NAMED_PAGE = re.compile(r"(?<![\w/])docs/[\w./-]*\w\.(?:md|json|ipynb|py|yaml|png)\b")
_HTML_LINK = re.compile(r"""(?:href|src)\s*=\s*["']([^"']+)["']""")
_HTML_ID = re.compile(r"""(?:id|name)\s*=\s*["']([^"']+)["']""")


@cache
def reference() -> dict[Path, str]:
    """The text of each page of the reference."""
    return {REFERENCE / name: text for name, text in pages().items()}


def markdown_of(path: Path) -> str:
    """The text of a page; of a notebook that of its Markdown cells."""
    if path in reference():
        return reference()[path]
    text = path.read_text(encoding="utf-8")
    if path.suffix != ".ipynb":
        return text
    cells = [cell for cell in json.loads(text)["cells"] if cell["cell_type"] == "markdown"]
    return "\n\n".join("".join(cell["source"]) for cell in cells)


def links_of(text: str) -> list[str]:
    """Targets of links and images, in Markdown and in HTML."""
    found = []
    for token in MarkdownIt("commonmark").enable("table").parse(text):
        for each in (token, *(token.children or ())):
            found += [str(each.attrs[name]) for name in ("href", "src") if name in each.attrs]
            if each.type in ("html_inline", "html_block"):
                found += _HTML_LINK.findall(each.content)
    return found


@cache
def anchors_of(path: Path) -> frozenset[str]:
    """Anchors of a page as GitHub makes them of headings, and ids that stand in it."""
    text = markdown_of(path)
    seen: Counter[str] = Counter()
    anchors = set(_HTML_ID.findall(text))
    tokens = MarkdownIt("commonmark").enable("table").parse(text)
    for opening, inline in itertools.pairwise(tokens):
        if opening.type == "heading_open":
            parts = (each.content for each in inline.children or () if each.type in ("text", "code_inline"))
            slug = re.sub(r"[^\w\- ]", "", "".join(parts).lower()).replace(" ", "-")
            anchors.add(f"{slug}-{seen[slug]}" if seen[slug] else slug)
            seen[slug] += 1
    return frozenset(anchors)


def dead_links(path: Path, root: Path = ROOT) -> list[str]:
    """Relative links of a page that lead nowhere within `root`, with the reason; what the web has is not asked for."""
    dead = []
    for link in links_of(markdown_of(path)):
        parts = urlsplit(link)
        if parts.scheme or parts.netloc:
            continue
        target = (path.parent / unquote(parts.path)).resolve() if parts.path else path
        if not target.is_relative_to(root) or not (target.exists() or target in reference()):
            dead.append(f"{link}: no such file")
        elif parts.fragment and target.suffix in (".md", ".ipynb") and parts.fragment not in anchors_of(target):
            dead.append(f"{link}: no such heading")
    return dead


@pytest.mark.parametrize("path", PAGES, ids=lambda path: str(path.relative_to(ROOT)))
def test_links_lead_somewhere(path: Path) -> None:
    assert dead_links(path) == []


def missing_pages(text: str, root: Path = ROOT) -> list[str]:
    """Files of `docs/` that a source names and that are not there."""
    return [name for name in _NAMED_PAGE.findall(text) if not ((root / name).exists() or ROOT / name in reference())]


def test_pages_that_sources_name_are_there() -> None:
    texts = {path: path.read_text(encoding="utf-8") for path in SOURCES if path != Path(__file__)}
    assert sum(len(_NAMED_PAGE.findall(text)) for text in texts.values()) > 30
    assert {str(path.relative_to(ROOT)): gone for path, text in texts.items() if (gone := missing_pages(text))} == {}


def test_a_missing_page_is_found(tmp_path: Path) -> None:
    (tmp_path / "docs/guides").mkdir(parents=True)
    (tmp_path / "docs/guides/there.md").touch()
    text = "see docs/guides/there.md, docs/there.md: docs/guides/gone.json."
    assert missing_pages(text, tmp_path) == ["docs/there.md", "docs/guides/gone.json"]


def test_a_dead_link_is_found(tmp_path: Path) -> None:
    (tmp_path / "there.md").write_text('# A `code` heading, twice\n\n# A code heading, twice\n\n<a id="own"></a>\n')
    page = tmp_path / "page.md"
    good = ["there.md", "there.md#a-code-heading-twice", "there.md#a-code-heading-twice-1", "there.md#own", "#page"]
    bad = ["gone.md", "there.md#gone", "#gone", "../outside.md"]
    links = " ".join(f"[x]({link})" for link in [*good, *bad, "https://example.org/x"])
    page.write_text(f'# Page\n\n{links} ![x](gone.png)\n\n<img src="gone.svg">\n\n    [x](code.md)\n')
    dead = [line.partition(":")[0] for line in dead_links(page, tmp_path)]
    assert dead == [*bad, "gone.png", "gone.svg"]
