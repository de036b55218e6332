#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""Take the picture docs/view.png: `python docs/view.py` (extra `test`, and Chromium)."""

import shutil
import threading
from pathlib import Path

from playwright.sync_api import sync_playwright

from spinning_top_sim.streams import parameters
from spinning_top_sim.view.page import Page
from spinning_top_sim.view.simulation import OwnSimulation

HERE = Path(__file__).parent
SHOWN_NS = 12_300_000_000


def take(address, path):
    """Open the page, and take its picture."""
    with sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=shutil.which('chromium'), args=[
            '--no-sandbox', '--use-gl=angle', '--use-angle=swiftshader',
            '--enable-unsafe-swiftshader'])
        page = browser.new_page(viewport={'width': 1280, 'height': 800})
        page.goto(address)
        page.wait_for_function("window.__viserMutable?.nodePoseData['/top/body']")
        page.wait_for_timeout(12_000)          # the scene fades in
        # What the browser says about a machine without graphics.
        page.evaluate("document.querySelectorAll('.mantine-Notifications-root')"
                      '.forEach(element => element.remove())')
        page.screenshot(path=path)
        browser.close()


def main():
    """Draw the scene of cusps, at one moment."""
    page = Page('spinning top', '127.0.0.1', 0)
    page.arrows['angular momentum'].value = True
    values = parameters.checked({'solver.method': 'exact'})
    source = OwnSimulation(page, 'cusp', values)
    source.player.stop_at(SHOWN_NS)
    stopped = threading.Event()
    thread = threading.Thread(target=page.show, args=(source, stopped))
    thread.start()
    try:
        take(page.address, HERE / 'view.png')
    finally:
        stopped.set()
        thread.join()
        page.close()


if __name__ == '__main__':
    main()
