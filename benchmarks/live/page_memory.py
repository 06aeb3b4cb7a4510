"""Memory of an open page and of the viewer over minutes: headless Chromium on the running demo.

Usage: python -m benchmarks.live.page_memory [--minutes 5] [--json]
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import time

import psutil
from playwright.sync_api import sync_playwright

from benchmarks.live.viewer_load import launched

CHROMIUM = ("--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run", "--enable-precise-memory-info")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--minutes", type=float, default=5.0)
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    rows = []
    with launched(f"memory{os.getpid()}") as url, sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=shutil.which("chromium"), args=list(CHROMIUM))
        page = browser.new_page()
        page.goto(url)
        session = page.context.new_cdp_session(page)
        viewer = next(p for p in psutil.process_iter(["cmdline"]) if "nodes.bev_viewer" in (p.info["cmdline"] or ()))
        start_s = time.monotonic()
        while time.monotonic() - start_s < 60.0 * arguments.minutes:
            page.wait_for_timeout(15_000)
            # what is garbage must not count: only what stays
            session.send("HeapProfiler.collectGarbage")
            heap = session.send("Runtime.getHeapUsage")["usedSize"]
            row = {
                "minute": round((time.monotonic() - start_s) / 60.0, 2),
                "page_heap_mib": round(heap / 2**20, 2),
                "viewer_resident_mib": round(viewer.memory_info().rss / 2**20, 1),
            }
            rows.append(row)
            if not arguments.json:
                print(json.dumps(row), flush=True)
        browser.close()
    if arguments.json:
        print(json.dumps(rows))


if __name__ == "__main__":
    main()
