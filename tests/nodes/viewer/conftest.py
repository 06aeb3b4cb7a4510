"""A real browser for the tests of the page; its pages fail a test by any error, or by a request to another address."""

from __future__ import annotations

import shutil
import time
from collections.abc import Callable, Iterator
from typing import Any

import pytest

from nodes.viewer.newest import Board
from nodes.viewer.server import ViewerServer

CHROMIUM = next((path for name in ("chromium", "chromium-browser") if (path := shutil.which(name))), None)
FLAGS = [
    "--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run",
    "--disable-background-networking", "--disable-component-update", "--disable-sync",
    # one process shows one server's page after the other's: a new one computes for a second
    "--disable-site-isolation-trials",
    "--disable-features=SpareRendererForSitePerProcess,OriginKeyedProcessesByDefault,IsolateOrigins,site-per-process",
]  # fmt: skip
PATIENCE_S = 60.0
#: Opens the page of a server.
Open = Callable[..., Any]


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    sync_api = pytest.importorskip("playwright.sync_api", reason="the page's tests need playwright")
    if CHROMIUM is None:
        pytest.skip("the page's tests need Chromium: apt-get install chromium")
    with sync_api.sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=FLAGS)
        yield browser
        browser.close()


def until(page: Any, condition: str) -> None:
    """Poll from outside: the page's policy forbids evaluated text, as it should."""
    end_s = time.monotonic() + PATIENCE_S
    while not page.evaluate(f"Boolean({condition})"):
        assert time.monotonic() < end_s, f"never came true: {condition}"
        page.wait_for_timeout(20)
    # what is drawn follows with the next frame
    page.evaluate("new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)))")


def resize(page: Any, width: int, scheme: str = "light", height: int = 860) -> None:
    """Show a page on another screen."""
    page.emulate_media(color_scheme=scheme)
    page.set_viewport_size({"width": width, "height": height})
    until(page, f"innerWidth === {width}")


def leave(page: Any) -> None:
    """Have a page's tab forget it; its process stays, which it would not if the browser were asked."""
    if page.url != "about:blank":
        page.evaluate("localStorage.clear(); location.replace('about:blank')")
        page.wait_for_url("about:blank")


@pytest.fixture(scope="module")
def tabs(browser: Any) -> dict[str, list[Any]]:
    """Empty tabs, each with a store of its own, by the plots that their pages open with."""
    return {}


@pytest.fixture
def open_page(browser: Any, tabs: dict[str, list[Any]]) -> Iterator[Open]:
    lent, heard, trouble = [], [], []

    def is_trouble(server: ViewerServer, message: Any) -> bool:
        # looking for a server that has gone is none
        is_search = not server.alive and "ERR_CONNECTION_REFUSED" in message.text
        return bool(message.type == "error") and not is_search

    def new_tab(kept: str) -> Any:
        context = browser.new_context()
        keep = f"localStorage.getItem('mirrorwave.plots') || localStorage.setItem('mirrorwave.plots', '{kept}')"
        if kept:
            context.add_init_script(f"location.protocol === 'http:' && ({keep})")
        return context.new_page()

    def open_it(
        server: ViewerServer, scheme: str = "light", width: int = 1440, height: int = 900, *,
        motion: str = "no-preference", beside: Any = None, kept: str = "",
    ) -> Any:  # fmt: skip
        """Open a page, in the store of one `beside` it or in one of its own."""
        free = tabs.setdefault(kept, [])
        page = beside.context.new_page() if beside else free.pop() if free else new_tab(kept)
        lent.append((page, None if beside else free))
        page.set_viewport_size({"width": width, "height": height})
        page.emulate_media(color_scheme=scheme, reduced_motion=motion)
        own = (f":{server.port}/", "data:,", "about:blank")
        for event, listener in (
            ("console", lambda message: trouble.append(message.text) if is_trouble(server, message) else None),
            ("pageerror", lambda error: trouble.append(str(error))),
            ("request", lambda one: None if any(part in one.url for part in own) else trouble.append(one.url)),
        ):
            page.on(event, listener)
            heard.append((page, event, listener))
        page.goto(server.url)
        until(page, "mirrorwave.state.connection === 'live'")
        return page

    yield open_it
    for page, event, listener in heard:
        page.remove_listener(event, listener)
    for page, free in lent:
        if free is None:
            # before the other is used again: what is not in front is drawn late
            page.close()
        else:
            leave(page)
            free.append(page)
    assert trouble == []


@pytest.fixture
def board() -> Board:
    return Board()


@pytest.fixture
def server(board: Board) -> Iterator[ViewerServer]:
    with ViewerServer(board, title="test") as server:
        yield server
