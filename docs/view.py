#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""Take the picture docs/view.png: `python docs/view.py` (extra `test`, and Chromium)."""

import shutil
import tempfile
import threading
from pathlib import Path

from playwright.sync_api import sync_playwright

from spinning_top_sim.tools import simulate
from spinning_top_sim.view.log import Player, read_logs
from spinning_top_sim.view.page import Page

HERE = Path(__file__).parent
SHOWN_S = 12.3


def take(address, path):
    """Open the page, and take its picture."""
    with sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=shutil.which('chromium'), args=[
            '--no-sandbox', '--use-gl=angle', '--use-angle=swiftshader',
            '--enable-unsafe-swiftshader'])
        page = browser.new_page(viewport={'width': 1280, 'height': 800})
        page.goto(address)
        page.wait_for_function("window.__viserMutable?.nodePoseData['/top0/body']")
        page.wait_for_timeout(12_000)          # the scene fades in
        # What the browser says about a machine without graphics.
        page.evaluate("document.querySelectorAll('.mantine-Notifications-root')"
                      '.forEach(element => element.remove())')
        page.screenshot(path=path)
        browser.close()


def main():
    """Draw half a minute of cusps, at one moment."""
    with tempfile.TemporaryDirectory() as folder:
        log = Path(folder) / 'cusp.mcap'
        simulate.main(['-o', str(log), '--duration', '30', '--quiet'])
        page = Page('cusp.mcap', '127.0.0.1', 0)
        page.arrows['angular momentum'].value = True
        player = Player(page, read_logs([log]))
        stopped = threading.Event()

        def show():
            while not stopped.wait(0.1):
                player.draw(SHOWN_S)

        thread = threading.Thread(target=show)
        thread.start()
        try:
            take(page.address, HERE / 'view.png')
        finally:
            stopped.set()
            thread.join()
            page.close()


if __name__ == '__main__':
    main()
