"""What the site needs beyond docs/: the reference, the pages at the top of the checkout, and links that leave it."""

from __future__ import annotations

import posixpath
import re
from pathlib import Path
from typing import TYPE_CHECKING

from mkdocs.structure.files import File

from mirrorwave.reference import pages

if TYPE_CHECKING:
    from mkdocs.config.defaults import MkDocsConfig
    from mkdocs.structure.files import Files
    from mkdocs.structure.pages import Page

_ROOT = Path(__file__).parent.parent
#: Pages of the site by their file at the top of the checkout.
_PAGES = {name: name for name in ("CHANGELOG.md", "CONTRIBUTING.md", "SECURITY.md")} | {"README.md": "index.md"}
_LINK = re.compile(r"(?P<mark>!?)\[(?P<text>[^\]]*)\]\((?P<path>[^)#:\s]+)(?P<anchor>#[^)\s]*)?\)")


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the pages at the top of the checkout, and the reference as the code has it."""
    for name, page in _PAGES.items():
        text = (_ROOT / name).read_text(encoding="utf-8")
        files.append(File.generated(config, page, content=_within_docs(text)))
    for name, text in pages().items():
        # what `make reference` wrote some time may be old
        if written := files.get_file_from_path(f"reference/{name}"):
            files.remove(written)
        files.append(File.generated(config, f"reference/{name}", content=text))
    return files


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Turn links to pages beside docs/ into the site's, and those to sources into their path."""
    folder = posixpath.dirname(page.file.src_uri)
    return _LINK.sub(lambda link: _on_site(link, folder), markdown)


def _within_docs(text: str) -> str:
    """Return a page at the top of the checkout as if it lay in docs/."""

    def moved(link: re.Match[str]) -> str:
        path = link["path"]
        within = path.removeprefix("docs/") if path.startswith("docs/") else f"../{path}"
        return f"{link['mark']}[{link['text']}]({within}{link['anchor'] or ''})"

    return _LINK.sub(moved, text)


def _on_site(link: re.Match[str], folder: str) -> str:
    target = posixpath.normpath(posixpath.join(folder, link["path"]))
    if not target.startswith("../"):
        return link[0]
    path = target.removeprefix("../")
    if not (_ROOT / path).exists():
        # left as it is: the strict build names it
        return link[0]
    if path in _PAGES:
        return f"[{link['text']}]({posixpath.relpath(_PAGES[path], folder or '.')}{link['anchor'] or ''})"
    return link["text"] if f"`{path}`" == link["text"] else f"{link['text']} (`{path}`)"
